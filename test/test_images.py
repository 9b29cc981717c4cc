# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image encodings against pixels packed by hand, and invalid images."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from array import array

import cv2
import numpy as np
import pytest

from kfvo_ros.errors import KfvoError
from kfvo_ros.images import (
    LAYOUTS,
    MAX_PIXELS,
    PLANAR,
    decode_compressed,
    decode_image,
    read_image,
    to_grey,
)

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
GREY = RGB[..., 0]
ALPHA = np.full((6, 8, 1), 77, dtype=np.uint8)
BGR = RGB[..., ::-1]
RGBA, BGRA = np.dstack([RGB, ALPHA]), np.dstack([BGR, ALPHA])
PLAIN = {'mono8': (GREY, GREY), '8UC1': (GREY, GREY), '8UC': (GREY, GREY), 'rgb8': (RGB, RGB),
         'bgr8': (BGR, RGB), '8UC3': (BGR, RGB), 'rgba8': (RGBA, RGB), 'bgra8': (BGRA, RGB),
         '8UC4': (BGRA, RGB), '8UC2': (np.dstack([GREY, ALPHA]), GREY)}
DEEP = {'mono16': (GREY, GREY), '16UC1': (GREY, GREY), '16UC': (GREY, GREY), 'rgb16': (RGB, RGB),
        'bgr16': (BGR, RGB), '16UC3': (BGR, RGB), 'rgba16': (RGBA, RGB), 'bgra16': (BGRA, RGB),
        '16UC4': (BGRA, RGB)}
FLOATS = {'32FC1': (GREY, GREY), '32FC': (GREY, GREY), '32FC3': (BGR, RGB), '32FC4': (BGRA, RGB)}
YUV = {'uyvy': 'uyvy', 'yuv422': 'uyvy', 'yuyv': 'yuyv', 'yuv422_yuy2': 'yuyv'}
PATTERNS = {'rggb': ((0, 1), (1, 2)), 'bggr': ((2, 1), (1, 0)),
            'gbrg': ((1, 2), (0, 1)), 'grbg': ((1, 0), (2, 1))}


def pack(pixels: np.ndarray, padding: int) -> tuple[int, np.ndarray]:
    """Return step and bytes of an image with `padding` bytes after each row."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    filler = np.full((len(rows), padding), 0xA5, dtype=np.uint8)
    return rows.shape[1] + padding, np.hstack([rows, filler]).ravel()


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize('encoding', PLAIN)
def test_eight_bits(encoding, padding):
    stored, expected = PLAIN[encoding]
    step, data = pack(stored, padding)
    np.testing.assert_array_equal(decode_image(encoding, 6, 8, step, False, data), expected)


@pytest.mark.parametrize('padding', [0, 6])
@pytest.mark.parametrize('is_bigendian', [False, True])
@pytest.mark.parametrize('encoding', DEEP)
def test_sixteen_bits_keep_their_high_byte(encoding, is_bigendian, padding):
    stored, expected = DEEP[encoding]
    low = np.random.default_rng(1).integers(0, 256, stored.shape)
    deep = (stored.astype(int) * 256 + low).astype('>u2' if is_bigendian else '<u2')
    step, data = pack(deep, padding)
    np.testing.assert_array_equal(decode_image(encoding, 6, 8, step, is_bigendian, data), expected)


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize('pattern', PATTERNS)
def test_bayer(pattern, bits):
    """The mosaic of a uniform colour decodes to that colour."""
    colour = np.array([200, 90, 30])
    tile = colour[np.array(PATTERNS[pattern])]
    mosaic = np.tile(tile, (8, 8))
    stored = mosaic.astype(np.uint8) if bits == 8 else (mosaic * 256 + 13).astype('<u2')
    step, data = pack(stored, 4)
    image = decode_image(f'bayer_{pattern}{bits}', 16, 16, step, False, data)
    np.testing.assert_array_equal(image, np.broadcast_to(colour, (16, 16, 3)))


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('is_bigendian', [False, True])
@pytest.mark.parametrize('encoding', FLOATS)
def test_floats_are_brightness_from_zero_to_one(encoding, is_bigendian, padding):
    stored, expected = FLOATS[encoding]
    step, data = pack((stored / 255.0).astype('>f4' if is_bigendian else '<f4'), padding)
    np.testing.assert_array_equal(decode_image(encoding, 6, 8, step, is_bigendian, data), expected)


@pytest.mark.parametrize(('value', 'message'), [
    (7.5, r'brightness of 0 to 1 in a 32FC1 image, came values of 0\.5 to 7\.5; is it depth'),
    (-0.5, 'came values of -0.5 to 0.5'), (np.nan, 'came values of nan to nan')])
def test_other_floats_are_refused(value, message):
    with pytest.raises(KfvoError, match=message):
        decode_image('32FC1', 1, 2, 8, False, np.array([value, 0.5], '<f4').tobytes())


def red(count: int) -> tuple[list[int], list[int]]:
    """Return Y, and U and V in turn, of this number of red pixels by BT.601."""
    return [81] * count, [90, 240] * count


@pytest.mark.parametrize('padding', [0, 4])
@pytest.mark.parametrize('encoding', PLANAR)
def test_planar_yuv(encoding, padding):
    brightness, colour = red(8)
    if encoding == 'nv24':
        chroma = [colour + [0] * 2 * padding] * 6
    else:
        chroma = [colour[:8][::-1 if encoding == 'nv21' else 1] + [0] * padding] * 3
    rows = [brightness + [0] * padding] * 6 + chroma
    data = np.array([value for row in rows for value in row], np.uint8)
    image = decode_image(encoding, 6, 8, 8 + padding, False, data)
    assert image.shape == (6, 8, 3)
    assert np.abs(image.astype(int) - (255, 0, 0)).max() <= 2
    # Some drivers count the bytes of both planes in their step.
    np.testing.assert_array_equal(decode_image(encoding, 6, 8, data.size // 6, False, data), image)


def test_planes_of_other_sizes_are_refused():
    for encoding, height, width, size in (
            ('nv21', 6, 8, 71), ('nv21', 6, 8, 48), ('nv12', 6, 8, 0), ('nv12', 5, 8, 60),
            ('nv24', 6, 7, 126), ('nv24', 6, 8, 96), ('nv21', 0, 8, 0)):
        with pytest.raises(KfvoError, match=f'expected a {encoding} image of even size'):
            decode_image(encoding, height, width, width, False, bytes(size))


def test_a_step_that_is_too_small_is_corrected():
    np.testing.assert_array_equal(decode_image('rgb8', 6, 8, 8, False, RGB.tobytes()), RGB)
    np.testing.assert_array_equal(decode_image('mono8', 6, 8, 0, False, GREY.tobytes()), GREY)


@pytest.mark.parametrize(('encoding', 'order'), YUV.items())
def test_yuv(encoding, order):
    """BT.601 red: Y 81, U 90, V 240."""
    values = {'y': 81, 'u': 90, 'v': 240}
    row = np.array([values[letter] for letter in order] * 4, dtype=np.uint8)
    image = decode_image(encoding, 2, 8, 16, False, np.tile(row, 2))
    assert image.shape == (2, 8, 3)
    assert np.abs(image.astype(int) - (255, 0, 0)).max() <= 2


def test_brightness_does_not_depend_on_the_rest_of_the_image():
    dark, bright = np.full((2, 2), 1000, '<u2'), np.full((2, 2), 60000, '<u2')
    bright[0, 0] = 1000
    for pixels in (dark, bright):
        assert decode_image('mono16', 2, 2, 4, False, pixels.tobytes())[0, 0] == 3


@pytest.mark.parametrize('container', [bytes, bytearray, memoryview,
                                       lambda data: array('B', data)])
def test_the_image_owns_its_memory(container):
    image = decode_image('mono8', 6, 8, 8, False, container(GREY.tobytes()))
    np.testing.assert_array_equal(image, GREY)
    assert image.flags.owndata and image.flags.writeable and image.flags.c_contiguous
    read_only = GREY.ravel().copy()
    read_only.flags.writeable = False
    decode_image('mono8', 6, 8, 8, False, read_only)[:] = 0
    np.testing.assert_array_equal(read_only, GREY.ravel())


@pytest.mark.parametrize(('encoding', 'height', 'width', 'step', 'size', 'message'), [
    ('64FC1', 2, 2, 16, 32, 'unknown image encoding.*64FC1.*mono8.*nv24'),
    ('16SC1', 2, 2, 4, 8, 'unknown image encoding.*16SC1'),
    ('rgb8', 2, 2, 5, 10, 'step >= 6'),
    ('mono8', 2, 2, 2, 3, 'step 2 and 3 bytes'),
    ('mono8', 2, 2, 2, 5, 'step 2 and 5 bytes'),
    ('mono16', 2, 2, 2, 4, 'step >= 4'),
    ('mono8', 0, 2, 2, 0, '2x0'),
    ('yuv422', 1, 3, 6, 6, 'even width of yuv422.*3 came'),
])
def test_inconsistent_sizes_are_refused(encoding, height, width, step, size, message):
    with pytest.raises(KfvoError, match=message):
        decode_image(encoding, height, width, step, False, bytes(size))


def test_every_layout_is_tested():
    bayer = {f'bayer_{pattern}{bits}' for pattern in PATTERNS for bits in (8, 16)}
    named = {name.lower() for name in (*PLAIN, *DEEP, *FLOATS, *YUV)}
    assert named | bayer == set(LAYOUTS)


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode('.png', pixels)[1].tobytes()


@pytest.mark.parametrize(('pixels', 'format', 'expected'), [
    (GREY, 'png', GREY),
    (GREY, 'mono8; png compressed ', GREY),
    (BGR, 'png', RGB),
    (BGR, 'rgb8; png compressed bgr8', RGB),
    (BGR, 'bgr8; png compressed bgr8', RGB),
    (RGB, 'rgb8; png compressed ', RGB),  # compressed in the channel order of the message
    (np.dstack([BGR, ALPHA]), 'bgra8; png compressed bgr8', RGB),
    (GREY.astype(np.uint16) * 256 + 200, 'mono16; png compressed ', GREY),
    (BGR.astype(np.uint16) * 256 + 200, 'png', RGB),
])
def test_compressed(pixels, format, expected):
    np.testing.assert_array_equal(decode_compressed(png(pixels), format), expected)


def test_a_compressed_mosaic_is_demosaiced():
    mosaic = np.tile(np.array([[200, 90], [90, 30]], dtype=np.uint8), (8, 8))
    image = decode_compressed(png(mosaic), 'bayer_rggb8; png compressed ')
    np.testing.assert_array_equal(image, np.broadcast_to((200, 90, 30), (16, 16, 3)))


def test_jpeg():
    row, column = np.mgrid[:64, :64]
    smooth = np.dstack([row, column, np.full((64, 64), 200)]).astype(np.uint8)
    data = cv2.imencode('.jpg', smooth[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
    assert np.abs(decode_compressed(data.reshape(-1), 'jpeg').astype(int) - smooth).max() < 12


def test_bytes_that_are_no_image_are_refused():
    floats = cv2.imencode('.tiff', np.ones((4, 4), np.float32))[1].tobytes()
    for data in (b'', b'no picture at all', png(GREY)[:20], floats):
        with pytest.raises(KfvoError, match='expected a JPEG, PNG'):
            decode_compressed(data, 'png')


def test_grey_with_alpha_is_grey():
    rows = b''.join(b'\0' + bytes(value for grey in row for value in (grey, 255)) for row in GREY)
    data = png_of(8, 6, zlib.compress(rows), colour_type=4)
    np.testing.assert_array_equal(to_grey(decode_compressed(data)), GREY)


def png_of(width: int, height: int, pixels: bytes, colour_type: int = 0) -> bytes:
    """Return a PNG of 8 bits with this header and these compressed rows."""
    chunks = ((b'IHDR', struct.pack('>IIBBBBB', width, height, 8, colour_type, 0, 0, 0)),
              (b'IDAT', pixels), (b'IEND', b''))
    return b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(content)) + kind + content
        + struct.pack('>I', zlib.crc32(kind + content)) for kind, content in chunks)


def test_an_image_of_too_many_pixels_is_refused_by_its_header(tmp_path):
    """The rows of 32000 x 32000 pixels have a gigabyte, and a megabyte when compressed."""
    compressor = zlib.compressobj(9)
    rows = b''.join(compressor.compress(bytes(32001)) for _ in range(3200)) * 10
    data = png_of(32000, 32000, rows + compressor.flush())
    assert MAX_PIXELS < 32000 ** 2 and len(data) < 2e6
    tracemalloc.start()
    with pytest.raises(KfvoError, match=f'up to {MAX_PIXELS} pixels, came one of 32000x32000'):
        decode_compressed(data, 'png')
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    (tmp_path / 'large.png').write_bytes(data)
    with pytest.raises(KfvoError, match=r'large\.png: .*came one of 32000x32000'):
        read_image(tmp_path / 'large.png')


@pytest.mark.parametrize('name', ['folder', 'fifo', 'device'])
def test_what_is_no_file_is_refused(name, tmp_path):
    path = tmp_path / f'{name}.png'
    if name == 'folder':
        path.mkdir()
    elif name == 'fifo':
        os.mkfifo(path)
    else:
        path.symlink_to('/dev/zero')
    kind = {'fifo': 'FIFO'}.get(name, name)
    with pytest.raises(KfvoError, match=f'cannot read the image .* a file, found a {kind}'):
        read_image(path)


def test_files(tmp_path):
    path = tmp_path / 'ümläut.png'
    path.write_bytes(png(BGR))
    np.testing.assert_array_equal(read_image(path), RGB)
    with pytest.raises(KfvoError, match=r'missing\.png'):
        read_image(tmp_path / 'missing.png')
    (tmp_path / 'broken.png').write_bytes(b'broken')
    with pytest.raises(KfvoError, match=r'broken\.png'):
        read_image(tmp_path / 'broken.png')


def test_exif_orientation_is_ignored(tmp_path):
    data = cv2.imencode('.jpg', np.zeros((6, 8), np.uint8))[1].tobytes()
    # A TIFF directory of one entry: tag 0x0112 (orientation), SHORT, one value, 6 (rotate 90).
    exif = b'Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0'
    segment = b'\xff\xe1' + (len(exif) + 2).to_bytes(2, 'big') + exif
    path = tmp_path / 'rotated.jpg'
    path.write_bytes(data[:2] + segment + data[2:])
    assert cv2.imread(str(path)).shape[:2] == (8, 6)
    assert read_image(path).shape == (6, 8)


def test_grey():
    assert to_grey(GREY) is GREY
    np.testing.assert_array_equal(to_grey(np.dstack([GREY] * 3)), GREY)
    red = to_grey(np.full((1, 1, 3), (255, 0, 0), np.uint8))[0, 0]
    assert abs(int(red) - 0.299 * 255) < 1

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of pixels: ROS image buffers, compressed images and image files.

Every image is uint8, (H, W) grey or (H, W, 3) RGB. 16-bit samples keep their high byte: a
constant rule, because stretching each image to its own range would make brightness flicker.
Floats are brightness from 0 to 1.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.utils.files import open_file
from kfvo_ros.utils.image_header import image_size

MAX_PIXELS = 2 ** 27
"""Largest compressed image; a megabyte of PNG can hold a thousand times as many pixels."""
MAX_FILE_BYTES = 2 ** 29
CODECS = ('png', 'jpeg')
"""Codecs of the compressed images that bags are written with; png is lossless."""
Bytes = bytes | bytearray | memoryview | array | np.ndarray
"""Types in which ROS clients and bag readers return uint8[]."""


class PixelLayout(NamedTuple):
    """How an encoding stores one pixel, and the OpenCV conversion to RGB where one is needed.

    Samples of 4 bytes are floats. Of two channels without a conversion the first is brightness.
    """

    sample_bytes: int
    channels: int
    to_rgb: int | None = None


BAYER_CODES = {'bayer_rggb': cv2.COLOR_BayerRGGB2RGB, 'bayer_bggr': cv2.COLOR_BayerBGGR2RGB,
               'bayer_gbrg': cv2.COLOR_BayerGBRG2RGB, 'bayer_grbg': cv2.COLOR_BayerGRBG2RGB}
_DEPTHS = {'8': 1, '16': 2}
LAYOUTS = {
    **{f'{name}{bits}': PixelLayout(size, channels, code) for bits, size in _DEPTHS.items()
       for name, channels, code in (
           ('mono', 1, None), ('rgb', 3, None), ('bgr', 3, cv2.COLOR_BGR2RGB),
           ('rgba', 4, cv2.COLOR_RGBA2RGB), ('bgra', 4, cv2.COLOR_BGRA2RGB),
           *((name, 1, code) for name, code in BAYER_CODES.items()))},
    # Plain OpenCV matrices: BGR by convention; two channels of bytes are grey and alpha or YUY2.
    **{f'{depth}c{count}': PixelLayout(size, channels, code)
       for depth, size in (('8u', 1), ('16u', 2), ('32f', 4))
       for count, channels, code in (('', 1, None), ('1', 1, None), ('3', 3, cv2.COLOR_BGR2RGB),
                                     ('4', 4, cv2.COLOR_BGRA2RGB))},
    '8uc2': PixelLayout(1, 2),
    **dict.fromkeys(('uyvy', 'yuv422'), PixelLayout(1, 2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(('yuyv', 'yuv422_yuy2'), PixelLayout(1, 2, cv2.COLOR_YUV2RGB_YUY2)),
}
"""Supported encodings of sensor_msgs/Image with interleaved channels, in lower case."""
PLANAR = {'nv12': cv2.COLOR_YUV2RGB_NV12, 'nv21': cv2.COLOR_YUV2RGB_NV21,
          'nv24': cv2.COLOR_YUV2RGB_NV12}
"""Those of a plane of brightness and then one of colour, which nv24 has for each pixel."""


def decode_image(encoding: str, height: int, width: int, step: int, is_bigendian: bool,
                 data: Bytes) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image, given as its plain fields.

    The array owns its memory. A step that is too small is corrected where the bytes are those of
    rows without padding. Raises KfvoError for an encoding that is neither in LAYOUTS nor in
    PLANAR, and for inconsistent sizes.
    """
    encoding = encoding.strip()
    layout = LAYOUTS.get(encoding.lower())
    buffer = np.frombuffer(data, dtype=np.uint8)
    if encoding.lower() in PLANAR:
        return _decode_planar(encoding, height, width, buffer)
    if layout is None:
        raise KfvoError(f'unknown image encoding {encoding!r}; expected one of '
                        f'{", ".join((*LAYOUTS, *PLANAR))}')
    row_bytes = width * layout.channels * layout.sample_bytes
    if step < row_bytes and buffer.size == height * row_bytes:
        step = row_bytes
    if min(height, width) <= 0 or step < row_bytes or buffer.size != height * step:
        raise KfvoError(f'expected a {width}x{height} {encoding} image of step >= {row_bytes} and '
                        f'height * step bytes; step {step} and {buffer.size} bytes came')
    if layout.channels == 2 and layout.to_rgb is not None and width % 2:
        raise KfvoError(f'expected an even width of {encoding}, whose pixels share colour in '
                        f'pairs; {width} came')
    rows = buffer.reshape(height, step)[:, :row_bytes]
    if layout.sample_bytes == 4:
        pixels = _bytes_of_floats(encoding, rows, '>f4' if is_bigendian else '<f4')
    else:
        high_byte = 0 if is_bigendian else layout.sample_bytes - 1
        pixels = np.array(rows[:, high_byte::layout.sample_bytes], order='C')
    if layout.channels > 1:
        pixels = pixels.reshape(height, width, layout.channels)
    if layout.channels == 2 and layout.to_rgb is None:
        return pixels[..., 0].copy()
    return pixels if layout.to_rgb is None else cv2.cvtColor(pixels, layout.to_rgb)


def _bytes_of_floats(encoding: str, rows: np.ndarray, kind: str) -> np.ndarray:
    """Return 255 times the floats in rows of bytes; raises KfvoError beyond 0 to 1."""
    values = np.ascontiguousarray(rows).view(kind)
    if not (values.min() >= 0.0 and values.max() <= 1.0):  # NaN neither
        raise KfvoError(f'expected brightness of 0 to 1 in a {encoding} image, came values of '
                        f'{values.min():g} to {values.max():g}; is it depth?')
    return np.rint(255.0 * values).astype(np.uint8)


def _decode_planar(encoding: str, height: int, width: int, buffer: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W, 3) of one of PLANAR; rows may be padded. Raises KfvoError.

    The messages of some drivers count the rows of both planes in their step, so that the length
    of a row follows from the number of bytes.
    """
    has_full_colour = encoding.lower() == 'nv24'
    half_planes = 6 if has_full_colour else 3
    stride, rest = divmod(2 * buffer.size, half_planes * max(height, 1))
    if min(height, width) <= 0 or width % 2 or height % 2 or rest or stride < width:
        raise KfvoError(f'expected a {encoding} image of even size and {half_planes}/2 bytes per '
                        f'pixel or more; {width}x{height} and {buffer.size} bytes came')
    brightness = buffer[:height * stride].reshape(height, stride)[:, :width]
    colour = buffer[height * stride:]
    if has_full_colour:  # of each 2x2 pixels the colour of one, as nv12 has it
        colour = colour.reshape(height, 2 * stride)[::2, :2 * width].reshape(
            height // 2, width, 2)[:, ::2].reshape(height // 2, width)
    else:
        colour = colour.reshape(height // 2, stride)[:, :width]
    return cv2.cvtColor(np.vstack([brightness, colour]), PLANAR[encoding.lower()])


def decode_compressed(data: Bytes, format: str = '') -> np.ndarray:
    """Return the pixels of a sensor_msgs/CompressedImage or of the bytes of an image file.

    `format` is the message's: image_transport writes ``rgb8; jpeg compressed bgr8`` and sends
    Bayer mosaics as grey. Raises KfvoError when the bytes are no 8 or 16-bit image.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    size = image_size(buffer)
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise KfvoError(f'expected an image of up to {MAX_PIXELS} pixels, came one of '
                        f'{size[0]}x{size[1]}')
    try:
        pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED) if size is not None else None
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise KfvoError(f'expected a JPEG, PNG or other 8 or 16-bit picture, {buffer.size} bytes '
                        f'came that are none{f" (format {format!r})" if format else ""}')
    if pixels.dtype == np.uint16:
        pixels = (pixels // 256).astype(np.uint8)
    if pixels.ndim == 3 and pixels.shape[2] < 3:  # grey, perhaps with alpha
        pixels = pixels[..., 0].copy()
    encoding, separator, transport = format.strip().lower().partition(';')
    if pixels.ndim == 2:
        code = BAYER_CODES.get(encoding.rstrip('0123456789'))
        return pixels if code is None else cv2.cvtColor(pixels, code)
    if pixels.shape[2] == 4:
        return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB)
    # image_transport's rule: a colour encoding without "compressed bgr" after it means RGB.
    states_order = bool(separator) and encoding.startswith(('rgb', 'bgr'))
    is_rgb = states_order and 'compressed bgr' not in transport
    return pixels if is_rgb else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def read_image(path: Path) -> np.ndarray:
    """Return the pixels of an image file as stored; EXIF orientation is ignored.

    Raises KfvoError naming the file.
    """
    try:
        with open_file(Path(path), MAX_FILE_BYTES) as file:
            return decode_compressed(file.read())
    except OSError as error:
        raise KfvoError(f'cannot read the image {path}: {reason_of(error)}') from error
    except KfvoError as error:
        raise KfvoError(f'cannot read the image {path}: {error}') from error


def to_grey(image: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8 of a grey or RGB image; a grey image is returned without a copy."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

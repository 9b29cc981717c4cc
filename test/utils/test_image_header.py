# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of images by their headers, of files that OpenCV writes and of headers made by hand."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from kfvo_ros.utils.image_header import image_size

NOISE = np.random.default_rng(0).integers(0, 256, (48, 70, 3), dtype=np.uint8)
SUFFIXES = ('.png', '.jpg', '.bmp', '.pgm', '.ppm', '.tif', '.webp')


def encode(suffix: str, *parameters: int) -> np.ndarray:
    """Return the bytes (N,) of the noise as OpenCV writes it."""
    image = NOISE[..., 0] if suffix == '.pgm' else NOISE
    return cv2.imencode(suffix, image, parameters)[1].reshape(-1)


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_files_of_opencv(suffix):
    assert image_size(encode(suffix)) == (70, 48)


def test_variants():
    assert image_size(encode('.webp', cv2.IMWRITE_WEBP_QUALITY, 101)) == (70, 48)  # lossless
    assert image_size(encode('.jpg', cv2.IMWRITE_JPEG_PROGRESSIVE, 1)) == (70, 48)
    for suffix in ('.jp2', '.gif', '.avif'):
        if cv2.haveImageWriter(suffix):
            assert image_size(encode(suffix)) == (70, 48)


def test_a_jpeg_with_other_segments_and_fill_bytes():
    data = encode('.jpg').tobytes()
    segment = b'\xff\xe1\x00\x08Exif\0\0'
    assert image_size(np.frombuffer(data[:2] + segment + b'\xff\xff\0' + data[2:],
                                    np.uint8)) == (70, 48)


@pytest.mark.parametrize(('data', 'size'), [
    (b'II*\0\x08\0\0\0\x02\0' + struct.pack('<HHIIHHII', 256, 4, 1, 70000, 257, 3, 1, 48),
     (70000, 48)),
    (b'MM\0*\0\0\0\x08\0\x02' + struct.pack('>HHIHHHHII', 256, 3, 1, 70, 0, 257, 4, 1, 48),
     (70, 48)),
    (b'II+\0\x08\0\0\0' + struct.pack('<QQHHQQHHQQ', 16, 2, 256, 16, 1, 70, 257, 4, 1, 48),
     (70, 48)),
    (b'RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0' + b'\x44\0\x01' + b'\x2f\0\0', (65605, 48)),
    (b'BM' + bytes(12) + struct.pack('<Iii', 40, 70, -48), (70, 48)),
    (b'BM' + bytes(12) + struct.pack('<IHH', 12, 70, 48), (70, 48)),
    (b'P5\n# a comment\n70 # \n48\n255\n', (70, 48)), (b'P5\n# a\n# b\n70 48\n255\n', (70, 48)),
    (b'P7\nWIDTH 70\nHEIGHT 48\nDEPTH 1\nENDHDR\n', (70, 48))])
def test_headers(data, size):
    assert image_size(np.frombuffer(data, np.uint8)) == size


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_cut_headers_have_no_size(suffix):
    data = encode(suffix)
    for length in range(12):
        assert image_size(data[:length]) in (None, (70, 48))
    assert image_size(data[:4]) is None


def test_other_bytes_have_no_size():
    rng = np.random.default_rng(1)
    for start in (b'', b'\xff\xd8', b'II*\0', b'MM\0+', b'P6 ', b'BM', b'RIFF', b'no picture'):
        for _ in range(50):
            image_size(np.concatenate([np.frombuffer(start, np.uint8),
                                       rng.integers(0, 256, 400, dtype=np.uint8)]))
    assert image_size(np.frombuffer(b'no picture at all', np.uint8)) is None
    assert image_size(np.zeros(0, np.uint8)) is None

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of pixels: ROS image buffers, compressed images and image files.

Every image is uint8, (H, W) grey or (H, W, 3) RGB. 16-bit samples keep their high byte: a
constant rule, because stretching each image to its own range would make brightness flicker.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kfvo_ros.errors import KfvoError, reason_of

CODECS = ('png', 'jpeg')
"""Codecs of the compressed images that bags are written with; png is lossless."""
Bytes = bytes | bytearray | memoryview | array | np.ndarray
"""Types in which ROS clients and bag readers return uint8[]."""


class PixelLayout(NamedTuple):
    """How an encoding stores one pixel, and the OpenCV conversion to RGB where one is needed."""

    sample_bytes: int
    channels: int
    to_rgb: int | None = None


BAYER_CODES = {'bayer_rggb': cv2.COLOR_BayerRGGB2RGB, 'bayer_bggr': cv2.COLOR_BayerBGGR2RGB,
               'bayer_gbrg': cv2.COLOR_BayerGBRG2RGB, 'bayer_grbg': cv2.COLOR_BayerGRBG2RGB}
LAYOUTS = {
    'mono8': PixelLayout(1, 1), '8uc1': PixelLayout(1, 1),
    'mono16': PixelLayout(2, 1), '16uc1': PixelLayout(2, 1),
    'rgb8': PixelLayout(1, 3), 'rgb16': PixelLayout(2, 3),
    'bgr8': PixelLayout(1, 3, cv2.COLOR_BGR2RGB), 'bgr16': PixelLayout(2, 3, cv2.COLOR_BGR2RGB),
    '8uc3': PixelLayout(1, 3, cv2.COLOR_BGR2RGB),  # a plain OpenCV matrix, BGR by convention
    'rgba8': PixelLayout(1, 4, cv2.COLOR_RGBA2RGB), 'bgra8': PixelLayout(1, 4, cv2.COLOR_BGRA2RGB),
    'yuv422': PixelLayout(1, 2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': PixelLayout(1, 2, cv2.COLOR_YUV2RGB_YUY2),
    **{f'{name}{8 * size}': PixelLayout(size, 1, code)
       for name, code in BAYER_CODES.items() for size in (1, 2)},
}
"""Supported encodings of sensor_msgs/Image, in lower case."""


def decode_image(encoding: str, height: int, width: int, step: int, is_bigendian: bool,
                 data: Bytes) -> np.ndarray:
    """Return the pixels of a sensor_msgs/Image, given as its plain fields.

    The array owns its memory. Raises KfvoError for an encoding that is not in LAYOUTS and for
    inconsistent sizes.
    """
    encoding = encoding.strip()
    layout = LAYOUTS.get(encoding.lower())
    if layout is None:
        raise KfvoError(f'unknown image encoding {encoding!r}; expected one of '
                        f'{", ".join(LAYOUTS)}')
    buffer = np.frombuffer(data, dtype=np.uint8)
    row_bytes = width * layout.channels * layout.sample_bytes
    if min(height, width) <= 0 or step < row_bytes or buffer.size != height * step:
        raise KfvoError(f'expected a {width}x{height} {encoding} image of step >= {row_bytes} and '
                        f'height * step bytes; step {step} and {buffer.size} bytes came')
    if layout.channels == 2 and width % 2:
        raise KfvoError(f'expected an even width of {encoding}, whose pixels share colour in '
                        f'pairs; {width} came')
    high_byte = 0 if is_bigendian else layout.sample_bytes - 1
    samples = buffer.reshape(height, step)[:, high_byte:row_bytes:layout.sample_bytes]
    pixels = np.array(samples, order='C')
    if layout.channels > 1:
        pixels = pixels.reshape(height, width, layout.channels)
    return pixels if layout.to_rgb is None else cv2.cvtColor(pixels, layout.to_rgb)


def decode_compressed(data: Bytes, format: str = '') -> np.ndarray:
    """Return the pixels of a sensor_msgs/CompressedImage or of the bytes of an image file.

    `format` is the message's: image_transport writes ``rgb8; jpeg compressed bgr8`` and sends
    Bayer mosaics as grey. Raises KfvoError when the bytes are no 8 or 16-bit image.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    try:
        pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED) if buffer.size else None
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise KfvoError(f'expected a JPEG, PNG or other 8 or 16-bit picture, {buffer.size} bytes '
                        f'came that are none{f" (format {format!r})" if format else ""}')
    if pixels.dtype == np.uint16:
        pixels = (pixels // 256).astype(np.uint8)
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
        return decode_compressed(Path(path).read_bytes())
    except OSError as error:
        raise KfvoError(f'cannot read the image {path}: {reason_of(error)}') from error
    except KfvoError as error:
        raise KfvoError(f'cannot read the image {path}: {error}') from error


def to_grey(image: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8 of a grey or RGB image; a grey image is returned without a copy."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

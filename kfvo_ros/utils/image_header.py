# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The size of a compressed image from its header, before memory is taken for its pixels."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

import numpy as np

HEADER_BYTES = 4096
"""Where the size is found in formats without offsets to it."""
_FRAME_HEADERS = frozenset(range(0xFFC0, 0xFFD0)) - {0xFFC4, 0xFFC8, 0xFFCC}
_BARE_MARKERS = range(0xFFD0, 0xFFDA)
"""Markers of JPEG with the size of the image, and those without a length after them."""
Size = tuple[int, int]
Reader = Callable[[memoryview, re.Match[bytes]], Size]


def image_size(data: np.ndarray) -> Size | None:
    """Return (width, height) of the bytes (N,) of an image file, None where it is unknown.

    It is known of PNG, JPEG, BMP, PNM, TIFF, WebP, GIF, JPEG 2000, AVIF and Sun rasters.
    """
    view = data.data
    head = view[:HEADER_BYTES].tobytes()
    for signature, read_size in _FORMATS:
        match = signature.match(head)
        if match is not None:
            try:
                return read_size(view, match)
            except (struct.error, KeyError, ValueError, OverflowError):
                return None
    return None


def _numbers_after(form: str, mask: int = 0xFFFFFFFF) -> Reader:
    """Return the reader of the two numbers of this `struct` form after a signature."""
    def read(data: memoryview, match: re.Match[bytes]) -> Size:
        width, height = struct.unpack_from(form, data, match.end())
        return abs(width) & mask, abs(height) & mask  # a BMP's height is negative from the top
    return read


def _read_height_first(data: memoryview, match: re.Match[bytes]) -> Size:
    height, width = struct.unpack_from('>II', data, match.end())
    return width, height


def _read_text(data: memoryview, match: re.Match[bytes]) -> Size:
    return int(match[1]), int(match[2])


def _read_webp_lossless(data: memoryview, match: re.Match[bytes]) -> Size:
    bits, = struct.unpack_from('<I', data, match.end())
    return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1


def _read_webp_extended(data: memoryview, match: re.Match[bytes]) -> Size:
    low_width, high_width, low_height, high_height = struct.unpack_from('<HBHB', data,
                                                                        match.end())
    return (high_width << 16 | low_width) + 1, (high_height << 16 | low_height) + 1


def _read_jpeg(data: memoryview, match: re.Match[bytes]) -> Size:
    """Return the size in the frame header, which follows segments with their lengths."""
    start = match.end()
    for _ in range(HEADER_BYTES):
        marker, length = struct.unpack_from('>HH', data, start)
        if marker in _FRAME_HEADERS:
            height, width = struct.unpack_from('>HH', data, start + 5)
            return width, height
        # Decoders skip what is no segment, such as bytes that fill the space before one.
        start += 2 + length if 0xFFC0 <= marker < 0xFFFF and marker not in _BARE_MARKERS else 1
    raise ValueError('expected a frame header')


def _read_tiff(data: memoryview, match: re.Match[bytes]) -> Size:
    """Return the tags 256 and 257 of the first directory, of a TIFF or a BigTIFF."""
    order, is_big = '<' if match[0].startswith(b'I') else '>', b'+' in match[0]
    pointer, counter, header, entry = ('Q', 'Q', 8, 20) if is_big else ('I', 'H', 4, 12)
    start, = struct.unpack_from(order + pointer, data, header)
    count, = struct.unpack_from(order + counter, data, start)
    first, values = start + struct.calcsize(order + counter), {}
    for offset in range(first, first + entry * min(count, 1000), entry):
        tag, kind = struct.unpack_from(f'{order}HH', data, offset)
        if tag in (256, 257):
            form = {3: 'H', 4: 'I', 16: 'Q'}[kind]
            values[tag], = struct.unpack_from(order + form, data, offset + entry - header)
    return values[256], values[257]


_FORMATS: list[tuple[re.Pattern[bytes], Reader]] = [
    (re.compile(signature, re.DOTALL), reader) for signature, reader in (
        (rb'\x89PNG\r\n\x1a\n.{4}IHDR', _numbers_after('>II')),
        (rb'\xff\xd8', _read_jpeg),
        (rb'BM.{12}\x0c\0\0\0', _numbers_after('<HH')),
        (rb'BM.{16}', _numbers_after('<ii')),
        (rb'P[1-6]\s+(?:#[^\n]*\n\s*)*(\d+)\s+(?:#[^\n]*\n\s*)*(\d+)\s', _read_text),
        (rb'P7\n.*?WIDTH (\d+)\n.*?HEIGHT (\d+)\n', _read_text),
        (rb'II[*+]\0|MM\0[*+]', _read_tiff),
        (rb'RIFF.{4}WEBPVP8 .{7}\x9d\x01\x2a', _numbers_after('<HH', mask=0x3FFF)),
        (rb'RIFF.{4}WEBPVP8L.{4}\x2f', _read_webp_lossless),
        (rb'RIFF.{4}WEBPVP8X.{8}', _read_webp_extended),
        (rb'GIF8[79]a', _numbers_after('<HH')),
        (rb'\0\0\0\x0cjP  \r\n\x87\n.*?ihdr', _read_height_first),
        (rb'\xff\x4f\xff\x51.{4}', _numbers_after('>II')),
        (rb'.{4}ftypavi.*?ispe.{4}', _numbers_after('>II')),
        (rb'\x59\xa6\x6a\x95', _numbers_after('>II')))]

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Video files, calibrated by a camera_info.yaml beside them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from kfvo_ros.errors import KfvoError, printable, reason_of
from kfvo_ros.images import MAX_PIXELS
from kfvo_ros.sequences.base import Calibration, Frame, Sequence, SequenceKind, SequenceSettings
from kfvo_ros.sequences.image_folder import stamps_at_rate
from kfvo_ros.utils.files import open_file

_log = logging.getLogger(__name__)
VIDEO_SUFFIXES = frozenset(('.mp4', '.m4v', '.avi', '.mov', '.mkv', '.webm', '.mpg', '.mpeg'))


class VideoSequence(Sequence):
    """The frames of a video file, stamped from zero at the frame rate of its container.

    `rate` [Hz] is used where the container states none. `length` is read from the container and
    may be wrong. Raises KfvoError for a video that OpenCV cannot decode.
    """

    def __init__(self, path: Path, calibration: Calibration, rate: float) -> None:
        self.name = printable(path.stem)
        self._path = path
        with _capture(path) as capture:
            self._length = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            container_rate = capture.get(cv2.CAP_PROP_FPS)
            readable, image = capture.read()
        if not readable:
            raise KfvoError(f'{path}: expected a video, not one frame of it can be decoded')
        if _is_cut(path):
            _log.warning('%s: the file is shorter than its header says; its last frames may be '
                         'missing or damaged', path)
        self._stamp_at = stamps_at_rate(container_rate if container_rate > 0 else rate)
        self.camera = calibration.camera(self.name, image.shape[1], image.shape[0])

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames up to the first that cannot be decoded, OpenCV's sign of the end."""
        with _capture(self._path) as capture:
            index = 0
            while (read := capture.read())[0]:
                image = cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)
                yield Frame(self._stamp_at(index), image, self.camera)
                index += 1

    @property
    def length(self) -> int | None:
        """Number of frames by the container, None where it states none."""
        return self._length if self._length > 0 else None


def _is_cut(path: Path) -> bool:
    """Return whether a RIFF file (AVI) ends before the size in its header; False for others."""
    with path.open('rb') as file:
        magic, size = file.read(4), int.from_bytes(file.read(4), 'little')
    return magic == b'RIFF' and path.stat().st_size < 8 + size


def open_video(path: Path, settings: SequenceSettings) -> VideoSequence:
    """Open a video file."""
    return VideoSequence(path, Calibration(settings.camera, path.parent), settings.rate)


def _matches(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


KIND = SequenceKind('video', f'a video ({" ".join(sorted(VIDEO_SUFFIXES))})', _matches,
                    open_video)


@contextmanager
def _capture(path: Path) -> Iterator[cv2.VideoCapture]:
    try:
        open_file(path).close()  # OpenCV would wait for the writer of a FIFO
        str(path).encode()  # and crashes on a name that is not UTF-8
    except UnicodeEncodeError as error:
        raise KfvoError(f'cannot open the video {path}: expected a name in UTF-8; rename it'
                        ) from error
    except OSError as error:
        raise KfvoError(f'cannot open the video {path}: {reason_of(error)}') from error
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise KfvoError(f'cannot open the video {path}: expected a format that this OpenCV '
                            'can decode; convert it, or extract its images into a folder')
        width, height = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH,
                                                      cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PIXELS:
            raise KfvoError(f'{path}: expected frames of up to {MAX_PIXELS} pixels, came '
                            f'{width:.0f}x{height:.0f}')
        yield capture
    finally:
        capture.release()

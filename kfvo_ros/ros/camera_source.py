# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which camera takes the images: that of the calibration file, else of the CameraInfo topic."""

from __future__ import annotations

import threading

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from kfvo_ros.camera import Camera, read_camera_info
from kfvo_ros.config_files import find_config
from kfvo_ros.errors import KfvoError
from kfvo_ros.ros.following import WAITING, Following
from kfvo_ros.sequences.bag_camera import camera_from_info, camera_info_topic, is_rectified


class CameraSource:
    """The calibration of the images of `image_topic`; nothing is ever guessed.

    A `file`, also one of config/ by its name, wins over the `info_topic`, which is by default
    beside the images. Of a rectified topic's CameraInfo, P is taken. Raises KfvoError for a
    file that is none.
    """

    def __init__(self, node: Node, image_topic: str, info_topic: str = '',
                 file: str = '') -> None:
        self._rectified = is_rectified(image_topic)
        self._info: CameraInfo | None = None
        self._came = threading.Event()
        self._fixed = read_camera_info(find_config(file)) if file else None
        self._following = None
        self.name = file
        if self._fixed is None:
            self._following = Following(node, CameraInfo,
                                        info_topic or camera_info_topic(image_topic), 1,
                                        self._keep)
            self.name = self._following.topic

    def wait(self, seconds: float) -> None:
        """Wait so long at most for the first CameraInfo where one is to come.

        It may overtake, or be overtaken by, the image it was sent with.
        """
        if self._following is not None and self._following.reliability != WAITING:
            self._came.wait(seconds)

    def camera(self, width: int, height: int) -> Camera | None:
        """Return the camera of images of this size, None before there is a calibration.

        Raises KfvoError when the calibration cannot be that of such images.
        """
        camera = self._fixed
        if self._info is not None:
            try:
                camera = camera_from_info(self._info, self._rectified, width, height)
            except KfvoError as error:
                raise KfvoError(f'CameraInfo on {self.name}: {error}') from error
        return None if camera is None else camera.scaled(width, height)

    def problem(self) -> str:
        """Return why there is no calibration, and both remedies."""
        why = f'no calibration on {self.name}' if self._info is None else \
            f'the CameraInfo on {self.name} says uncalibrated (fx = 0)'
        return (f'{why}: publish a calibrated CameraInfo there (or set camera_info_topic), or set '
                'camera_info_file to a camera_info.yaml')

    def _keep(self, info: CameraInfo) -> None:
        self._info = info
        self._came.set()

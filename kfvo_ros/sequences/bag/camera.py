# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras from the CameraInfo messages of a bag."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import CAMERA_INFO, Bag


def read_bag_camera(bag: Bag, image_topic: str, width: int, height: int) -> Camera | None:
    """Return the camera of a topic's images, None where the bag has no calibration of it.

    CameraInfo is expected beside the images (/cam0/image_raw: /cam0/camera_info). Topics with
    ``rect`` in their name are rectified: their camera is P, without distortion. Raises KfvoError
    for an invalid CameraInfo.
    """
    info_topic = camera_info_topic(image_topic)
    if bag.topics.get(info_topic) != CAMERA_INFO:
        return None
    info = bag.first_message(info_topic)
    if bag.is_ros1:  # its message has K, D and P in upper case
        info = SimpleNamespace(**{name.lower(): value for name, value in vars(info).items()})
    try:
        return camera_from_info(info, is_rectified(image_topic), width, height)
    except KfvoError as error:
        raise KfvoError(f'{bag.path}, {info_topic}: {error}; '
                        'or give the calibration with --camera') from error


def camera_info_topic(image_topic: str) -> str:
    """Return the topic of the CameraInfo beside raw or compressed images."""
    return f"{_raw_topic(image_topic).rpartition('/')[0]}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Return whether the images of a topic are rectified, by the last part of its name."""
    return 'rect' in _raw_topic(image_topic).rpartition('/')[2]


def camera_from_info(info: Any, rectified: bool, width: int, height: int) -> Camera | None:
    """Return the camera of a sensor_msgs/CameraInfo, None for an uncalibrated one (fx = 0).

    `info` is any object with the message's fields. Its intrinsics are those of the full sensor;
    its region of interest and binning are applied when the image is not `width` x `height` of
    the full sensor. The image size replaces a size of zero.
    """
    matrix, columns = (info.p, 4) if rectified else (info.k, 3)
    fx, cx, fy, cy = (float(matrix[index]) for index in (0, 2, columns + 1, columns + 2))
    if fx == 0.0:
        return None
    distortion = ('none', ()) if rectified else (info.distortion_model,
                                                 tuple(map(float, info.d)))
    camera = Camera(int(info.width) or width, int(info.height) or height, fx, fy, cx, cy,
                    *distortion)
    if (width, height) == (camera.width, camera.height):
        return camera
    roi = info.roi
    if roi.width and roi.height:
        camera = camera.cropped(roi.x_offset, roi.y_offset, roi.width, roi.height)
    return camera.binned(max(info.binning_x, 1), max(info.binning_y, 1))


def _raw_topic(image_topic: str) -> str:
    return image_topic.removesuffix('/compressed')

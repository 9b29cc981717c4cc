# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera of a bag's images: its CameraInfo."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import CAMERA_INFO, Bag


def read_bag_camera(bag: Bag, image_topic: str, width: int, height: int) -> Camera | None:
    """Return the camera of a topic's images, None where the bag has no calibration of it.

    CameraInfo is looked for beside the images (/cam0/image_raw: /cam0/camera_info). Topics with
    ``rect`` in their name are rectified: their camera is P, without distortion.
    """
    info_topic = camera_info_topic(image_topic)
    if bag.topics.get(info_topic) != CAMERA_INFO:
        return None
    info = bag.first(info_topic)
    if bag.is_ros1:  # whose message calls them K, D and P
        info = SimpleNamespace(**{name.lower(): value for name, value in vars(info).items()})
    try:
        return camera_from_info(info, is_rectified(image_topic), width, height)
    except KfvoError as error:
        raise KfvoError(f'{bag.path}, {info_topic}: {error}; '
                        'or give the calibration with --camera') from error


def camera_info_topic(image_topic: str) -> str:
    """Return the topic of the CameraInfo beside raw or compressed images."""
    return f"{_raw(image_topic).rpartition('/')[0]}/camera_info"


def is_rectified(image_topic: str) -> bool:
    """Return whether the images of a topic are rectified, by its last name."""
    return 'rect' in _raw(image_topic).rpartition('/')[2]


def camera_from_info(info: Any, rectified: bool, width: int, height: int) -> Camera | None:
    """Return the camera of a sensor_msgs/CameraInfo, None where it says uncalibrated.

    Its numbers are those of the whole sensor; `width` and `height` of the image tell whether its
    region of interest and binning were applied to it. They stand in for a size it leaves zero.
    """
    matrix, columns = (info.p, 4) if rectified else (info.k, 3)
    fx, cx, fy, cy = (float(matrix[index]) for index in (0, 2, columns + 1, columns + 2))
    if fx == 0.0:
        return None
    lens = ('none', ()) if rectified else (info.distortion_model, tuple(map(float, info.d)))
    camera = Camera(int(info.width) or width, int(info.height) or height, fx, fy, cx, cy, *lens)
    if (width, height) == (camera.width, camera.height):
        return camera
    roi = info.roi
    if roi.width and roi.height:
        camera = camera.cropped(roi.x_offset, roi.y_offset, roi.width, roi.height)
    return camera.binned(max(info.binning_x, 1), max(info.binning_y, 1))


def _raw(image_topic: str) -> str:
    return image_topic.removesuffix('/compressed')

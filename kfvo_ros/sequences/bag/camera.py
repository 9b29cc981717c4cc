# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras from the CameraInfo messages of a bag."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace
from typing import Any

from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.reader import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, Bag
from kfvo_ros.sequences.calibration import CameraCalibration

RECTIFIED = re.compile(r'(?<![a-z])(rect(?!ang|or)|undist)')
"""In names such as image_rect_color, color/rect/image and image_undistorted."""
CAMERA_RECORD = 'kfvo_ros/camera'
"""MCAP metadata record with ``image_topic`` and ``readout_s`` [s] of a rolling shutter."""
MAX_INFOS = 300
"""Number of CameraInfo messages that are searched for a calibrated one."""
_log = logging.getLogger(__name__)


def read_bag_camera(bag: Bag, image_topic: str, width: int, height: int) -> Camera | None:
    """Return the camera of a topic's images, None where the bag has no calibration of it.

    It is that of the first calibrated message on the CameraInfo topic that belongs to the images,
    see `find_camera_info`; that of rectified images is P, without distortion. Raises KfvoError
    for an invalid CameraInfo.
    """
    topics = find_camera_info(bag, image_topic)
    for info_topic in topics:
        camera = _first_calibrated(bag, info_topic, is_rectified(image_topic), width, height)
        if camera is not None:
            readout = _recorded_readout(bag, image_topic)
            return camera if readout is None else replace(camera, readout_s=readout)
    others = [topic for topic in bag.topics_of_type(CAMERA_INFO) if topic not in topics]
    if topics or others:
        _log.warning('%s: no calibrated CameraInfo for %s (expected on %s); CameraInfo topics of '
                     'the bag: %s', bag.path, image_topic, camera_info_topic(image_topic),
                     ', '.join([*(f'{topic} (uncalibrated)' for topic in topics), *others]))
    return None


def find_camera_info(bag: Bag, image_topic: str) -> list[str]:
    """Return the CameraInfo topics of a bag that may belong to images, best first.

    They are those that drivers name so; else a single one with the same frame, or without one,
    that belongs by its name to no other images.
    """
    infos = bag.topics_of_type(CAMERA_INFO)
    named = [topic for topic in camera_info_topics(image_topic) if topic in infos]
    if named or not infos:
        return named
    taken = {name for topic in bag.topics_of_type(IMAGE, COMPRESSED_IMAGE)
             for name in camera_info_topics(topic)}
    free = [topic for topic in infos if topic not in taken]
    if len(free) != 1:
        return []
    frames = {bag.first_message(topic).header.frame_id.lstrip('/')
              for topic in (image_topic, free[0])}
    return free if len(frames - {''}) <= 1 else []


def camera_info_topic(image_topic: str) -> str:
    """Return the topic of the CameraInfo beside raw or compressed images."""
    return camera_info_topics(image_topic)[0]


def camera_info_topics(image_topic: str) -> list[str]:
    """Return the names under which drivers publish the CameraInfo of images.

    /cam0/image_raw: /cam0/camera_info (image_transport); /cam0/image_raw/camera_info (AirSim,
    ZED); /Color_0/image/data: /Color_0/info/camera_info (realsense-viewer).
    """
    raw = _raw_topic(image_topic)
    folder = raw.rpartition('/')[0]
    device = folder.rpartition('/')[0]
    return [f'{folder}/camera_info', f'{raw}/camera_info', f'{device}/info/camera_info',
            f'{raw}_info', f'{folder}/info']


def is_rectified(image_topic: str) -> bool:
    """Return whether the images of a topic are rectified, by the last two parts of its name."""
    return RECTIFIED.search('/'.join(_raw_topic(image_topic).lower().split('/')[-2:])) is not None


def camera_from_info(info: Any, rectified: bool, width: int, height: int) -> Camera | None:
    """Return the camera of a sensor_msgs/CameraInfo, None for an uncalibrated one (fx = 0).

    `info` is any object with the message's fields. Its intrinsics are those of the full sensor;
    its region of interest and binning are applied when the image is not `width` x `height` of
    the full sensor. The image size replaces a size of zero.
    """
    calibration = CameraCalibration(int(info.width) or width, int(info.height) or height, info.k,
                                    info.d, info.p, info.distortion_model)
    if calibration.matrix(rectified)[0, 0] == 0.0:
        return None
    camera = calibration.camera(rectified)
    if (width, height) == (camera.width, camera.height):
        return camera
    roi = info.roi
    if roi.width and roi.height:
        camera = camera.cropped(roi.x_offset, roi.y_offset, roi.width, roi.height)
    return camera.binned(max(info.binning_x, 1), max(info.binning_y, 1))


def _first_calibrated(bag: Bag, info_topic: str, rectified: bool, width: int, height: int
                      ) -> Camera | None:
    """Return the camera of the first calibrated message of a topic, None without one."""
    problem: KfvoError | None = None
    for _, info in islice(bag.messages(info_topic), MAX_INFOS):
        if bag.is_ros1:  # its message has K, D and P in upper case
            info = SimpleNamespace(**{name.lower(): value for name, value in vars(info).items()})
        try:
            camera = camera_from_info(info, rectified, width, height)
        except KfvoError as error:
            problem = problem or error
            continue
        if camera is not None:
            return camera
    if problem is not None:
        raise KfvoError(f'{bag.path}, {info_topic}: {problem}; '
                        'or give the calibration with --camera') from problem
    return None


def _recorded_readout(bag: Bag, image_topic: str) -> float | None:
    """Return the readout time [s] in a metadata record, which CameraInfo cannot hold."""
    for record in bag.metadata_records(CAMERA_RECORD):
        if record.get('image_topic') == image_topic:
            try:
                return float(record['readout_s'])
            except (KeyError, ValueError):
                _log.warning('%s: expected a number as readout_s of the metadata record %s, came '
                             '%r', bag.path, CAMERA_RECORD, record)
    return None


def _raw_topic(image_topic: str) -> str:
    return image_topic.removesuffix('/compressed')

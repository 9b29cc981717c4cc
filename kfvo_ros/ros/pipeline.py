# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From an image message to published poses; no error of one image ends the node."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, MemoryFullError, reason_of
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.online import OnlineOdometry, TrajectoryLog, free_path
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.ros.diagnostics import Diagnostics
from kfvo_ros.ros.messages import to_array, to_stamp_ns
from kfvo_ros.ros.options import NodeOptions
from kfvo_ros.ros.publishers import LOG_PERIOD_S, Publishers
from kfvo_ros.ros.subscriptions import CameraSource
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import NANOSECONDS

CAMERA_INFO_WAIT_S = 0.5
"""How long an image waits for the first CameraInfo, which is sent with it."""
DEFAULT_FILE = 'kfvo_trajectory.tum'
DEFAULT_CAMERA_FRAME = 'camera'
"""Optical frame of images whose header has none."""


class Pipeline:
    """Decodes, tracks and publishes one image at a time; methods may be called from any thread.

    A trajectory segment has one odometry and one trajectory file. It ends with `reset`, a stamp
    that goes back, another image size or another calibration; the next segment starts at the
    origin. Raises KfvoError for options that no odometry can be made of.
    """

    def __init__(self, node: Node, backbone: Backbone, odometry_options: OdometryOptions,
                 options: NodeOptions, camera_source: CameraSource, publishers: Publishers,
                 diagnostics: Diagnostics) -> None:
        self._logger = node.get_logger()
        self._odometry_options, self._options = odometry_options, options
        self._camera_source, self._publishers = camera_source, publishers
        self._diagnostics = diagnostics
        self.backbone = backbone
        self.policy_name = make_odometry(odometry_options, self.backbone).policy.name
        self._lock = threading.Lock()
        self._odometry: OnlineOdometry | None = None
        self._image_format: tuple[int, int, Camera | None] | None = None
        self._last_ns: int | None = None
        self._log = self._new_log()

    def handle(self, arrival: float, message: Image | CompressedImage) -> None:
        """Process an image that arrived at `arrival` [s, monotonic]; never raises."""
        if self.backbone.needs_camera:
            self._camera_source.wait(CAMERA_INFO_WAIT_S)
        with self._lock, self._errors_reported():
            self._process(arrival, message)

    def idle(self) -> None:
        """Bring the path up to date while no image comes; never raises."""
        with self._lock, self._errors_reported():
            if self._odometry is not None:
                self._publishers.publish_path(self._odometry.path)

    def reset(self, reason: str) -> None:
        """End the segment; the next image is the origin."""
        with self._lock:
            self._reset(reason)

    def save(self) -> str:
        """Write all poses of the segment to a new file; return a report. Raises KfvoError."""
        with self._lock:
            if self._odometry is None:
                raise KfvoError('there is no pose yet')
            path = free_path(Path(self._options.trajectory_file or DEFAULT_FILE).expanduser())
            count = self._odometry.save(path.absolute())
            return f'{count} poses written to {path.absolute()}'

    def finish(self) -> None:
        """End the segment and complete its trajectory file."""
        with self._lock:
            self._end_segment()
            self._log.close()

    @contextmanager
    def _errors_reported(self) -> Iterator[None]:
        """Log and count errors instead of raising them; an unexpected one ends the segment."""
        try:
            yield
        except MemoryFullError as error:
            self._count_refusal(error)
            self._logger.error(str(error), once=True)
        except KfvoError as error:
            self._count_refusal(error)
            self._logger.error(str(error), throttle_duration_sec=LOG_PERIOD_S)
        except Exception as error:
            self._count_refusal(error)
            self._logger.error(
                f'unexpected error, restarting at the origin:\n{traceback.format_exc()}',
                throttle_duration_sec=LOG_PERIOD_S)
            self._end_segment()

    def _process(self, arrival: float, message: Image | CompressedImage) -> None:
        """Run one image through the odometry and publish; raises KfvoError if it is refused."""
        stamp_ns = to_stamp_ns(message.header.stamp)
        self._check_stamp(stamp_ns)
        image = to_array(message)
        height, width = image.shape[:2]
        camera = self._find_camera(width, height)
        odometry = self._odometry
        if odometry is None or (width, height, camera) != self._image_format:
            odometry = self._start_segment(width, height, camera)
        self._last_ns = stamp_ns
        pose = odometry.process(Frame(stamp_ns, image, camera))
        camera_frame = (self._options.camera_frame or message.header.frame_id.lstrip('/')
                        or DEFAULT_CAMERA_FRAME)
        self._publishers.publish(pose, camera_frame)
        self._diagnostics.record_pose(arrival, pose.status, pose.is_keyframe, pose.intrinsics)
        self._publishers.publish_path(odometry.path)
        if self._log.problem is not None:
            self._logger.error(str(self._log.problem), once=True)

    def _check_stamp(self, stamp_ns: int) -> None:
        """Reset where the stamps go back; raise KfvoError for the stamp of the last image."""
        if self._last_ns is not None and stamp_ns < self._last_ns:
            self._reset(f'the stamps went back by {(self._last_ns - stamp_ns) / NANOSECONDS:.3f}'
                        ' s')
        elif stamp_ns == self._last_ns:
            raise KfvoError(f'two images have the stamp {stamp_ns} ns: the second is ignored')

    def _find_camera(self, width: int, height: int) -> Camera | None:
        """Return the camera of such images, None where the backbone needs no calibration."""
        if not self.backbone.needs_camera:
            return None
        camera = self._camera_source.camera(width, height)
        if camera is None:
            raise KfvoError(f'waiting: {self._camera_source.problem()}')
        return camera

    def _start_segment(self, width: int, height: int, camera: Camera | None) -> OnlineOdometry:
        """Start an odometry for this camera; end the one of another."""
        if self._odometry is not None:
            self._reset('the images have another size' if camera is None else
                        'the calibration changed')
        self._logger.info(f'images of {width}x{height}, ' + (
            'calibration not needed' if camera is None else
            f'fx {camera.fx:.1f}, fy {camera.fy:.1f}, {camera.distortion_model} distortion, from '
            f'{self._camera_source.name}'))
        self._image_format = width, height, camera
        self._odometry = OnlineOdometry(
            make_odometry(self._odometry_options, self.backbone), self._log, self._options.scale,
            self._options.path_max_length or None)
        return self._odometry

    def _reset(self, reason: str) -> None:
        self._logger.warning(f'restarting at the origin: {reason}')
        self._diagnostics.resets += 1
        self._end_segment()

    def _end_segment(self) -> None:
        self._last_ns = None
        if self._odometry is not None:
            self._odometry.finish()
            self._odometry = None
            try:
                self._log = self._new_log()
            except KfvoError as error:
                self._logger.error(str(error))
                self._log = TrajectoryLog()

    def _new_log(self) -> TrajectoryLog:
        """Return the trajectory log of a segment."""
        name = self._options.trajectory_file
        return TrajectoryLog(free_path(Path(name).expanduser()) if name else None)

    def _count_refusal(self, error: Exception) -> None:
        self._diagnostics.refused += 1
        self._diagnostics.problem = reason_of(error)

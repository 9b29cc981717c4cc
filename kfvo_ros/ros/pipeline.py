# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One image message to one pose message: whatever comes, the node lives on."""

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
from kfvo_ros.ros.publishers import QUIET_S, Publishers
from kfvo_ros.ros.subscriptions import CameraSource
from kfvo_ros.sequences.base import Frame
from kfvo_ros.trajectory import NANOSECONDS

CALIBRATION_WAIT_S = 0.5
"""An image waits so long for the CameraInfo that was sent with it."""
DEFAULT_FILE = 'kfvo_trajectory.tum'
NO_FRAME = 'camera'
"""The optical frame of images whose header names none."""


class Pipeline:
    """Decodes, places and publishes images one at a time; everything else may ask any time.

    A segment of odometry ends with `reset`, a stamp that goes back or another camera, and the
    next one begins at the origin. Raises KfvoError for what it cannot be made of.
    """

    def __init__(self, node: Node, backbone: Backbone, odometry: OdometryOptions,
                 options: NodeOptions, cameras: CameraSource, outputs: Publishers,
                 monitor: Diagnostics) -> None:
        self._logger = node.get_logger()
        self._odometry_options, self._options = odometry, options
        self._cameras, self._outputs, self._monitor = cameras, outputs, monitor
        self.backbone = backbone
        self.policy_name = make_odometry(odometry, self.backbone).policy.name
        self._lock = threading.Lock()
        self._live: OnlineOdometry | None = None
        self._seen: tuple[int, int, Camera | None] | None = None
        self._last_ns: int | None = None
        self._log = self._new_log()

    def handle(self, arrival: float, message: Image | CompressedImage) -> None:
        """Take in an image that arrived at `arrival` [s, monotonic]; never raises."""
        if self.backbone.needs_camera:
            self._cameras.wait(CALIBRATION_WAIT_S)
        with self._lock, self._surviving():
            self._handle(arrival, message)

    def idle(self) -> None:
        """Bring the path up to date when no image comes; never raises."""
        with self._lock, self._surviving():
            if self._live is not None:
                self._outputs.publish_path(self._live.path)

    def reset(self, reason: str) -> None:
        """Begin anew at the origin with the next image."""
        with self._lock:
            self._reset(reason)

    def save(self) -> str:
        """Write all poses of this segment to a new file; return what was done, or raise."""
        with self._lock:
            if self._live is None:
                raise KfvoError('there is no pose yet')
            path = free_path(Path(self._options.trajectory_file or DEFAULT_FILE).expanduser())
            count = self._live.save(path.absolute())
            return f'{count} poses written to {path.absolute()}'

    def finish(self) -> None:
        """Complete the trajectory file."""
        with self._lock:
            self._end_segment()
            self._log.close()

    @contextmanager
    def _surviving(self) -> Iterator[None]:
        """Tell of an error instead of raising it: a robot's odometry must not end by one."""
        try:
            yield
        except MemoryFullError as error:
            self._refuse(error)
            self._logger.error(str(error), once=True)
        except KfvoError as error:
            self._refuse(error)
            self._logger.error(str(error), throttle_duration_sec=QUIET_S)
        except Exception as error:
            self._refuse(error)
            self._logger.error(f'unexpected error, starting anew:\n{traceback.format_exc()}',
                               throttle_duration_sec=QUIET_S)
            self._end_segment()

    def _handle(self, arrival: float, message: Image | CompressedImage) -> None:
        stamp_ns = to_stamp_ns(message.header.stamp)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            self._reset(f'the stamps went back by {(self._last_ns - stamp_ns) / NANOSECONDS:.3f}'
                        ' s')
        elif stamp_ns == self._last_ns:
            raise KfvoError(f'two images have the stamp {stamp_ns} ns: the second is ignored')
        image = to_array(message)
        camera = None
        if self.backbone.needs_camera:
            camera = self._cameras.camera(image.shape[1], image.shape[0])
            if camera is None:
                raise KfvoError(f'waiting: {self._cameras.problem()}')
        live, seen = self._live, (image.shape[1], image.shape[0], camera)
        if live is None or seen != self._seen:
            live = self._begin(*seen)
        self._last_ns = stamp_ns
        pose = live.process(Frame(stamp_ns, image, camera))
        frame = self._options.camera_frame or message.header.frame_id.lstrip('/') or NO_FRAME
        self._outputs.publish(pose, frame)
        self._monitor.posed(arrival, pose.status, pose.is_keyframe, pose.intrinsics)
        self._outputs.publish_path(live.path)
        if self._log.problem is not None:
            self._logger.error(str(self._log.problem), once=True)

    def _begin(self, width: int, height: int, camera: Camera | None) -> OnlineOdometry:
        """Start a segment with this camera."""
        if self._live is not None:
            self._reset('the images have another size' if camera is None else
                        'the calibration changed')
        self._logger.info(f'images of {width}x{height}, ' + (
            'of whatever camera' if camera is None else
            f'fx {camera.fx:.1f}, fy {camera.fy:.1f}, {camera.distortion_model} distortion, from '
            f'{self._cameras.name}'))
        self._seen = width, height, camera
        self._live = OnlineOdometry(make_odometry(self._odometry_options, self.backbone), self._log,
                                    self._options.scale, self._options.path_max_length or None)
        return self._live

    def _reset(self, reason: str) -> None:
        self._logger.warning(f'starting anew at the origin: {reason}')
        self._monitor.resets += 1
        self._end_segment()

    def _end_segment(self) -> None:
        self._last_ns = None
        if self._live is not None:
            self._live.finish()
            self._live = None
            try:
                self._log = self._new_log()
            except KfvoError as error:
                self._logger.error(str(error))
                self._log = TrajectoryLog()

    def _new_log(self) -> TrajectoryLog:
        """Return the log of a segment: each has a file of its own."""
        name = self._options.trajectory_file
        return TrajectoryLog(free_path(Path(name).expanduser()) if name else None)

    def _refuse(self, error: Exception) -> None:
        self._monitor.refused += 1
        self._monitor.problem = reason_of(error)

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From an image message to published poses; no error of one image ends the node."""

from __future__ import annotations

import os
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.camera import Camera
from kfvo_ros.errors import KfvoError, MemoryFullError, reason_of
from kfvo_ros.odometry.factory import make_odometry
from kfvo_ros.odometry.online import OnlineOdometry, OnlinePose, TrajectoryLog, free_path
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.ros.diagnostics import Diagnostics
from kfvo_ros.ros.messages import to_array, to_stamp_ns
from kfvo_ros.ros.options import NodeOptions
from kfvo_ros.ros.publishers import LOG_PERIOD_S, Publishers
from kfvo_ros.ros.subscriptions import CameraSource
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.stamps import Accepted, StampFilter
from kfvo_ros.trajectory import NANOSECONDS
from kfvo_ros.utils.files import user_path

CAMERA_INFO_WAIT_S = 0.5
"""How long an image waits for the first CameraInfo, which is sent with it."""
DEFAULT_FILE = 'kfvo_trajectory.tum'
MAX_FAILED = 5
"""Frames in a row without a finite pose after which the odometry restarts."""
DEFAULT_CAMERA_FRAME = 'camera'
"""Optical frame of images whose header has none."""


class Arrival(NamedTuple):
    """When an image arrived: by time.monotonic and by the node's clock.

    ``clock_jumps`` counts how often that clock had gone back before.
    """

    monotonic_s: float
    clock_ns: int
    clock_jumps: int


class _Image(NamedTuple):
    """A decoded image: ``pixels`` (H, W) or (H, W, 3) RGB uint8."""

    arrival: Arrival
    pixels: np.ndarray
    frame_id: str


class Pipeline:
    """Decodes, tracks and publishes one image at a time; methods may be called from any thread.

    A trajectory segment has one odometry and one trajectory file. It ends with `reset`, stamps
    that go back for good, another image size or another calibration; the next segment starts at
    the origin. Raises KfvoError for options that no odometry can be made of.
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
        self._stamps: StampFilter[_Image] = StampFilter()
        diagnostics.left_out = self._stamps.left_out
        self._last_ns: int | None = None
        self._clock_jumps = 0
        file = options.trajectory_file
        if file and (file.endswith(os.sep) or user_path(file).is_dir()):
            raise KfvoError(f'parameter trajectory_file: expected a file, came the folder {file}; '
                            f'a file in it is {Path(file, DEFAULT_FILE)}')
        self._log = TrajectoryLog(self._log_path())

    def handle(self, arrival: Arrival, message: Image | CompressedImage) -> None:
        """Process an image, and those before it that waited for its stamp; never raises."""
        if self.backbone.needs_camera:
            self._camera_source.wait(CAMERA_INFO_WAIT_S)
        with self._lock:
            selected: list[Accepted[_Image]] = []
            with self._errors_reported():
                # What is no image says nothing of the clock either.
                image = _Image(arrival, to_array(message), message.header.frame_id)
                selected = self._select(to_stamp_ns(message.header.stamp), image)
            for accepted in selected:
                with self._errors_reported():
                    if accepted.restart:
                        self._reset_to(accepted.stamp_ns)
                    self._process(accepted.stamp_ns, accepted.item)

    def idle(self) -> None:
        """Bring path and trajectory file up to date while no image comes; never raises."""
        with self._lock, self._errors_reported():
            if self._odometry is not None:
                self._publishers.publish_path(self._odometry.path)
                self._log.append(())
                self._diagnostics.set_problem('log', self._log.problem)

    def reset(self, reason: str) -> None:
        """End the segment on request; the next image is the origin."""
        with self._lock:
            self._logger.warning(f'restarting at the origin: {reason}')
            self._diagnostics.record_reset(requested=True)
            self._stamps.reset()
            self._end_segment()

    def save(self) -> str:
        """Write all poses of the segment to a new file; return a report. Raises KfvoError."""
        with self._lock:
            if self._odometry is None:
                raise KfvoError('there is no pose yet')
            path = free_path(user_path(self._options.trajectory_file or DEFAULT_FILE))
            return self._odometry.save(path.absolute())

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
            self._diagnostics.record_refusal(reason_of(error))
            self._logger.error(str(error), once=True)
        except KfvoError as error:
            self._diagnostics.record_refusal(reason_of(error))
            self._logger.error(str(error), throttle_duration_sec=LOG_PERIOD_S)
        except Exception as error:
            self._diagnostics.record_refusal(reason_of(error))
            self._logger.error(
                f'unexpected error, restarting at the origin:\n{traceback.format_exc()}',
                throttle_duration_sec=LOG_PERIOD_S)
            self._diagnostics.record_reset(requested=False)
            self._end_segment()

    def _select(self, stamp_ns: int, image: _Image) -> list[Accepted[_Image]]:
        """Return the images to process now; restart where /clock and the stamps went back."""
        arrival = image.arrival
        if arrival.clock_jumps != self._clock_jumps:
            self._clock_jumps = arrival.clock_jumps
            if self._last_ns is not None and (stamp_ns or arrival.clock_ns) < self._last_ns:
                self._stamps.reset()
                self._reset_to(stamp_ns or arrival.clock_ns)
        left_out = self._stamps.left_out.total()
        by_arrival = self._stamps.by_arrival
        accepted = self._stamps.push(stamp_ns, image, arrival.clock_ns)
        if self._stamps.left_out.total() > left_out:
            self._diagnostics.set_problem('images', self._stamps.reason)
            self._logger.warning(self._stamps.reason, throttle_duration_sec=LOG_PERIOD_S)
        if self._stamps.by_arrival and not by_arrival:
            self._logger.warning('the stamps of the images are zero: poses have the times of '
                                 'arrival instead; set header.stamp in the camera driver',
                                 once=True)
        return accepted

    def _process(self, stamp_ns: int, image: _Image) -> None:
        """Run one image through the odometry and publish; raises KfvoError if it is refused."""
        height, width = image.pixels.shape[:2]
        camera = self._find_camera(width, height)
        odometry = self._odometry
        if odometry is None or (width, height, camera) != self._image_format:
            odometry = self._start_segment(width, height, camera)
        self._last_ns = stamp_ns
        pose = odometry.process(Frame(stamp_ns, image.pixels, camera))
        self._diagnostics.set_problem('log', self._log.problem)
        if self._log.problem:
            self._logger.error(self._log.problem, throttle_duration_sec=LOG_PERIOD_S)
        self._publish(odometry, pose, image.arrival, self._camera_frame(image.frame_id))
        if odometry.failed_in_a_row >= MAX_FAILED:
            self._reset(f'{MAX_FAILED} poses in a row are not finite')

    def _publish(self, odometry: OnlineOdometry, pose: OnlinePose, arrival: Arrival,
                 camera_frame: str) -> None:
        withheld = self._publishers.publish(pose, camera_frame)
        self._diagnostics.set_problem('mount', self._publishers.problem)
        if withheld:
            self._diagnostics.record_withheld(pose.status, withheld)
        else:
            self._diagnostics.record_pose(arrival.monotonic_s, pose.status, pose.is_keyframe,
                                          pose.intrinsics)
        if problem := withheld or self._publishers.problem:
            self._logger.warning(problem, throttle_duration_sec=LOG_PERIOD_S)
        self._publishers.publish_path(odometry.path)

    def _camera_frame(self, frame_id: str) -> str:
        """Return the optical frame of images, as TF has it; log once where it is not theirs."""
        if self._options.camera_frame:
            return self._options.camera_frame
        name = frame_id.strip().lstrip('/') or DEFAULT_CAMERA_FRAME
        if name != frame_id:
            self._logger.warning(f'the frame_id of the images is {frame_id!r}: {name} is used; '
                                 'camera_frame sets another', once=True)
        return name

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
        if not self._diagnostics.resets_repeat:  # else this would be a line for each image
            self._logger.info(f'images of {width}x{height}, ' + (
                'calibration not needed' if camera is None else
                f'fx {camera.fx:.1f}, fy {camera.fy:.1f}, {camera.distortion_model} distortion, '
                f'from {self._camera_source.name}'))
        self._image_format = width, height, camera
        self._odometry = OnlineOdometry(
            make_odometry(self._odometry_options, self.backbone), self._log, self._options.scale,
            self._options.path_max_length or None)
        return self._odometry

    def _reset_to(self, stamp_ns: int) -> None:
        """End the segment because the images are on an earlier clock."""
        back_s = ((self._last_ns or stamp_ns) - stamp_ns) / NANOSECONDS
        self._reset(f'the stamps went back by {back_s:.3f} s')

    def _reset(self, reason: str) -> None:
        self._logger.warning(f'restarting at the origin: {reason}',
                             throttle_duration_sec=LOG_PERIOD_S)
        self._diagnostics.record_reset(requested=False)
        self._end_segment()

    def _end_segment(self) -> None:
        """Complete the trajectory file; the next image starts a new one."""
        self._last_ns = None
        self._publishers.start_segment()
        odometry, self._odometry = self._odometry, None
        if odometry is None:
            return
        odometry.finish()
        if self._log.problem:
            self._logger.error(f'at the end of the segment: {self._log.problem}')
        self._log = TrajectoryLog(self._log_path(), deferred=True)

    def _log_path(self) -> Path | None:
        """Return a free name for the trajectory log of a segment, None for a temporary one."""
        name = self._options.trajectory_file
        return free_path(user_path(name)) if name else None

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS node: parameters, subscriptions, services, diagnostics; the pipeline does the work."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError, reason_of
from kfvo_ros.odometry.factory import make_backbone
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.ros.diagnostics import IMAGE_TIMEOUT_S, Diagnostics
from kfvo_ros.ros.frames import check_frames
from kfvo_ros.ros.messages import make_header
from kfvo_ros.ros.options import PARAMETERS, NodeOptions
from kfvo_ros.ros.parameters import read_parameters
from kfvo_ros.ros.pipeline import Arrival, Pipeline
from kfvo_ros.ros.publishers import Publishers
from kfvo_ros.ros.subscriptions import CameraSource, QosMatchingSubscription
from kfvo_ros.ros.worker import Worker

NODE_NAME = 'kfvo'
MAX_BACKLOG = 1000
"""Images that may wait with process_every_frame."""


class KfvoNode(Node):
    """Visual odometry of one camera.

    Raises KfvoError for invalid parameters. Call `close` before the node is destroyed.
    """

    def __init__(self) -> None:
        super().__init__(NODE_NAME)
        options, odometry, vggt = read_parameters(self, *PARAMETERS)
        options = check_frames(options, self.get_logger().warning)
        backbone = make_backbone(odometry, vggt)
        # After the model is loaded: time without images counts from here.
        self._diagnostics = Diagnostics()
        topic = self.resolve_topic_name(options.image_topic)
        camera_source = CameraSource(self, topic, options.camera_info_topic,
                                     options.camera_info_file)
        self._pipeline = Pipeline(self, backbone, odometry, options, camera_source,
                                  Publishers(self, options), self._diagnostics)
        size = MAX_BACKLOG if options.process_every_frame else options.queue_size
        self._worker = Worker(lambda item: self._pipeline.handle(*item), self._pipeline.idle, size)
        self._images = QosMatchingSubscription(
            self, (Image, CompressedImage), options.image_topic, max(size, 10), self._on_image,
            options.image_qos)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._constants = {'backbone': odometry.backbone,
                           'keyframe policy': self._pipeline.policy_name, 'version': __version__}
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/save_trajectory', self._on_save)
        self._clock_jumps = 0
        self._logged: set[str] = set()
        self._jump_handle = self.get_clock().create_jump_callback(  # rclpy does not keep it
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1)),
            post_callback=self._on_clock_jump)
        # Not the node's clock: simulated time may stand still.
        self.create_timer(1.0, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker.start()
        self._log_configuration(odometry, options, camera_source)

    def close(self) -> None:
        """Finish the frame in work, and the trajectory file."""
        self._worker.stop()
        self._pipeline.finish()

    def _log_configuration(self, odometry: OdometryOptions, options: NodeOptions,
                           camera_source: CameraSource) -> None:
        info = self.get_logger().info
        backbone = self._pipeline.backbone
        info(f'kfvo_ros {__version__}: {backbone.name} backbone '
             f'({", ".join(backbone.device_info().values())}), keyframes by '
             f'{self._pipeline.policy_name}, window of {odometry.window_size}')
        calibration = camera_source.name if backbone.needs_camera else 'not needed'
        info(f'images: {self._images.topic} (QoS {options.image_qos}), calibration: '
             f'{calibration}, frames: {options.odom_frame} -> '
             f'{options.base_frame or "<camera frame>_body"}')
        if options.scale == 1.0:
            info(f'the scale of a single camera is not metric: the unit is {backbone.unit}; set '
                 'scale [m per unit] where it is known')
        info('ready')

    def _on_image(self, message: Image | CompressedImage) -> None:
        arrival_s = self._diagnostics.record_image()
        self._diagnostics.lost_in_transit = self._images.lost
        if not self._diagnostics.paused:
            # Simulated time is zero before the first /clock.
            clock_ns = self.get_clock().now().nanoseconds or time.time_ns()
            self._diagnostics.dropped += self._worker.put(
                (Arrival(arrival_s, clock_ns, self._clock_jumps), message))

    def _on_clock_jump(self, jump: TimeJump) -> None:
        self._clock_jumps += 1

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def reset() -> str:
            self._pipeline.reset('requested')
            return 'the next image is the origin'
        return self._answer(response, reset)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._diagnostics.paused = bool(request.data)
        response.success = True
        response.message = 'paused' if request.data else 'running'
        self.get_logger().info(response.message)
        return response

    def _on_save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._answer(response, self._pipeline.save)
        self.get_logger().info(response.message)
        return response

    def _answer(self, response: Trigger.Response, action: Callable[[], str]) -> Trigger.Response:
        """Fill in the response of a service, also where `action` fails."""
        try:
            response.message, response.success = action(), True
        except KfvoError as error:
            response.message, response.success = str(error), False
        except Exception as error:  # else the caller would wait without end
            self.get_logger().error(f'unexpected error in a service:\n{traceback.format_exc()}')
            response.message, response.success = f'unexpected error: {reason_of(error)}', False
        return response

    def _on_timer(self) -> None:
        """Look for problems of the input; publish diagnostics."""
        diagnostics, topic = self._diagnostics, self._images.topic
        now_ns = self.get_clock().now().nanoseconds
        silence_s = diagnostics.seconds_without_image
        is_silent = silence_s > IMAGE_TIMEOUT_S and not diagnostics.paused
        reason = self._images.problem() if is_silent else ''
        diagnostics.set_problem('input', reason)
        if is_silent:
            self.get_logger().warning(
                f'no image on {topic} for {silence_s:.0f} s{": " if reason else ""}{reason}',
                throttle_duration_sec=IMAGE_TIMEOUT_S)
        publishers = self._images.publishers()
        self._warn_while(len(publishers) > 1, 'publishers', (
            f'{len(publishers)} publishers on {topic}, of {", ".join(publishers)}: expected one '
            'camera; remap the others'))
        has_waited = time.monotonic() - diagnostics.started > IMAGE_TIMEOUT_S
        self._warn_while(now_ns == 0 and has_waited, 'clock', (
            f'use_sim_time is set, but no /clock came for {IMAGE_TIMEOUT_S:.0f} s: play the bag '
            'with --clock, or unset use_sim_time'))
        diagnostics.waiting = self._worker.waiting
        self._diagnostics_publisher.publish(diagnostics.message(
            make_header(now_ns, ''), f'{self.get_fully_qualified_name()[1:]}: odometry', topic,
            self._constants | self._pipeline.backbone.device_info()))

    def _warn_while(self, condition: bool, kind: str, text: str) -> None:
        """Show a problem in the diagnostics while it lasts; log it when it begins."""
        self._diagnostics.set_problem(kind, text if condition else '')
        if condition and kind not in self._logged:
            self.get_logger().warning(text)
        (self._logged.add if condition else self._logged.discard)(kind)

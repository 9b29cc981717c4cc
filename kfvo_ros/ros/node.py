# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node: subscriptions, services, diagnostics. The work is done in its pipeline."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.odometry.factory import make_backbone
from kfvo_ros.odometry.options import OdometryOptions, VggtOptions
from kfvo_ros.ros.diagnostics import SILENCE_S, Diagnostics
from kfvo_ros.ros.messages import make_header
from kfvo_ros.ros.options import NodeOptions
from kfvo_ros.ros.parameters import read_parameters
from kfvo_ros.ros.pipeline import Pipeline
from kfvo_ros.ros.publishers import Publishers
from kfvo_ros.ros.subscriptions import CameraSource, QosMatchingSubscription
from kfvo_ros.ros.worker import Worker

NAME = 'kfvo'
BACKLOG = 1000
"""Images that may wait when every one is processed."""
COMPRESSED = '/compressed'


class KfvoNode(Node):
    """Visual odometry of one camera.

    Raises KfvoError for parameters that cannot be. `close` ends its work in good order.
    """

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        odometry, vggt, options = read_parameters(self, OdometryOptions, VggtOptions,
                                                  NodeOptions)
        backbone = make_backbone(odometry, vggt)
        self._monitor = Diagnostics()  # only now: until here no image could be waited for
        topic = self.resolve_topic_name(options.image_topic)
        cameras = CameraSource(self, topic, options.camera_info_topic, options.camera_info_file)
        self._pipeline = Pipeline(self, backbone, odometry, options, cameras,
                                  Publishers(self, options), self._monitor)
        size = BACKLOG if options.process_every_frame else options.queue_size
        self._worker = Worker(lambda item: self._pipeline.handle(*item), self._pipeline.idle, size)
        self._images = QosMatchingSubscription(
            self, CompressedImage if topic.endswith(COMPRESSED) else Image, options.image_topic,
            max(size, 10), self._on_image, options.image_qos)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._constants = {'backbone': odometry.backbone,
                           'keyframe policy': self._pipeline.policy_name, 'version': __version__}
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_service(Trigger, '~/save_trajectory', self._on_save)
        # Not the node's clock: simulated time may stand still.
        self.create_timer(1.0, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker.start()
        self._introduce(odometry, options, cameras)

    def close(self) -> None:
        """Finish the frame that is worked on and the trajectory file."""
        self._worker.stop()
        self._pipeline.finish()

    def _introduce(self, odometry: OdometryOptions, options: NodeOptions,
                   cameras: CameraSource) -> None:
        say = self.get_logger().info
        backbone = self._pipeline.backbone
        say(f'kfvo_ros {__version__}: {backbone.name} backbone '
            f'({", ".join(backbone.condition().values())}), keyframes by '
            f'{self._pipeline.policy_name}, window of {odometry.window_size}')
        calibration = cameras.name if backbone.needs_camera else 'not needed'
        say(f'images: {self._images.topic} (QoS {options.image_qos}), calibration: {calibration}, '
            f'frames: {options.odom_frame} -> {options.base_frame or "<camera frame>_body"}')
        if options.scale == 1.0:
            say(f'the scale of one camera is not metric: the unit is {backbone.unit}; set scale '
                '[m per unit] where it is known')
        say('ready')

    def _on_image(self, message: Image | CompressedImage) -> None:
        arrival = self._monitor.image()
        self._monitor.missed = self._images.lost
        if not self._monitor.paused:
            self._monitor.dropped += self._worker.put((arrival, message))

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._pipeline.reset('asked to')
        response.success, response.message = True, 'the next image is the origin'
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._monitor.paused = bool(request.data)
        response.success = True
        response.message = 'paused' if request.data else 'running'
        self.get_logger().info(response.message)
        return response

    def _on_save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = self._pipeline.save(), True
        except KfvoError as error:
            response.message, response.success = str(error), False
        self.get_logger().info(response.message)
        return response

    def _diagnose(self) -> None:
        monitor, topic = self._monitor, self._images.topic
        if monitor.silence > SILENCE_S and not monitor.paused:
            why = self._images.problem()
            self.get_logger().warning(
                f'no image on {topic} for {monitor.silence:.0f} s{": " if why else ""}{why}',
                throttle_duration_sec=SILENCE_S)
        now_ns = self.get_clock().now().nanoseconds
        if now_ns == 0 and time.monotonic() - monitor.started > SILENCE_S:
            self.get_logger().warning(
                f'use_sim_time is set, but no /clock came for {SILENCE_S:.0f} s: play the bag '
                'with --clock, or unset use_sim_time', once=True)
        self._diagnostics.publish(monitor.message(
            make_header(now_ns, ''), f'{self.get_name()}: odometry', topic,
            self._constants | self._pipeline.backbone.condition()))

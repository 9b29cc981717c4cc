# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test rig: a simulated camera, a kfvo_node in another process, and a listener to its topics."""

from __future__ import annotations

import signal
import threading
import time
from array import array
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from functools import cache
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from ros_processes import Listener, running_module, wait_until

from kfvo_ros import geometry
from kfvo_ros.camera import Camera
from kfvo_ros.sequences.base import Frame
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.trajectory import NANOSECONDS
from kfvo_ros.utils.process import time_limit

builtin_interfaces = pytest.importorskip('builtin_interfaces.msg')
diagnostic_msgs = pytest.importorskip('diagnostic_msgs.msg')
geometry_msgs = pytest.importorskip('geometry_msgs.msg')
nav_msgs = pytest.importorskip('nav_msgs.msg')
rosgraph_msgs = pytest.importorskip('rosgraph_msgs.msg')
sensor_msgs = pytest.importorskip('sensor_msgs.msg')
std_srvs = pytest.importorskip('std_srvs.srv')
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402

NODE = 'kfvo_ros.node'
IMAGE, INFO = '/camera/image_raw', '/camera/camera_info'
ODOMETRY, PATH, KEYFRAME = '/kfvo/odometry', '/kfvo/path', '/kfvo/keyframe'
DIAGNOSTICS = '/diagnostics'
WIDTH, HEIGHT, COUNT = 320, 240, 40
WARN = 1
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


@cache
def make_frames() -> tuple[Frame, ...]:
    """Render a smooth walk, once; the bundled policy makes some of its frames no keyframe."""
    return tuple(SyntheticSequence(2, 'smooth', COUNT, WIDTH, HEIGHT))


def stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def stamped(message: Any, stamp: int, frame_id: str = 'lens') -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
    message.header.frame_id = frame_id
    return message


def to_image(stamp: int, pixels: np.ndarray, encoding: str = 'mono8', step: int = 0,
             **fields: Any) -> Any:
    """Return a sensor_msgs/Image of rows of bytes (H, row); `fields` override its fields."""
    height, row = pixels.shape[:2]
    values = {'encoding': encoding, 'height': height, 'width': row, 'step': step or row,
              'data': array('B', np.ascontiguousarray(pixels).tobytes())} | fields
    return stamped(sensor_msgs.Image(**values), stamp)


def to_info(camera: Camera, stamp: int = 1) -> Any:
    """Return a sensor_msgs/CameraInfo."""
    return stamped(sensor_msgs.CameraInfo(
        width=camera.width, height=camera.height, distortion_model='plumb_bob', d=[0.0] * 5,
        k=camera.matrix.ravel(), p=np.hstack([camera.matrix, np.zeros((3, 1))]).ravel()), stamp)


def to_pose(pose: Any) -> np.ndarray:
    """Return (4, 4) of a geometry_msgs/Pose."""
    p, q = pose.position, pose.orientation
    return geometry.transform_from_xyz_quat(np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]))


def is_origin(message: Any) -> bool:
    """Return whether an Odometry is the identity."""
    return bool(np.allclose(to_pose(message.pose.pose), np.eye(4), atol=1e-12))


class Rig:
    """Runs a node with `parameters` inside ``with``; `image` and `info` publish as a camera does.

    The node must be ready within `timeout_s`. With `late_camera` the camera is advertised by
    `start_camera`. `env` is the node's environment. ``lines`` are the node's log. Use one at a
    time: two would receive each other's messages.
    """

    def __init__(self, image_type: Any = None, topic: str = IMAGE, qos: QoSProfile = RELIABLE,
                 late_camera: bool = False, timeout_s: float = 20.0,
                 env: dict[str, str] | None = None, **parameters: Any) -> None:
        self.listener = Listener({
            ODOMETRY: nav_msgs.Odometry, PATH: nav_msgs.Path, KEYFRAME: geometry_msgs.PoseStamped,
            DIAGNOSTICS: diagnostic_msgs.DiagnosticArray})
        self.lines: list[str] = []
        self._image_type, self._topic, self._qos = image_type or sensor_msgs.Image, topic, qos
        self._late_camera, self._timeout_s, self._env = late_camera, timeout_s, env
        parameters = {'process_every_frame': True} | parameters
        self._arguments = ['--ros-args', '-r', f'image:={topic}']
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else value
            self._arguments += ['-p', f'{name}:={text}']
        self._stack = ExitStack()

    def __enter__(self) -> Rig:
        try:
            self._start()
        except BaseException:  # then there is no __exit__
            self._stack.close()
            print(*self.lines, sep='')
            raise
        return self

    def _start(self) -> None:
        """Start the node and wait until it is ready."""
        self._stack.enter_context(self.listener)
        if not self._late_camera:
            self.start_camera()
        self.process = self._stack.enter_context(
            running_module(NODE, *self._arguments, env=self._env))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.wait_for_line('ready', self._timeout_s)
        wait_until(lambda: self.listener.node.count_publishers(ODOMETRY))
        if not self._late_camera:
            self.wait_for_subscriber()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        try:
            self.stop()
        finally:
            self._stack.close()

    def start_camera(self) -> None:
        """Advertise images and calibration."""
        self.image = self.listener.node.create_publisher(self._image_type, self._topic, self._qos)
        self.info = self.listener.node.create_publisher(sensor_msgs.CameraInfo, INFO, 10)

    def stop_camera(self) -> None:
        """End both publishers."""
        self.listener.node.destroy_publisher(self.image)
        self.listener.node.destroy_publisher(self.info)

    def wait_for_subscriber(self) -> None:
        """Wait until the node subscribes to the images, and to the calibration if it needs one."""
        wait_until(self.image.get_subscription_count)
        if not any('camera_info_file' in argument for argument in self._arguments):
            wait_until(self.info.get_subscription_count)

    def send(self, frames: Iterable[Frame], with_info: bool = True) -> None:
        """Publish grey frames, each with its CameraInfo."""
        for frame in frames:
            if with_info:
                self.info.publish(to_info(frame.camera, frame.stamp_ns))
            self.image.publish(to_image(frame.stamp_ns, frame.image))

    def send_until_odometry(self, frames: Sequence[Frame]) -> None:
        """Send frames repeatedly with increasing stamps until a pose arrives.

        The node may discover the camera later than the camera discovers the node.
        """
        for index in range(100):
            frame = frames[index % len(frames)]
            self.send([Frame(frame.stamp_ns + index * NANOSECONDS, frame.image, frame.camera)])
            if self.odometry():
                return
            time.sleep(0.05)

    def run(self, frames: Sequence[Frame]) -> list[Any]:
        """Send frames and return their Odometry messages."""
        before = len(self.odometry())
        self.send(frames)
        return self.odometry(before + len(frames))[before:]

    def odometry(self, count: int = 0) -> list[Any]:
        """Return all Odometry messages once there are at least `count`."""
        wait_until(lambda: len(self.listener.messages(ODOMETRY)) >= count)
        return self.listener.messages(ODOMETRY)

    def state(self) -> tuple[int, str, dict[str, str]]:
        """Return level, message and values of the latest diagnostics."""
        wait_until(lambda: self.listener.messages(DIAGNOSTICS))
        status, = self.listener.messages(DIAGNOSTICS)[-1].status
        return (int.from_bytes(status.level, 'little'), status.message,
                {pair.key: pair.value for pair in status.values})

    def wait_for_value(self, key: str, value: object) -> None:
        """Wait until the diagnostics show this value."""
        wait_until(lambda: self.state()[2][key] == str(value))

    def wait_for_line(self, part: str, timeout_s: float = 20.0) -> str:
        """Wait until the node logs a line with this part; return the line."""
        wait_until(lambda: any(part in line for line in self.lines), timeout_s)
        return next(line for line in self.lines if part in line)

    def call(self, service: Any, name: str, **request: Any) -> Any:
        """Call a service of the node; return its response."""
        client = self.listener.node.create_client(service, f'/kfvo/{name}')
        assert client.wait_for_service(time_limit(10.0))
        future = client.call_async(service.Request(**request))
        wait_until(future.done)
        return future.result()

    def reset(self) -> None:
        """Reset the node and forget all received messages."""
        assert self.call(std_srvs.Trigger, 'reset').success
        self.listener.received.clear()

    def stop(self, sent: signal.Signals = signal.SIGINT) -> float:
        """Stop the node; return how long that took [s]."""
        began = time.monotonic()
        if self.process.poll() is None:
            self.process.send_signal(sent)
        self.process.wait(time_limit(10.0))
        took = time.monotonic() - began
        self._reader.join()
        return took

    def _read(self) -> None:
        for line in self.process.stderr:
            self.lines.append(line)

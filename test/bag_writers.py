# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 1 and ROS 2 bags, written for the tests of the readers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sequence_writers import HEIGHT, WIDTH, make_image, make_poses, pose_numbers

from kfvo_ros.camera import Camera
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.bag.sequence import BagSequence

STORAGES = ('ros1', 'sqlite3', 'mcap')

START_NS = 1403715273262142977  # no float64 holds this number
COUNT = 5
STAMPS_NS = [START_NS + 50_000_000 * index for index in range(COUNT)]
LATER_NS = 3_000_000  # recording delay: bag time is later than the stamp
POSES = make_poses(COUNT)
PINHOLE = Camera(WIDTH, HEIGHT, 99.0, 99.0, 16.0, 12.0)

Records = list[tuple[str, int, Any]]


class BagBuilder:
    """Builds ROS 1 or ROS 2 messages and writes them as a bag of one of STORAGES."""

    def __init__(self, storage: str) -> None:
        self.storage = storage
        self.is_ros1 = storage == 'ros1'
        self.empty_topics: dict[str, str] = {}  # topic -> type, without messages
        self.offers: dict[str, dict[str, Any]] = {}  # topic -> QoS arguments of add_connection
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_JAZZY)
        if self.is_ros1:
            for name in ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'):
                self.store.register(get_types_from_msg(
                    'geometry_msgs/TransformStamped[] transforms', name))

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message, e.g. make('geometry_msgs/Point', x=1.0, y=2.0, z=3.0)."""
        package, name = kind.split('/')
        return self.store.types[f'{package}/msg/{name}'](**fields)

    def header(self, stamp_ns: int, frame_id: str = 'camera') -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10 ** 9)
        stamp = self.make('builtin_interfaces/Time', sec=seconds, nanosec=nanoseconds)
        extra = {'seq': 0} if self.is_ros1 else {}
        return self.make('std_msgs/Header', stamp=stamp, frame_id=frame_id, **extra)

    def image(self, stamp_ns: int, image: np.ndarray, frame_id: str = 'camera',
              encoding: str | None = None) -> Any:
        return self.make(
            'sensor_msgs/Image', header=self.header(stamp_ns, frame_id), height=image.shape[0],
            width=image.shape[1], encoding=encoding or ('mono8' if image.ndim == 2 else 'rgb8'),
            is_bigendian=0, step=image[0].nbytes, data=image.reshape(-1).view(np.uint8))

    def compressed(self, stamp_ns: int, image: np.ndarray, format: str = 'png') -> Any:
        bgr = image if image.ndim == 2 else image[..., ::-1]
        return self.make('sensor_msgs/CompressedImage', header=self.header(stamp_ns),
                         format=format, data=cv2.imencode('.png', bgr)[1].reshape(-1))

    def camera_info(self, fx: float, *, projection_fx: float = 0.0, width: int = WIDTH,
                    height: int = HEIGHT, distortion: Iterable[float] = (), binning: int = 0,
                    roi: tuple[int, int, int, int] = (0, 0, 0, 0)) -> Any:
        K = np.array([fx, 0, 16, 0, fx, 12, 0, 0, 1], dtype=np.float64)
        P = np.array([projection_fx, 0, 15, 0, 0, projection_fx, 11, 0, 0, 0, 1, 0], dtype=float)
        matrices = {'k': K, 'p': P, 'r': np.eye(3).ravel(), 'd': np.array([*distortion], float)}
        if self.is_ros1:
            matrices = {name.upper(): value for name, value in matrices.items()}
        x, y, across, down = roi
        region = self.make('sensor_msgs/RegionOfInterest', x_offset=x, y_offset=y,
                           width=across, height=down, do_rectify=False)
        return self.make('sensor_msgs/CameraInfo', header=self.header(0), height=height,
                         width=width, distortion_model='plumb_bob', binning_x=binning,
                         binning_y=binning, roi=region, **matrices)

    def point(self, xyz: Iterable[float], kind: str = 'Point') -> Any:
        x, y, z = map(float, xyz)
        return self.make(f'geometry_msgs/{kind}', x=x, y=y, z=z)

    def quaternion(self, quat_xyzw: Iterable[float]) -> Any:
        x, y, z, w = map(float, quat_xyzw)
        return self.make('geometry_msgs/Quaternion', x=x, y=y, z=z, w=w)

    def pose(self, pose: np.ndarray) -> Any:
        values = pose_numbers(pose)
        return self.make('geometry_msgs/Pose', position=self.point(values[:3]),
                         orientation=self.quaternion(values[3:]))

    def pose_with_covariance(self, pose: np.ndarray) -> Any:
        return self.make('geometry_msgs/PoseWithCovariance', pose=self.pose(pose),
                         covariance=np.zeros(36))

    def pose_stamped(self, stamp_ns: int, pose: np.ndarray) -> Any:
        return self.make('geometry_msgs/PoseStamped', header=self.header(stamp_ns, 'world'),
                         pose=self.pose(pose))

    def pose_with_covariance_stamped(self, stamp_ns: int, pose: np.ndarray) -> Any:
        return self.make('geometry_msgs/PoseWithCovarianceStamped',
                         header=self.header(stamp_ns, 'world'),
                         pose=self.pose_with_covariance(pose))

    def odometry(self, stamp_ns: int, pose: np.ndarray, child: str = 'body') -> Any:
        zero = self.point(np.zeros(3), 'Vector3')
        twist = self.make('geometry_msgs/TwistWithCovariance', covariance=np.zeros(36),
                          twist=self.make('geometry_msgs/Twist', linear=zero, angular=zero))
        return self.make('nav_msgs/Odometry', header=self.header(stamp_ns, 'world'),
                         child_frame_id=child, pose=self.pose_with_covariance(pose), twist=twist)

    def point_stamped(self, stamp_ns: int, pose: np.ndarray) -> Any:
        return self.make('geometry_msgs/PointStamped', header=self.header(stamp_ns, 'world'),
                         point=self.point(pose[:3, 3]))

    def transform(self, stamp_ns: int, pose: np.ndarray, child: str = 'body',
                  parent: str = 'world') -> Any:
        values = pose_numbers(pose)
        transform = self.make('geometry_msgs/Transform',
                              translation=self.point(values[:3], 'Vector3'),
                              rotation=self.quaternion(values[3:]))
        return self.make('geometry_msgs/TransformStamped', child_frame_id=child,
                         header=self.header(stamp_ns, parent), transform=transform)

    def transforms(self, *transforms: Any, kind: str = 'tf2_msgs/TFMessage') -> Any:
        return self.make(kind, transforms=list(transforms))

    def write(self, path: Path, records: Iterable[tuple[str, int, Any]]) -> Path:
        """Write records (topic, bag time [ns], message) and return the path of the bag."""
        if self.is_ros1:
            path = path.with_name(f'{path.name}.bag')
            writer = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin[self.storage.upper()]
            writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        with writer:
            connections: dict[str, Any] = {}
            for topic, kind in self.empty_topics.items():
                writer.add_connection(topic, kind, typestore=self.store)
            for topic, bag_time_ns, message in records:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(
                        topic, kind, typestore=self.store, **self.offers.get(topic, {}))
                serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
                writer.write(connections[topic], bag_time_ns, serialize(message, kind))
        return path


def images(writer: BagBuilder, topic: str = '/cam0/image_raw', frame_id: str = 'camera',
           colour: bool = False) -> Records:
    """Return one image message per stamp."""
    return [(topic, stamp + LATER_NS, writer.image(stamp, make_image(index, colour), frame_id))
            for index, stamp in enumerate(STAMPS_NS)]


def truth_records(writer: BagBuilder, topic: str, make: Any, poses: np.ndarray = POSES) -> Records:
    """Return one message per stamp, from `make(stamp_ns, pose)`."""
    return [(topic, stamp + LATER_NS, make(stamp, pose)) for stamp, pose in zip(STAMPS_NS, poses)]


def open_bag(writer: BagBuilder, folder: Path, *records: Records, **options: Any) -> BagSequence:
    """Write a bag of the records and open it, with a pinhole camera by default."""
    path = writer.write(folder / 'walk', [record for part in records for record in part])
    return open_sequence(str(path), **{'camera': PINHOLE, **options})

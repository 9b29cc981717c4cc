# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of the node and of the player; the node's are its ROS parameters.

Needs no rclpy: command lines, launch files and documents read them too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from kfvo_ros.odometry.options import OdometryOptions, VggtOptions
from kfvo_ros.utils.config import Option, option, options_of


@dataclass(frozen=True)
class NodeOptions:
    """What kfvo_node subscribes to and publishes."""

    image_topic: str = option(
        'image', 'images to follow, Image or CompressedImage; remapping image does the same')
    image_qos: str = option(
        'auto', "reliability of the subscription; auto follows the publisher's",
        ('auto', 'reliable', 'best_effort'))
    camera_info_topic: str = option('', 'calibration; empty: camera_info beside the images')
    camera_info_file: str = option(
        '', 'calibration file (camera_info.yaml), which wins over the topic')
    queue_size: int = option(
        1, 'images that may wait while one is processed; the oldest of more are dropped',
        least=1, most=1000)
    process_every_frame: bool = option(
        False, 'drop nothing and lag behind instead, for bags (up to 1000 images)')
    odom_frame: str = option('odom', 'frame in which poses are given: the base at the first image')
    base_frame: str = option(
        '', 'frame whose pose is given, such as base_link; empty: the camera, turned to x '
        'forward, y left, z up, called <camera frame>_body')
    base_to_camera: str = option(
        '', 'where the camera is on the base: "x y z qx qy qz qw"; empty: from TF')
    camera_frame: str = option('', "optical frame of the camera; empty: the images' frame_id")
    scale: float = option(
        1.0, "metres per unit of the trajectory; of the geometric backbone the unit is the first "
        "scene's median depth",
        least=1e-9, most=1e9)
    publish_tf: bool = option(True, 'send the pose as TF too')
    path_max_length: int = option(1000, 'poses in the path; 0: all', least=0)
    path_rate: float = option(2.0, 'paths per second at most [Hz]', least=0.01, most=100.0)
    trajectory_file: str = option(
        '', 'TUM file that grows as poses become final; a number is added to a name that is taken')


@dataclass(frozen=True)
class PlayOptions:
    """What kfvo_play publishes of a bag, and how."""

    topic: tuple[str, ...] = option(
        (), 'play only this topic; may be given several times. Default: all topics, but of '
        'several image topics only the first by name')
    rate: float = option(1.0, 'speed; 2 is twice as fast as recorded', least=1e-3, most=1e3)
    start: float = option(0.0, 'start this far into the bag [s]', least=0.0, most=1e9)
    duration: float | None = option(None, 'play this much of the bag [s]; default: all',
                                    least=1e-3, most=1e9)
    loop: bool = option(False, 'start again at the end, until interrupted')
    clock: float | None = option(None, 'publish the time of the bag on /clock at this rate [Hz]; '
                                 '40 without a value', least=1e-3, most=1e3, bare=40.0)
    wait_for_subscribers: int | None = option(
        None, 'start when the image topic has this many subscribers (without images: each '
        'topic); '
        '1 without a value', least=1, bare=1)
    wait_for_processing: bool = option(
        False, 'at the end wait until the running kfvo_node has processed all images')


PARAMETERS = (NodeOptions, OdometryOptions, VggtOptions)
"""The options dataclasses whose fields are the parameters of kfvo_node."""


def node_parameters() -> tuple[Option, ...]:
    """Return all parameters of kfvo_node, in the order of its documentation."""
    return tuple(declared for kind in PARAMETERS for declared in options_of(kind))


def describe(parameters: Iterable[Option]) -> str:
    """Return a text with a line for each parameter: name, meaning, choices and default."""
    return '\n'.join(
        f'  {each.name}: {each.description}'
        + (f' ({", ".join(each.choices)})' if each.choices else '')
        + (f' [{each.default}]' if each.default not in (None, '') else '')
        for each in parameters)

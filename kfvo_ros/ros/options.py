# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from dataclasses of options: declared, described, checked in readable lines."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from kfvo_ros.utils.config import option


@dataclass(frozen=True)
class PlayOptions:
    """What of a bag is played, and how."""

    topic: tuple[str, ...] = option(
        (), 'play only this topic; may be given several times. Default: all topics, but of '
        'several image topics only the first by name')
    rate: float = option(1.0, 'speed; 2 is twice as fast as recorded', least=1e-3, most=1e3)
    start: float = option(0.0, 'skip so much of the beginning of the bag [s]', least=0.0, most=1e9)
    duration: float | None = option(None, 'play so much of the bag [s]; default: all',
                                    least=1e-3, most=1e9)
    loop: bool = option(False, 'begin again at the end, until interrupted')
    clock: float | None = option(None, 'publish the time of the bag on /clock, so often [Hz]; '
                                 '40 without a value', least=1e-3, most=1e3, bare=40.0)
    wait_for_subscribers: int | None = option(
        None, 'begin when the image topic has so many subscribers (without images: every topic); '
        '1 without a value', least=1, bare=1)


@dataclass(frozen=True)
class NodeOptions:
    """What the node listens to, and what it says."""

    image_topic: str = option(
        'image', 'images to follow; remapping image does the same. Ends in /compressed for '
        'sensor_msgs/CompressedImage')
    image_qos: str = option(
        'auto', "reliability of the subscription; auto follows the publisher's",
        ('auto', 'reliable', 'best_effort'))
    camera_info_topic: str = option('', 'calibration; empty: camera_info beside the images')
    camera_info_file: str = option(
        '', 'calibration file (camera_info.yaml), which wins over the topic')
    queue_size: int = option(
        1, 'images that may wait while one is worked on; of more, the oldest are dropped',
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


def describe(*kinds: type[Any]) -> str:
    """Return a text that lists the parameters, their defaults and their meaning."""
    return '\n'.join(
        f'  {declared.name}: {declared.metadata["description"]}'
        + (f' ({", ".join(declared.metadata["choices"])})' if declared.metadata['choices'] else '')
        + (f' [{declared.default}]' if declared.default not in (None, '') else '')
        for kind in kinds for declared in fields(kind))

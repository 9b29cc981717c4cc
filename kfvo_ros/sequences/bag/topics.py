# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice of the image topic of a bag, and names of topics that ROS 2 allows."""

from __future__ import annotations

import logging
import re
from typing import Any

from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.bag.camera import find_camera_info
from kfvo_ros.sequences.bag.reader import COMPRESSED_IMAGE, IMAGE, Bag

IMAGE_TYPES = frozenset((IMAGE, COMPRESSED_IMAGE))
AUXILIARY = re.compile(r'depth(?!ai)|confidence|disparit|label|mask|segment|semantic')
"""In the names of images that are no photographs."""
INFRARED = re.compile(r'infra|(?<![a-z])ir(?![a-z])')
"""In the names of images that often show a projected pattern."""
COLOUR = re.compile(r'rgb|bgr|bayer|yuv|uyvy|yuyv|nv12|nv21|nv24|8uc[34]')
MEASUREMENT = re.compile(r'(32f|32s|64f|16s)c?1?(;|$)|.*compresseddepth')
"""Encodings of depth and other measurements, not of brightness."""
_LEGAL = re.compile(r'(?!.*__)(/[A-Za-z_][A-Za-z0-9_]*)+')
_log = logging.getLogger(__name__)


def choose_image_topic(bag: Bag, topic: str | None) -> str:
    """Return the requested topic, else the first of `rank_image_topics`, and log the others.

    Raises KfvoError where there is none; depth and confidence images are used only on request.
    """
    if topic is not None:
        return bag.find_topic(topic, IMAGE_TYPES, 'images')
    usable, unusable = rank_image_topics(bag)
    if not usable and unusable:
        raise KfvoError(f'{bag.path}: expected images of a camera, the image topics seem to hold '
                        f'depth or other measurements: {", ".join(unusable)}; ask for one with '
                        '--image-topic')
    if not usable:
        raise KfvoError(f'{bag.path}: expected a topic of type {IMAGE} or {COMPRESSED_IMAGE}; its '
                        f'topics are: {", ".join(sorted(bag.topics)) or "none"}'
                        f'{bag.problems()}')
    if others := [*usable[1:], *unusable]:
        _log.info('%s: using the images of %s; others are: %s (choose by --image-topic)',
                  bag.path, usable[0], ', '.join(others))
    return usable[0]


def rank_image_topics(bag: Bag) -> tuple[list[str], list[str]]:
    """Return the topics with images of cameras, best first, and those with measurements.

    Topics with CameraInfo and with many messages come first, infrared images late.
    """
    topics = bag.topics_of_type(*IMAGE_TYPES)
    encodings = {topic: _encoding(bag, topic) for topic in topics}
    most = max((bag.count(topic) for topic in topics), default=0)

    def rank(topic: str) -> tuple[bool | str, ...]:
        name = topic.lower()
        return (AUXILIARY.search(name) is not None, INFRARED.search(name) is not None,
                not find_camera_info(bag, topic), 2 * bag.count(topic) < most,
                encodings[topic] in ('16uc1', '16uc'), topic)

    unusable = [topic for topic in topics if MEASUREMENT.match(encodings[topic]) or (
        AUXILIARY.search(topic.lower()) and not COLOUR.match(encodings[topic]))]
    return sorted(set(topics) - set(unusable), key=rank), sorted(unusable, key=rank)


def legal_topic(name: str) -> str:
    """Return a name of a topic of ROS 1 as ROS 2 allows it: /mocap/1/pose: /mocap/id_1/pose."""
    if is_legal_topic(name):
        return name
    parts = [re.sub('_+', '_', re.sub(r'[^A-Za-z0-9_]', '_', part)) for part in name.split('/')]
    return ''.join(f'/id_{part}' if part[0].isdigit() else f'/{part}' for part in parts if part)


def is_legal_topic(name: str) -> bool:
    """Return whether ROS 2 allows an absolute topic name."""
    return _LEGAL.fullmatch(name) is not None


def _encoding(bag: Bag, topic: str) -> str:
    """Return the encoding of a topic's first image in lower case, '' where it cannot be read."""
    try:
        first: Any = bag.first_message(topic)
    except KfvoError:
        return ''
    text = first.format if first.__msgtype__ == COMPRESSED_IMAGE else first.encoding
    return str(text).strip().lower()

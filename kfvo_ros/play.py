# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.play BAG``: publish a bag of ROS 2 or ROS 1 on ROS topics."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.signals import Interrupted

EXAMPLES = """examples:
  python -m kfvo_ros.play MH_01_easy.bag --wait-for-subscribers
  python -m kfvo_ros.play MH_01_easy.bag --start 40 --duration 20 --loop --clock
  python -m kfvo_ros.play demo/bag --topic /cam0/image_raw --rate 0.5
  python -m kfvo_ros.play MH_01_easy.bag --ros-args -r /cam0/image_raw:=/image
"""
_log = logging.getLogger('kfvo_ros.play')  # __name__ may be __main__


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    # Unlike the other commands it logs at level INFO, without the level in each line.
    logging.basicConfig(format='kfvo_play: %(message)s', level=logging.WARNING)
    logging.getLogger('kfvo_ros').setLevel(logging.INFO)
    return run_command('kfvo_play', _run, argv, until_stopped=True)


def _run(argv: list[str]) -> None:
    # Heavy imports after the check of the arguments: --help answers at once.
    from kfvo_ros.ros.options import PlayOptions
    from kfvo_ros.utils.config import from_arguments
    arguments = _parse(argv)
    options = from_arguments(PlayOptions, arguments)
    from kfvo_ros.ros.player import Player, make_node
    from kfvo_ros.ros.runtime import spinning_node
    from kfvo_ros.sequences.bag.reader import Bag
    with Bag(Path(arguments.bag)) as bag:
        topics = _choose_topics(bag, options.topic)
        with spinning_node(make_node, argv) as node:
            player = Player(node, bag, topics, options)
            try:
                player.play()
                ending = ''
            except Interrupted:
                ending = f', interrupted at {player.position_s:.1f} s'
    print(f'{player.published} messages published{ending}')


def _parse(argv: list[str]) -> argparse.Namespace:
    from kfvo_ros.ros.options import PlayOptions
    from kfvo_ros.utils.config import add_arguments
    parser = make_parser('kfvo_play', 'Play a bag onto ROS topics.', EXAMPLES)
    parser.add_argument('bag', help='ROS 1 .bag, ROS 2 folder with metadata.yaml, .mcap or .db3')
    add_arguments(parser, PlayOptions)
    if '--ros-args' in argv:
        from kfvo_ros.ros.runtime import remove_ros_arguments
        argv = remove_ros_arguments(argv)
    return parser.parse_args(argv)


def _choose_topics(bag: Any, wanted: tuple[str, ...]) -> list[str]:
    """Return the wanted topics, by default all but the image topics after the first."""
    if wanted:
        return [_find_topic(bag, topic) for topic in dict.fromkeys(wanted)]
    if not bag.topics:
        raise KfvoError(f'{bag.path} holds no messages')
    from kfvo_ros.sequences.bag.topics import rank_image_topics
    images = [topic for topics in rank_image_topics(bag) for topic in topics]
    if images[1:]:
        _log.info('of the image topics only %s is played; --topic plays others: %s', images[0],
                  ', '.join(images[1:]))
    return [topic for topic in bag.topics if topic not in images[1:]]


def _find_topic(bag: Any, topic: str) -> str:
    """Return the name of a topic of the bag, with or without its leading slash."""
    name = f'/{topic.lstrip("/")}'
    if name not in bag.topics:
        raise KfvoError(f'{bag.path} has no messages on {topic}; its topics are: '
                        f'{", ".join(sorted(bag.topics)) or "none"}')
    return name


if __name__ == '__main__':
    sys.exit(main())

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.convert SEQUENCE BAG``: write any sequence as a ROS 2 bag."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.progress import progress
from kfvo_ros.utils.signals import Interrupted, interrupted, raise_if_interrupted

if TYPE_CHECKING:
    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.sequences.base import Sequence

EXAMPLES = """examples:
  python -m kfvo_ros.convert V1_01_easy bags/V1_01 --topic /cam0/image_raw
  python -m kfvo_ros.convert MH_01_easy.bag bags/MH_01 --camera config/euroc_cam0.yaml
  python -m kfvo_ros.convert rgbd_dataset_freiburg1_desk bags/fr1_desk --compressed

The bag is a folder with an MCAP file and metadata.yaml. It holds the images of one camera, its
CameraInfo unless that was guessed, and ground truth and /tf_static where the sequence has them.
Other topics of a source bag (IMU, other cameras) are not copied. Bag time is the image stamp.
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_convert', _convert, argv)


def _convert(argv: list[str]) -> None:
    # Slow imports follow the checks of the arguments, so that --help and errors are immediate.
    arguments = _parse(argv)
    from kfvo_ros.odometry.options import SequenceOptions
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.utils.config import from_arguments
    from kfvo_ros.utils.files import locked
    options = from_arguments(SequenceOptions, arguments)
    writer = BagWriter(Path(os.path.abspath(arguments.bag)), arguments.zstd,
                       arguments.metadata_version)
    from kfvo_ros.odometry.factory import make_sequence
    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.base import choices_logged
    with choices_logged():
        sequence = make_sequence(arguments.sequence, options)
        recorder = Recorder(sequence, writer, arguments.topic, arguments.compressed)
    with locked(writer.path, beside=True):
        problem = _record(sequence, recorder, options.stop)
        if recorder.frame_count == 0:
            writer.discard()
            raise_if_interrupted()
            raise KfvoError(problem or f'{sequence.name} has no images')
        recorder.finish(complete=not problem and recorder.frame_count != options.stop)
    print(_describe(writer, recorder, arguments.bag))
    if problem:
        kept = f'the {recorder.frame_count} images before that are in {arguments.bag}'
        raise Interrupted(kept) if interrupted() else KfvoError(f'{problem}; {kept}')


def _parse(argv: list[str]) -> argparse.Namespace:
    from kfvo_ros.images import CODECS
    from kfvo_ros.odometry.options import SequenceOptions
    from kfvo_ros.utils.config import add_arguments
    parser = make_parser(
        'kfvo_convert', 'Write any sequence as a bag that "ros2 bag play" plays.', EXAMPLES)
    parser.add_argument('sequence', help='dataset folder, ROS 1 or 2 bag, folder of images, '
                        'video, or synthetic:SEED[:smooth|fast|mixed|street]')
    parser.add_argument('bag', help='folder to create; an existing one is never touched')
    parser.add_argument('--topic', help='topic of the images (default: that of the bag they come '
                        'from, else /camera/image_raw)')
    parser.add_argument('--compressed', nargs='?', const=CODECS[0], choices=CODECS,
                        help='write CompressedImage: png, which is lossless (default), or jpeg')
    parser.add_argument('--zstd', action='store_true', help='compress the chunks of the file')
    parser.add_argument('--metadata-version', type=int, choices=(8, 9), default=9,
                        help='8 for ROS 2 before Jazzy (default: 9)')
    add_arguments(parser, SequenceOptions)
    return parser.parse_args(argv)


def _record(sequence: Sequence, recorder: Recorder, stop: int | None) -> str | None:
    """Write the frames; return the reason for an early end, else None."""
    from kfvo_ros.sequences.base import check_complete
    total = sequence.length if stop is None else min(stop, sequence.length or stop)
    try:
        for frame in progress(islice(sequence, stop), 'image', sequence.name, total):
            recorder.write(frame)
        if recorder.frame_count != stop:
            check_complete(sequence, recorder.frame_count)
    except Interrupted:
        return 'interrupted'
    except KfvoError as error:
        return str(error)
    return None


def _describe(writer: BagWriter, recorder: Recorder, bag: str) -> str:
    """Return a summary of the bag for the terminal."""
    width = max(map(len, writer.topics))
    lines = [f'{topic:{width}}  {info.message_count} x {info.message_type.replace("/msg/", "/")}'
             for topic, info in sorted(writer.topics.items())]
    if recorder.camera is None:
        lines.append('no CameraInfo: this camera is not calibrated; give --camera')
    elif recorder.camera.readout_s > 0.0:
        lines.append('a metadata record has the readout time, which CameraInfo cannot hold')
    size_mb = sum(path.stat().st_size for path in writer.path.iterdir()) / 1e6
    lines.append(f'{bag}: {recorder.frame_count} images, {size_mb:.1f} MB; replay it by')
    lines += [f'  {player} {shlex.quote(bag)}'
              for player in ('ros2 bag play', 'python -m kfvo_ros.play')]
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())

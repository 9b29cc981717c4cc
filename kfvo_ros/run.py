# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.run SEQUENCE --output FOLDER``: odometry over a sequence."""

from __future__ import annotations

import argparse
import sys
from itertools import islice
from pathlib import Path
from typing import Any

from kfvo_ros import __version__
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.progress import progress
from kfvo_ros.utils.signals import Interrupted, interrupted, raise_if_interrupted

EXAMPLES = """examples:
  python -m kfvo_ros.run synthetic:7 --output out
  python -m kfvo_ros.run .../rgbd_dataset_freiburg1_desk --output out --keyframes every
  python -m kfvo_ros.run MH_01_easy.bag --camera config/euroc_cam0.yaml --output out
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command('kfvo_run', _run, argv)


def _run(argv: list[str]) -> None:
    # Slow imports follow the check of the arguments, so that --help is fast.
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.utils.config import from_arguments
    arguments = _parse(argv)
    from kfvo_ros.evaluation.results import ResultWriter, WarningList
    from kfvo_ros.odometry import factory
    from kfvo_ros.sequences.base import choices_logged, read_ground_truth
    from kfvo_ros.utils.files import locked
    from kfvo_ros.utils.process import single_threaded
    odometry_options = from_arguments(OdometryOptions, arguments)
    sequence_options = from_arguments(SequenceOptions, arguments)
    folder = Path(arguments.output)
    with single_threaded(), WarningList() as warnings, locked(folder):
        with choices_logged():
            sequence = factory.make_sequence(arguments.sequence, sequence_options)
            truth, truth_problem = read_ground_truth(sequence)
        odometry = factory.make_odometry(odometry_options, factory.make_backbone(
            odometry_options, from_arguments(VggtOptions, arguments)))
        raise_if_interrupted()
        writer = ResultWriter(folder, arguments.overwrite)
        problem = _process(sequence, odometry, writer, sequence_options.stop)
        about = {'sequence': sequence.name, 'backbone': odometry.backbone.name,
                 'keyframe_policy': odometry.policy.name, 'scale_rule': odometry.scale.rule,
                 'seed': odometry_options.seed, 'version': __version__,
                 **odometry.backbone.device_info(), **sequence.sources}
        if truth_problem is not None:
            about['ground_truth_problem'] = truth_problem
        if sequence.left_out:
            about['left_out'] = sequence.left_out
        if warnings.texts:
            about['warnings'] = warnings.texts
        writer.append(odometry.finish())
        summary = writer.finish(about | ({'ended_early': problem} if problem else {}), truth)
    print(_describe(summary, writer.folder))
    if problem:
        kept = f'the results so far are in {writer.folder}'
        raise Interrupted(kept) if interrupted() else KfvoError(f'{problem}; {kept}')


def _parse(argv: list[str]) -> argparse.Namespace:
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.utils.config import add_arguments
    parser = make_parser('kfvo_run', 'Visual odometry over every frame of a sequence.', EXAMPLES)
    parser.add_argument('sequence', help='dataset folder, bag, folder of images, video, or '
                        'synthetic:SEED[:smooth|fast|mixed|street]')
    parser.add_argument('--output', required=True, help='folder for trajectory.tum, '
                        'keyframes.tum and summary.json')
    parser.add_argument('--overwrite', action='store_true', help='replace earlier results')
    add_arguments(parser, OdometryOptions)
    add_arguments(parser, VggtOptions)
    add_arguments(parser, SequenceOptions)
    return parser.parse_args(argv)


def _process(sequence: Any, odometry: Any, writer: Any, stop: int | None) -> str | None:
    """Process the frames; return why it ended early, None if it did not."""
    from kfvo_ros.sequences.base import check_complete
    total = sequence.length if stop is None else min(stop, sequence.length or stop)
    count = 0
    try:
        for frame in progress(islice(sequence, stop), 'frame', sequence.name, total):
            writer.update(odometry.process(frame))
            count += 1
    except Interrupted:
        return 'interrupted'
    except KfvoError as error:
        return str(error)
    if stop is None or count < stop:
        check_complete(sequence, count)
    return None


def _describe(summary: dict[str, Any], folder: Path) -> str:
    """Return the lines that are printed at the end."""
    total = summary['ms_per_frame'].get('total', {'median': 0.0, 'p95': 0.0})
    lines = [f'{summary["frames"]} frames, {summary["keyframes"]} keyframes, '
             f'{summary["lost_frames"]} lost; {total["median"]:.1f} ms per frame '
             f'(95 %: {total["p95"]:.1f})']
    if 'ate_rmse_m' in summary:
        share = 100.0 * summary['ate_rmse_m'] / max(summary['path_length_m'], 1e-9)
        lines.append(f'ATE {summary["ate_rmse_m"]:.4f} m RMSE after Sim(3) alignment, '
                     f'{share:.2f} % of {summary["path_length_m"]:.2f} m')
    elif 'ground_truth_problem' in summary:
        lines.append(f'no ATE: {summary["ground_truth_problem"]}')
    lines.append(f'{folder}/trajectory.tum (the scale of a single camera is not metric)')
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands that are interrupted, killed and starved of disk, and checks of their files."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kfvo_ros.errors import KfvoError

COUNT, WIDTH, HEIGHT, SEED = 90, 160, 120, 2
COLUMNS = ('sequence', 'method', 'seed', 'status', 'frames', 'ate_rmse_m')
"""Columns of results.csv that do not depend on the machine."""


@dataclass
class Inputs:
    """What the commands read: a ``recording`` with these stamps, and the ``cache`` of training."""

    recording: Path
    cache: Path
    stamps_ns: tuple[int, ...]


@dataclass(frozen=True)
class Command:
    """A command: its ``arguments`` for a folder, and a check of the files in it.

    ``problem(inputs, folder, complete)`` returns what is wrong with the files, None if nothing is;
    all results must be there if ``complete``. ``resume`` are the arguments with which it goes on
    after it was killed. One that runs ``until_stopped`` ends with status 0.
    """

    name: str
    arguments: Callable[[Inputs, Path], list[str]]
    problem: Callable[[Inputs, Path, bool], str | None]
    resume: Callable[[Inputs, Path], list[str]] | None = None
    until_stopped: bool = False


def make_inputs(folder: Path) -> Inputs:
    """Record a rendered sequence."""
    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
    sequence = SyntheticSequence(SEED, 'smooth', COUNT, WIDTH, HEIGHT)
    recorder = Recorder(sequence, BagWriter(folder / 'recording'))
    stamps = []
    for frame in sequence:
        recorder.write(frame)
        stamps.append(frame.stamp_ns)
    recorder.finish(complete=True)
    return Inputs(folder / 'recording', folder / 'cache', tuple(stamps))


def _run_problem(inputs: Inputs, folder: Path, complete: bool) -> str | None:
    """Check the files of kfvo_run: whole lines of the first frames, and a summary that agrees."""
    if not (folder / 'trajectory.tum').exists():
        return 'no trajectory' if complete else None
    stamps = read_stamps(folder / 'trajectory.tum')
    if stamps is None or stamps != inputs.stamps_ns[:len(stamps)]:
        return 'trajectory.tum does not hold the first frames in whole lines'
    if not (folder / 'summary.json').exists():
        return 'a trajectory without summary.json'
    frames = json.loads((folder / 'summary.json').read_text())['frames']
    if frames != len(stamps) or (complete and frames != COUNT):
        return f'{frames} frames in the summary, {len(stamps)} in the trajectory, of {COUNT}'
    return _leftovers(folder)


def read_stamps(path: Path) -> tuple[int, ...] | None:
    """Return the stamps of a trajectory file [ns]; None unless all lines are whole."""
    from kfvo_ros.trajectory import read_tum
    text = path.read_text('ascii', 'replace')
    if text and (not text.endswith('\n') or any(len(line.split()) != 8
                                                for line in text.splitlines())):
        return None
    try:
        return tuple(read_tum(path).stamps_ns.tolist()) if text else ()
    except KfvoError:
        return None


def _leftovers(folder: Path) -> str | None:
    found = [path.name for path in folder.rglob('.*')]
    return f'drafts or locks are left: {found}' if found else None


def _convert_problem(inputs: Inputs, folder: Path, complete: bool) -> str | None:
    """Check the bag of kfvo_convert: readable, with the first images of the source."""
    from kfvo_ros.sequences import open_sequence
    bag = folder / 'bag'
    if not bag.exists():
        return 'no bag' if complete else _leftovers(folder)
    try:
        written = open_sequence(str(bag))
        count = 0
        for copy, frame in zip(written, open_sequence(str(inputs.recording))):
            if copy.stamp_ns != frame.stamp_ns or not np.array_equal(copy.image, frame.image):
                return f'image {count} differs'
            count += 1
    except KfvoError as error:
        return str(error)
    if count != written.length or (complete and count != COUNT):
        return f'{count} images, the metadata state {written.length}, of {COUNT}'
    return _leftovers(folder)


def _train_problem(inputs: Inputs, folder: Path, complete: bool) -> str | None:
    """Check the files of kfvo_train: checkpoint and policies load."""
    import torch

    from kfvo_ros.keyframes.learned import read_policy
    from kfvo_ros.utils.tensor_files import check_signed_zip
    output, training = folder / 'policy.safetensors', folder / 'policy.training'
    checkpoint = training / 'checkpoint.pt'
    if complete and not (checkpoint.exists() and output.exists()):
        return 'no checkpoint or no policy'
    try:
        if checkpoint.exists():
            content = checkpoint.read_bytes()
            check_signed_zip(content)
            torch.load(io.BytesIO(content), map_location='cpu', weights_only=True)
            read_policy(training / 'last.safetensors')
        if output.exists():
            read_policy(output)
    except (ValueError, RuntimeError, zipfile.BadZipFile, KfvoError) as error:
        return str(error)
    return _leftovers(folder)


def _benchmark_problem(inputs: Inputs, folder: Path, complete: bool) -> str | None:
    """Check results.csv: whole rows, all of them finished."""
    path = folder / 'results' / 'results.csv'
    if not path.exists():
        return 'no results.csv' if complete else None
    text = path.read_text()
    header, *rows = list(csv.reader(io.StringIO(text)))
    if not text.endswith('\n') or any(len(row) != len(header) for row in rows):
        return 'a row of results.csv is not whole'
    status = header.index('status')
    if any(row[status] != 'finished' for row in rows) or (complete and len(rows) < 2):
        return f'{[row[status] for row in rows]} in results.csv'
    return _leftovers(folder)


def _node_problem(inputs: Inputs, folder: Path, complete: bool) -> str | None:
    """Check the trajectories that kfvo_node logs: whole lines in order of time."""
    for path in folder.glob('*.tum'):
        stamps = read_stamps(path)
        if stamps is None or any(np.diff(stamps) <= 0):
            return f'{path.name} is not a trajectory in whole lines'
    return None


def _benchmark_arguments(inputs: Inputs, folder: Path) -> list[str]:
    return ['kfvo_ros.benchmark', str(inputs.recording), '--methods', 'every,optical_flow',
            '--jobs', '2', '--no-pictures', '--output', str(folder / 'results')]


def _train_arguments(inputs: Inputs, folder: Path) -> list[str]:
    return ['kfvo_ros.train', '--smoke', '--workers', '2', '--cache', str(inputs.cache),
            '--output', str(folder / 'policy.safetensors')]


def _resume_training(inputs: Inputs, folder: Path) -> list[str]:
    begun = (folder / 'policy.training' / 'checkpoint.pt').exists()
    return [*_train_arguments(inputs, folder), '--resume' if begun else '--overwrite']


RUN = Command('run', lambda inputs, folder: [
    'kfvo_ros.run', str(inputs.recording), '--output', str(folder)], _run_problem)
CONVERT = Command('convert', lambda inputs, folder: [
    'kfvo_ros.convert', str(inputs.recording), str(folder / 'bag')], _convert_problem)
BENCHMARK = Command('benchmark', _benchmark_arguments, _benchmark_problem, lambda inputs, folder: [
    *_benchmark_arguments(inputs, folder), '--resume'])
TRAIN = Command('train', _train_arguments, _train_problem, _resume_training)
NODE = Command('node', lambda inputs, folder: [
    'kfvo_ros.node', '--ros-args', '-r', 'image:=/camera/image_raw', '-p',
    f'trajectory_file:={folder / "log.tum"}'], _node_problem, until_stopped=True)
COMMANDS = (RUN, CONVERT, TRAIN, BENCHMARK, NODE)


def results_of(folder: Path) -> list[tuple[str, ...]]:
    """Return the columns of results.csv that do not depend on the machine."""
    with (folder / 'results' / 'results.csv').open() as file:
        return [tuple(row[name] for name in COLUMNS) for row in csv.DictReader(file)]

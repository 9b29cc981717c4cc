# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files: the kinds, and their tries in worker processes."""

from __future__ import annotations

import shutil
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue

import numpy as np

from benchmarks.faults import sequences, tensors
from benchmarks.faults.damage import choose_file, damage
from benchmarks.faults.outcomes import Answer, Result, Verdict, judge
from benchmarks.faults.workers import Reader, Worker
from kfvo_ros.errors import KfvoError

LIMIT_S = 30.0
"""Time to read one input on a free machine, a hundred times what it takes."""


@dataclass(frozen=True)
class FileKind:
    """A kind of input: how it is written and read, and which of its files are damaged.

    ``flips_show`` and ``cuts_show``: the format has what is needed to notice; ``counted``: it
    states its number of frames, or its files can be compared. ``tries`` are those of a full run.
    """

    name: str
    write: Callable[[Path], Path]
    read: Reader
    damaged: str = '*'
    flips_show: bool = False
    cuts_show: bool = False
    counted: bool = True
    tries: int = 200


BAGS = (
    FileKind('ROS 1 bag', sequences.write_ros1, sequences.read_sequence, cuts_show=True),
    FileKind('MCAP', sequences.write_mcap, sequences.read_sequence, '*.*', True, True),
    FileKind('MCAP zstd', sequences.write_mcap_zstd, sequences.read_sequence, '*.*', True, True),
    FileKind('sqlite3', sequences.write_sqlite3, sequences.read_sequence, '*.*', cuts_show=True))
IMAGES = (
    FileKind('PNG', sequences.write_png, sequences.read_sequence, '*.png', True, True),
    FileKind('JPEG', sequences.write_jpeg, sequences.read_sequence, '*.jpg', cuts_show=True),
    FileKind('AVI', sequences.write_avi, sequences.read_sequence, cuts_show=True))
TABLES = tuple(
    FileKind(f'{name} {damaged}', write, sequences.read_sequence, damaged, tries=50)
    for name, write, damaged in (
        ('TUM', sequences.write_tum, 'rgb.txt'), ('TUM', sequences.write_tum, 'groundtruth.txt'),
        ('KITTI', sequences.write_kitti, 'times.txt'),
        ('KITTI', sequences.write_kitti, 'calib.txt'), ('KITTI', sequences.write_kitti, '03.txt'),
        ('EuRoC', sequences.write_euroc, 'cam0/data.csv'),
        ('EuRoC', sequences.write_euroc, 'cam0/sensor.yaml'),
        ('EuRoC', sequences.write_euroc, 'state*/data.csv'),
        ('ROS', sequences.write_png, 'camera_info.yaml')))
TENSORS = (
    FileKind('policy', tensors.write_policy, tensors.read_policy, '*', True, True),
    FileKind('checkpoint', tensors.write_checkpoint, tensors.read_checkpoint, '*', True, True),
    FileKind('VGGT .safetensors', tensors.write_weights, tensors.read_weights, cuts_show=True),
    FileKind('VGGT .pt', tensors.write_weights_pt, tensors.read_weights, '*', True, True))
KINDS = (*BAGS, *IMAGES, *TABLES, *TENSORS)


@dataclass(frozen=True)
class Try:
    """One damaged input of a kind."""

    kind: FileKind
    number: int


@dataclass
class FileFaults:
    """Tries damaged inputs of some kinds, by ``jobs`` workers, in the folder ``work``.

    The same ``seed`` gives the same damage. ``limit_s`` is the longest time of one input.
    """

    work: Path
    seed: int
    jobs: int = 2
    limit_s: float = LIMIT_S
    _originals: dict[str, tuple[Path, Answer]] = field(default_factory=dict)

    def outcomes(self, tries: list[Try]) -> Iterator[Result]:
        """Yield the result of each try, as they come.

        Raises KfvoError where an undamaged input cannot be read.
        """
        waiting: Queue[Try] = Queue()
        results: Queue[Result | BaseException] = Queue()
        workers = [Worker(self.work / f'worker{index}.log', self.limit_s)
                   for index in range(self.jobs)]
        self._prepare({each.kind.name: each.kind for each in tries}, workers[0])
        for each in tries:
            waiting.put(each)
        stop = threading.Event()
        threads = [threading.Thread(target=self._work, args=(worker, waiting, results, stop),
                                    daemon=True) for worker in workers]
        for thread in threads:
            thread.start()
        try:
            for _ in tries:
                result = results.get()
                if isinstance(result, BaseException):
                    raise result
                yield result
        finally:
            stop.set()
            for thread in threads:
                thread.join()

    def _prepare(self, kinds: dict[str, FileKind], worker: Worker) -> None:
        """Write and read the undamaged inputs."""
        for name, kind in kinds.items():
            folder = self.work / slug(name) / 'original'
            folder.mkdir(parents=True)
            path = kind.write(folder)
            answer = worker.read(kind.read, path)
            if isinstance(answer, Verdict) or answer.error or answer.traceback:
                worker.close()
                raise KfvoError(f'{name}: expected to read the undamaged input, came {answer}')
            self._originals[name] = (path, answer)

    def _work(self, worker: Worker, waiting: Queue[Try], results: Queue[Result | BaseException],
              stop: threading.Event) -> None:
        try:
            while not stop.is_set():
                each = waiting.get_nowait()
                results.put(self._try(each, worker))
        except Empty:
            pass
        except BaseException as error:
            results.put(error)
        finally:
            worker.close()

    def _try(self, each: Try, worker: Worker) -> Result:
        kind = each.kind
        original, expected = self._originals[kind.name]
        source = self.work / slug(kind.name) / 'original'
        folder = self.work / slug(kind.name) / str(each.number)
        shutil.copytree(source, folder)
        rng = np.random.default_rng([self.seed, zlib.crc32(kind.name.encode()), each.number])
        files = sorted(path for path in folder.rglob(kind.damaged) if path.is_file())
        was_cut, description = damage(choose_file(files, rng), rng)
        answer = worker.read(kind.read, folder / original.relative_to(source), original)
        verdict = answer if isinstance(answer, Verdict) else judge(
            expected, answer, kind.cuts_show if was_cut else kind.flips_show, kind.counted,
            original.stem)
        return Result(kind.name, each.number, verdict, description, folder)


def slug(name: str) -> str:
    """Return a name for folders."""
    return ''.join(char if char.isalnum() else '_' for char in name).lower()


# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.faults``: a slice of its tries, and faults that it must find."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import time

import faulty_readers
import numpy as np
import pytest

from benchmarks.faults import __main__ as faults
from benchmarks.faults import interruptions
from benchmarks.faults.commands import COUNT, RUN, read_stamps
from benchmarks.faults.damage import damage
from benchmarks.faults.files import BAGS, IMAGES, KINDS, TABLES, TENSORS, FileFaults, FileKind, Try
from benchmarks.faults.outcomes import Answer, Outcome, Tally, judge
from benchmarks.faults.processes import Session
from kfvo_ros.utils.process import time_limit

TRAINING = all(map(importlib.util.find_spec, ('torch', 'stable_baselines3', 'huggingface_hub')))


def found(tmp_path, kinds, numbers, **options):
    """Return tries of the kinds as {label: [verdict, ...]} in the order of their numbers."""
    results = FileFaults(tmp_path, seed=0, **options).outcomes(
        [Try(kind, number) for kind in kinds for number in numbers])
    verdicts = {}
    for each in sorted(results, key=lambda each: each.number):
        verdicts.setdefault(each.label, []).append(each.verdict)
    return verdicts


def offences(verdicts):
    return [(label, each) for label, several in verdicts.items() for each in several
            if each.is_offence]


def test_damaged_sequences(tmp_path):
    verdicts = found(tmp_path, (*BAGS, *IMAGES, *TABLES), range(3))
    assert offences(verdicts) == []
    outcomes = {each.outcome for several in verdicts.values() for each in several}
    assert {Outcome.CLEAR_ERROR, Outcome.TOLD, Outcome.NO_CHECKSUM} <= outcomes


@pytest.mark.skipif(not TRAINING, reason="the extras vggt and train are not installed")
def test_damaged_tensors(tmp_path):
    verdicts = found(tmp_path, TENSORS, range(4))
    assert offences(verdicts) == []
    for label in ('policy', 'checkpoint'):
        assert {each.outcome for each in verdicts[label]} == {Outcome.CLEAR_ERROR}


def test_disturbed_commands(tmp_path):
    every = {each: (fault, command) for fault, command, _ in interruptions.FAULTS
             for each in [interruptions.ProcessTry(fault, command, 0).label]}
    tries = [interruptions.ProcessTry(*every[label], number)
             for label, numbers in (('signal to run', (0, 1)), ('full disk, run', (0,)),
                                    ('kill -9 benchmark', (0,))) for number in numbers]
    results = list(interruptions.ProcessFaults(tmp_path, seed=0).outcomes(tries))
    assert [(each.label, each.damage, each.verdict.reason) for each in results
            if each.verdict.is_offence] == []
    assert len(results) == len(tries)
    notes = {each.label: each.note for each in results}
    assert notes['signal to run'] == '' and notes['full disk, run']


BAD = {'raises': Outcome.TRACEBACK, 'exits': Outcome.TRACEBACK, 'crashes': Outcome.CRASH,
       'runs_out_of_memory': Outcome.CRASH, 'hangs': Outcome.HANG, 'loses': Outcome.SILENT_LOSS,
       'changes': Outcome.SILENT_LOSS, 'explains_at_length': Outcome.TRACEBACK,
       'mumbles': Outcome.TRACEBACK}
GOOD = {'tells': Outcome.TOLD, 'refuses': Outcome.CLEAR_ERROR, 'ignores': Outcome.OK}


def test_bad_readers_are_found(tmp_path):
    kinds = [FileKind(name, faulty_readers.write, getattr(faulty_readers, name),
                      flips_show=True, cuts_show=True) for name in BAD | GOOD]
    # Two tries: the worker is replaced after a crash and a hang.
    verdicts = found(tmp_path, kinds, range(2), limit_s=1.0)
    assert {label: [each.outcome for each in several] for label, several in verdicts.items()} \
        == {label: [outcome] * 2 for label, outcome in (BAD | GOOD).items()}
    assert 'IndexError: no such row at faulty_readers.py' in verdicts['raises'][0].reason
    assert 'SIGSEGV' in verdicts['crashes'][0].reason


def test_other_values_without_a_checksum_are_no_loss(tmp_path):
    original = Answer(10, 'whole')
    assert judge(original, Answer(10, 'other'), False, True).outcome is Outcome.NO_CHECKSUM
    assert judge(original, Answer(9, 'other'), False, True).outcome is Outcome.SILENT_LOSS
    assert judge(original, Answer(9, 'other'), False, False).outcome is Outcome.NO_CHECKSUM
    assert judge(original, Answer(10, 'other'), True, False).outcome is Outcome.SILENT_LOSS


def test_damage_is_the_same_for_the_same_seed(tmp_path):
    path, contents = tmp_path / 'file', []
    for seed in (1, 1, 2):
        path.write_bytes(bytes(1000))
        damage(path, np.random.default_rng(seed))
        contents.append(path.read_bytes())
    assert contents[0] == contents[1] != contents[2]


def test_offences_are_kept_and_end_with_status_1(tmp_path, monkeypatch, capsys):
    kind = FileKind('Bad one', faulty_readers.write, faulty_readers.raises)
    monkeypatch.setattr(faults, 'KINDS', (kind,))
    output = tmp_path / 'kept'
    assert faults.main(['--only', 'bad', '--tries', '2', '--seed', '3', '--jobs', '1', '--output',
                        str(output)]) == 1
    printed = capsys.readouterr()
    row = next(line for line in printed.out.splitlines() if line.startswith('| Bad one'))
    assert row.replace(' ', '') == '|Badone|2|0|0|0|0|2|0|0|0|'
    assert 'error: 2 offences' in printed.err
    line, repeat = (output / 'bad_one_3_1' / 'fault.txt').read_text().splitlines()
    assert line.startswith('traceback: Bad one: numbers.bin ') and 'IndexError' in line
    assert repeat == 'python -m benchmarks.faults --only bad_one --seed 3 --number 1'
    damaged = (output / 'bad_one_3_1' / 'numbers.bin').read_bytes()
    assert damaged != faulty_readers.CONTENT
    assert faults.main(['--only', 'bad_one', '--seed', '3', '--number', '1', '--output',
                        str(tmp_path / 'again')]) == 1
    assert (tmp_path / 'again' / 'bad_one_3_1' / 'numbers.bin').read_bytes() == damaged


def test_unknown_kinds_are_named(capsys):
    assert faults.main(['--only', 'tapes']) == 1
    assert "expected kinds with --only, came 'tapes'" in capsys.readouterr().err


def test_every_kind_has_its_row():
    tally = Tally()
    for kind in KINDS:
        tally.add(kind.name, Outcome.OK)
    tally.add('disk', Outcome.HANG, 'tmpfs')
    rows = tally.table().splitlines()
    assert len(rows) == len(KINDS) + 4 and len(set(map(len, rows))) == 1
    assert rows[-2].startswith('| disk (tmpfs)') and tally.offences == 1


def test_incomplete_files_of_a_run_are_found(tmp_path):
    inputs = interruptions.Inputs(tmp_path, tmp_path, tuple(range(10 ** 9, 10 ** 9 + COUNT)))
    line = '1.000000000 0 0 0 0 0 0 1\n'
    path = tmp_path / 'trajectory.tum'
    assert RUN.problem(inputs, tmp_path, False) is None
    path.write_text(line)
    assert RUN.problem(inputs, tmp_path, False) == 'a trajectory without summary.json'
    (tmp_path / 'summary.json').write_text('{"frames": 2}')
    assert '2 frames in the summary, 1 in the' in RUN.problem(inputs, tmp_path, False)
    (tmp_path / 'summary.json').write_text('{"frames": 1}')
    assert RUN.problem(inputs, tmp_path, False) is None
    assert 'of 90' in RUN.problem(inputs, tmp_path, True)
    path.write_text(line[:-1])
    assert read_stamps(path) is None and 'whole lines' in RUN.problem(inputs, tmp_path, False)


def test_children_that_survive_are_found_and_ended(tmp_path, monkeypatch):
    (tmp_path / 'parent.py').write_text(
        'import subprocess, sys\n'
        'subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])\n')
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(tmp_path), *sys.path]))
    with Session(['parent'], tmp_path / 'log') as session:
        assert session.wait(time_limit(20.0)) == 0
        child, = session.survivors(0.1)
        os.kill(child, 0)
    end = time.monotonic() + time_limit(5.0)
    while session.survivors() and time.monotonic() < end:
        time.sleep(0.02)
    assert session.survivors() == []


def test_ends_of_processes_are_judged():
    def outcome(status, output='', sent=signal.SIGTERM, left=()):
        return interruptions._judge_end(status, sent, RUN, output, list(left)).outcome

    assert outcome(143) is outcome(0) is Outcome.OK
    assert outcome(130) is outcome(-11) is outcome(-15) is outcome(1) is Outcome.CRASH
    assert outcome(None) is outcome(143, left=[1]) is Outcome.HANG
    assert outcome(143, 'Traceback (most recent call last):\n') is Outcome.TRACEBACK
    error = 'kfvo_run: error: no space left\n'
    assert outcome(1, error, None) is Outcome.CLEAR_ERROR
    assert outcome(1, error * 2, None) is outcome(1, '', None) is Outcome.TRACEBACK

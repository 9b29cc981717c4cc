# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress bars: they count, and never fail with their stream."""

from __future__ import annotations

import os
import signal

import pytest
from command_lines import run_python

from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import read_tum
from kfvo_ros.utils.progress import progress, progress_bar
from kfvo_ros.utils.signals import Interrupted, signals_handled


def test_items_are_counted(capsys):
    assert list(progress(range(3), 'frame', 'walk')) == [0, 1, 2]
    assert 'walk: 100%' in capsys.readouterr().err


def test_an_item_is_not_begun_after_a_signal():
    done = []
    with signals_handled(), pytest.raises(Interrupted):
        for item in progress(range(9), 'frame'):
            done.append(item)
            if item == 2:
                signal.raise_signal(signal.SIGHUP)
    assert done == [0, 1, 2]


class BrokenStream:
    """Raises at every use, as a pipe that nobody reads."""

    encoding = 'utf-8'

    def write(self, text: str) -> int:
        raise BrokenPipeError(32, 'Broken pipe')

    def flush(self) -> None:
        raise ValueError('I/O operation on closed file')


@pytest.mark.parametrize('stream', [BrokenStream(), None])
def test_a_bar_survives_its_stream(stream, monkeypatch):
    monkeypatch.setattr('sys.stderr', stream)
    assert list(progress(range(3), 'frame')) == [0, 1, 2]
    with progress_bar(3, 'run') as bar:
        bar.update()
        bar.set_postfix_str('busy')
        bar.write('a line', file=bar.fp)


@pytest.mark.parametrize('redirection', ['2>&1 | head -c 1', '2>&-', '2>/dev/full'])
def test_results_do_not_depend_on_stderr(redirection, tmp_path):
    """The files of run and convert are complete when the bar cannot be written."""
    command = 'exec "$0" -m kfvo_ros.{} synthetic:1 {} --stop 9 {}'
    for name, arguments in (('run', f'--output {tmp_path / "out"} --overwrite'),
                            ('convert', str(tmp_path / 'bag'))):
        done = run_python('-c', (
            'import subprocess, sys; subprocess.run(["sh", "-c", sys.argv[1], sys.executable])'),
            command.format(name, arguments, redirection))
        assert 'Traceback' not in done.stderr + done.stdout
    assert len(read_tum(tmp_path / 'out' / 'trajectory.tum')) == 9
    assert os.path.getsize(tmp_path / 'out' / 'summary.json') > 0
    assert len(list(open_sequence(str(tmp_path / 'bag')))) == 9

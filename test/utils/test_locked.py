# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Locks of folders: one process at a time, released when it is killed, no file left behind."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_lines import ENVIRONMENT

from kfvo_ros import benchmark, convert, run
from kfvo_ros.errors import KfvoError
from kfvo_ros.utils import files
from kfvo_ros.utils.files import locked

HOLDER = """
import sys, time
from pathlib import Path
from kfvo_ros.utils.files import locked
with locked(Path(sys.argv[1]), beside=sys.argv[2] == 'beside'):
    print('locked', flush=True)
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def short_wait(monkeypatch) -> None:
    """Wait for a lock for a tenth of a second."""
    monkeypatch.setattr(files, 'LOCK_TIMEOUT_S', 0.1)


@pytest.fixture
def hold(request):
    """Return a function that starts a process which holds a folder."""
    def start(folder: Path, where: str = 'inside') -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, '-c', HOLDER, str(folder), where], text=True,
                                   stdout=subprocess.PIPE, env=ENVIRONMENT)
        request.addfinalizer(process.communicate)
        request.addfinalizer(process.kill)
        assert process.stdout.readline() == 'locked\n'
        return process
    return start


def test_another_process_is_kept_out_until_the_holder_is_killed(hold, tmp_path):
    folder = tmp_path / 'a' / 'b'
    holder = hold(folder)
    with pytest.raises(KfvoError) as refusal, locked(folder):
        pass
    assert str(refusal.value) == (f'{folder} is in use by process {holder.pid}: wait until it '
                                  'ends, or choose another folder')
    holder.kill()
    holder.wait()
    with locked(folder):
        assert (folder / '.lock').read_text() == f'{os.getpid()}\n'
    assert list(folder.iterdir()) == []


def test_a_lock_that_is_released_soon_is_waited_for(hold, tmp_path, monkeypatch):
    monkeypatch.setattr(files, 'LOCK_TIMEOUT_S', 30.0)
    holder = hold(tmp_path)
    subprocess.Popen(['sh', '-c', f'sleep 0.3; kill -9 {holder.pid}']).wait()
    begin = time.monotonic()
    with locked(tmp_path):
        assert time.monotonic() - begin < 25.0


def test_only_a_folder_that_was_made_and_stays_empty_is_removed(tmp_path):
    new, old, filled = (tmp_path / name for name in ('new', 'old', 'filled'))
    old.mkdir()
    for folder in (new, old, filled):
        with locked(folder):
            (filled / 'result').touch() if folder is filled else None
    assert not new.exists() and old.exists() and [each.name for each in filled.iterdir()] == [
        'result']


def test_a_lock_beside_leaves_the_folder_alone(hold, tmp_path):
    with locked(tmp_path / 'bag', beside=True):
        assert not (tmp_path / 'bag').exists()
        with pytest.raises(KfvoError, match=f'bag is in use by process {os.getpid()}'), \
                locked(tmp_path / 'bag', beside=True):
            pass
    assert list(tmp_path.iterdir()) == []


def test_an_error_in_the_block_releases_the_lock(tmp_path):
    for _ in range(2):
        with pytest.raises(ValueError, match='inside'), locked(tmp_path):
            raise ValueError('inside')
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_is_used_without(tmp_path, monkeypatch):
    def flock(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(fcntl, 'flock', flock)
    with locked(tmp_path), locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(KfvoError, match=r'cannot write to .*/file/out: Not a directory'), \
            locked(tmp_path / 'file' / 'out'):
        pass


@pytest.mark.parametrize(('main', 'where', 'arguments'), [
    (run.main, 'inside', ['synthetic:1:smooth', '--stop', '5', '--overwrite', '--output']),
    (benchmark.main, 'inside', ['synthetic:1:smooth', '--methods', 'every', '--no-pictures',
                                '--stop', '5', '--resume', '--output']),
    (convert.main, 'beside', ['synthetic:1:smooth', '--stop', '5'])],
    ids=['run', 'benchmark', 'convert'])
def test_commands_keep_out_of_a_folder_in_use(main, where, arguments, hold, tmp_path, capsys):
    folder = tmp_path / 'out'
    holder = hold(folder, where)
    before = sorted(tmp_path.rglob('*'))
    assert main([*arguments, str(folder)]) == 1
    line, = capsys.readouterr().err.splitlines()
    assert f'{folder} is in use by process {holder.pid}' in line
    assert sorted(tmp_path.rglob('*')) == before
    holder.kill()
    holder.wait()
    assert main([*arguments, str(folder)]) == 0
    assert not list(tmp_path.rglob('*.lock'))

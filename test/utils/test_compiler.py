# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compilation with a cache of machine code: reused, outdated, damaged, or impossible."""

from __future__ import annotations

import logging
import os
import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_lines import ENVIRONMENT, run_python

from kfvo_ros.utils import compiler

CALLER = """
from pathlib import Path
from compiling.callee import compiled, scaled

@compiled
def run(x):
    return scaled(x) + 1.0
"""
CALLEE = """
from pathlib import Path
from kfvo_ros.utils.compiler import Compiler

compiled = Compiler(Path(__file__).parent)

@compiled
def scaled(x):
    return {factor} * x
"""
CALL = """
import logging
logging.basicConfig(format='%(levelname)s %(message)s')
from compiling.caller import run
print(run(1.0), sum(run.stats.cache_hits.values()))
"""


def make_package(parent: Path) -> Path:
    folder = parent / 'compiling'
    folder.mkdir()
    (folder / 'caller.py').write_text(CALLER)
    (folder / 'callee.py').write_text(CALLEE.format(factor=2.0))
    return folder


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a package of two functions that are not compiled yet."""
    return make_package(tmp_path)


@pytest.fixture(scope='module')
def first_start(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a package after its first start, and the log of that."""
    folder = make_package(tmp_path_factory.mktemp('first'))
    used, lines = call(folder)
    assert not used
    return folder, lines


@pytest.fixture
def compiled_package(first_start: tuple[Path, list[str]], tmp_path: Path) -> Path:
    """Return a copy of the package with its machine code."""
    return Path(shutil.copytree(first_start[0], tmp_path / 'compiling'))


def call(package: Path, result: float = 3.0, environment: dict[str, str] | None = None,
         **options: object) -> tuple[bool, list[str]]:
    """Call the compiled function in a process; return whether the cache was used, and the log."""
    variables = ENVIRONMENT | {'PYTHONDONTWRITEBYTECODE': '1'} | (environment or {})
    variables.pop('NUMBA_CACHE_DIR', None)
    done = run_python('-c', CALL, cwd=package.parent, env=variables, **options)
    assert done.returncode == 0, done.stderr
    value, hits = done.stdout.split()
    assert float(value) == result
    return hits == '1', done.stderr.splitlines()


def files(package: Path, suffix: str) -> list[Path]:
    found = sorted((package / '__pycache__').glob(f'*{suffix}'))
    assert len(found) == 2
    return found


def empty(path: Path) -> None:
    path.write_bytes(b'')


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def replace_by_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def test_the_first_start_says_that_it_compiles(first_start: tuple[Path, list[str]],
                                               compiled_package: Path) -> None:
    line, = first_start[1]
    assert line.startswith('INFO compiling ')
    assert call(compiled_package) == (True, [])


def test_machine_code_of_a_changed_callee_is_not_reused(compiled_package: Path) -> None:
    (compiled_package / 'callee.py').write_text(CALLEE.format(factor=3.0))
    assert not call(compiled_package, 4.0)[0]
    assert call(compiled_package, 4.0)[0]


@pytest.mark.parametrize(('damage', 'suffix'), [
    (empty, '.nbi'), (empty, '.nbc'), (cut, '.nbi'), (flip, '.nbc'), (replace_by_fifo, '.nbc')])
def test_damaged_files_are_compiled_again(compiled_package: Path, suffix: str,
                                          damage: Callable[[Path], None]) -> None:
    for path in files(compiled_package, suffix):
        damage(path)
    used, lines = call(compiled_package)
    assert not used
    assert [line.split()[0] for line in lines] == ['WARNING', 'INFO']
    assert 'is damaged' in lines[0]
    assert call(compiled_package) == (True, [])


def test_machine_code_that_cannot_be_replaced_is_compiled_each_time(compiled_package: Path
                                                                    ) -> None:
    for path in files(compiled_package, '.nbi'):
        replace_by_folder(path)
    used, lines = call(compiled_package)
    assert not used
    assert sum(line.startswith('WARNING') for line in lines) == 2  # damaged; cannot keep


def test_without_a_writable_folder_there_is_one_warning(package: Path) -> None:
    (package / '__pycache__').write_text('in the way')
    nowhere = str(package / 'caller.py' / 'home')
    used, lines = call(package, environment={'HOME': nowhere, 'XDG_CACHE_HOME': nowhere})
    assert not used
    assert [line.split()[0] for line in lines] == ['WARNING', 'INFO']
    assert 'NUMBA_CACHE_DIR' in lines[0]


def test_a_full_disk_costs_a_warning(package: Path) -> None:
    def limit_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    used, lines = call(package, preexec_fn=limit_files)
    assert not used
    assert sum(line.startswith('WARNING cannot keep compiled code') for line in lines) == 1
    assert not list((package / '__pycache__').glob('*.tmp.*'))


def test_every_flipped_bit_is_noticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stored = compiler._CheckedFiles(str(tmp_path), 'name', 'stamp')
    stored.save('key', list(range(50)))
    rng = np.random.default_rng(0)
    for path in (tmp_path / 'name.nbi', tmp_path / 'name.1.nbc'):
        content = path.read_bytes()
        for position in rng.permutation(8 * len(content))[:300]:
            damaged = bytearray(content)
            damaged[position // 8] ^= 1 << position % 8
            path.write_bytes(damaged)
            assert stored.load('key') is None
        for length in range(len(content)):
            path.write_bytes(content[:length])
            assert stored.load('key') is None
        path.write_bytes(content)
    assert stored.load('key') == list(range(50))
    assert stored.load('other key') is None
    assert len([record for record in caplog.records if record.levelno == logging.WARNING]) <= 1


def test_files_of_two_processes_are_not_mixed_up(tmp_path: Path) -> None:
    """Both number their first file 1; the index is of one and the data of the other."""
    for folder, key in ((tmp_path / 'a', 'float32'), (tmp_path / 'b', 'float64')):
        folder.mkdir()
        compiler._CheckedFiles(str(folder), 'name', 'stamp').save(key, key)
    (tmp_path / 'a' / 'name.1.nbc').write_bytes((tmp_path / 'b' / 'name.1.nbc').read_bytes())
    assert compiler._CheckedFiles(str(tmp_path / 'a'), 'name', 'stamp').load('float32') is None

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of several tests, and the distribution of tests over processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from command_lines import leftovers

from kfvo_ros.utils.process import single_threaded, time_limit

OVER_DDS = ('test_demo', 'test_vggt_node')
"""Test files outside test/ros that communicate over DDS and are timed: they run in sequence."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Group the tests of a file, and all tests over DDS, for pytest-xdist."""
    for item in items:
        name, folder = item.path.stem, item.path.parent.name
        item.add_marker(pytest.mark.xdist_group(
            'dds' if folder == 'ros' or name in OVER_DDS else name))


@pytest.fixture(scope='session', autouse=True)
def one_thread() -> Iterator[None]:
    """Run BLAS and OpenCV in one thread, as the commands do; more take minutes longer."""
    with single_threaded():
        yield


@pytest.fixture(scope='session', autouse=True)
def interruptible() -> None:
    """Handle SIGINT here and in child processes: background jobs of a shell ignore it."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope='module', autouse=True)
def no_process_left() -> Iterator[None]:
    """Fail where the tests of a file leave processes running, and end those."""
    yield
    left = leftovers(time_limit(5.0))
    for number in left:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    assert not left


@pytest.fixture(scope='session')
def data_path() -> Callable[[str], Path]:
    """Return a function from a path below KFVO_DATA to the file or folder, or a skip."""
    def find(relative: str) -> Path:
        root = os.environ.get('KFVO_DATA')
        if not root:
            pytest.skip('KFVO_DATA names no folder of sequences')
        path = Path(root, relative)
        if not path.exists():
            pytest.skip(f'no {relative} in KFVO_DATA')
        return path
    return find


@pytest.fixture(scope='session')
def small_vggt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file of weights of a small VGGT model, or a skip."""
    from vggt_models import save_small_model
    return save_small_model(tmp_path_factory.mktemp('vggt') / 'small.safetensors')

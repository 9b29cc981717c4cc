# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What several tests share."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from kfvo_ros.utils.process import single_threaded
from kfvo_ros.utils.signals import SIGNALS

OVER_DDS = ('test_demo', 'test_vggt_node')
"""Test files, besides those of test/ros, that communicate over DDS and are timed: run in turn."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tell pytest-xdist what stays together: the tests of a file, and all that talk over DDS."""
    for item in items:
        name, folder = item.path.stem, item.path.parent.name
        item.add_marker(pytest.mark.xdist_group(
            'dds' if folder == 'ros' or name in OVER_DDS else name))


@pytest.fixture(scope='session', autouse=True)
def one_thread() -> Iterator[None]:
    """Solve windows as the commands do: threads of BLAS that wait for each other cost minutes."""
    with single_threaded():
        yield


@pytest.fixture(scope='session', autouse=True)
def interruptible() -> None:
    """Let the processes that tests interrupt be so: a shell's background jobs ignore SIGINT."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope='module')
def own_signals() -> Iterator[None]:
    """Give back the signals that commands called in this process take for themselves."""
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


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

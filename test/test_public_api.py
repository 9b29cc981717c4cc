# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Public names of the package: imports, documentation, types, and the example of the README."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import venv
from pathlib import Path

import pytest
from command_lines import run_python

import kfvo_ros

ROOT = Path(__file__).resolve().parent.parent
USER_SCRIPT = """
from kfvo_ros import make_odometry, open_sequence
for frame in open_sequence('synthetic:0'):
    reveal_type(make_odometry().process(frame))
"""


@pytest.mark.parametrize('name', kfvo_ros.__all__)
def test_public_names_are_documented(name):
    found = getattr(kfvo_ros, name)
    assert found.__name__ == name and found.__module__.startswith('kfvo_ros.')
    assert inspect.getdoc(found).endswith('.')
    members = [member for key, member in vars(found).items() if not key.startswith('_')
               and (inspect.isfunction(member) or isinstance(member, property))]
    assert all(inspect.getdoc(member) for member in members)


def test_dir_lists_the_public_names():
    assert set(kfvo_ros.__all__) <= set(dir(kfvo_ros))
    assert len(set(kfvo_ros.__all__)) == len(kfvo_ros.__all__)
    with pytest.raises(AttributeError, match="module 'kfvo_ros' has no attribute 'no_such_name'"):
        _ = kfvo_ros.no_such_name


def test_lazy_and_typed_imports_are_the_same():
    """Type checkers read the imports below TYPE_CHECKING, Python those of `_MODULES`."""
    typed = {alias.name: node.module
             for node in ast.walk(ast.parse(Path(kfvo_ros.__file__).read_text(encoding='utf-8')))
             if isinstance(node, ast.ImportFrom) and node.module.startswith('kfvo_ros.')
             for alias in node.names}
    assert typed == {name: f'kfvo_ros.{module}' for name, module in kfvo_ros._MODULES.items()}
    assert set(typed) == set(kfvo_ros.__all__)


def test_importing_the_package_imports_neither_numpy_nor_torch():
    done = run_python('-c', 'import sys, kfvo_ros; kfvo_ros.__version__; print(*sys.modules)')
    assert done.returncode == 0, done.stderr
    assert not set(done.stdout.split()) & {'numpy', 'cv2', 'numba', 'torch', 'rclpy'}


def test_the_example_of_the_readme():
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    example, = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    done = run_python('-c', f'{example}\nprint(len(poses), *poses.popitem()[1].shape)')
    assert done.returncode == 0, done.stderr
    *frames, last = done.stdout.splitlines()
    assert last == f'{len(frames)} 4 4' and len(frames) == 200
    assert all(re.fullmatch(r'\d+ ok \[.*\]', line) for line in frames)


def test_type_checkers_read_the_installed_package(tmp_path):
    """Without py.typed mypy ignores the types of an installed package."""
    if importlib.util.find_spec('mypy') is None:
        pytest.skip('mypy is not installed: pip install mypy')
    venv.create(tmp_path / 'venv', symlinks=True)
    site_packages = next((tmp_path / 'venv').glob('lib/python3*/site-packages'))
    (site_packages / 'kfvo_ros').symlink_to(ROOT / 'kfvo_ros')
    done = run_python('-m', 'mypy', '--python-executable', tmp_path / 'venv' / 'bin' / 'python',
                      '--cache-dir', tmp_path / 'cache', '-c', USER_SCRIPT, cwd=tmp_path,
                      env={'PATH': ''})
    assert done.returncode == 0, done.stdout
    assert 'Revealed type is "kfvo_ros.odometry.updates.Update"' in done.stdout

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Packaging: layers of imports, missing dependencies, installed files, declarations."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
from command_lines import assert_one_readable_line, run_python

import kfvo_ros
from kfvo_ros.sequences.calibration import read_camera_info
from kfvo_ros.utils.commands import ROS_MODULES, missing_dependency
from kfvo_ros.utils.process import time_limit

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / 'kfvo_ros').rglob('*.py'))
COMMANDS = {'kfvo_run': 'synthetic:SEED', 'kfvo_convert': '--compressed',
            'kfvo_play': '--wait-for-subscribers', 'kfvo_node': 'camera_info_file',
            'kfvo_train': '--validation', 'kfvo_benchmark': '--methods'}
HEADER = ['# Copyright 2026 The kfvo_ros authors', '# SPDX-License-Identifier: Apache-2.0']
BUILT = ('.git', '.venv*', '*.egg-info', '__pycache__', '.*_cache', 'build', 'install', 'log',
         'demo', 'results')

# Rooms by layer, the lowest first; modules that are not named are in the lowest.
LAYERS = ((), ('tracking', 'sequences'), ('backbones', 'keyframes'), ('odometry',),
          ('evaluation', 'training', 'ros'),
          ('benchmark', 'convert', 'demo', 'node', 'play', 'run', 'train'),
          ('ablation',))
HEAVY = ('rclpy', 'torch', 'scipy', 'stable_baselines3')
MAY_IMPORT_HEAVY = ('kfvo_ros.ros', 'kfvo_ros.training', 'kfvo_ros.backbones.vggt')


def module_name(path: Path) -> str:
    """Return the dotted name of a source file."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def imported_modules(path: Path) -> Iterator[str]:
    """Yield the dotted names of all imports of a file, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def canonical(distribution: str) -> str:
    """Return the normalised name of a distribution."""
    return re.sub(r'[-_.]+', '-', distribution).lower()


def layer_of(module: str) -> int:
    """Return the layer of ``kfvo_ros`` or ``kfvo_ros.room...``."""
    room = module.partition('.')[2].partition('.')[0]
    return next((layer for layer, rooms in enumerate(LAYERS) if room in rooms), 0)


# Layers


def test_imports_point_down_only() -> None:
    wrong = [f'{module_name(path)} imports {imported}' for path in SOURCES
             for imported in imported_modules(path)
             if imported.startswith('kfvo_ros.') and module_name(path) != 'kfvo_ros'
             and layer_of(imported) > layer_of(module_name(path))]
    assert not wrong


def test_only_the_ros_folder_imports_rclpy() -> None:
    importing = [module_name(path) for path in SOURCES for imported in imported_modules(path)
                 if imported.split('.')[0] == 'rclpy']
    assert all(name.startswith('kfvo_ros.ros') for name in importing), importing


def test_core_imports_without_ros_torch_and_scipy() -> None:
    core = [name for name in map(module_name, SOURCES) if not name.startswith(MAY_IMPORT_HEAVY)]
    assert 'kfvo_ros.camera' in core
    code = ('import importlib, sys\n'
            f'sys.modules.update(dict.fromkeys({HEAVY}))\n'
            'for name in sys.argv[1:]: importlib.import_module(name)')
    done = run_python('-c', code, *core)
    assert done.returncode == 0, done.stderr


def test_a_node_without_vggt_imports_no_torch() -> None:
    if importlib.util.find_spec('rclpy') is None:
        pytest.skip("rclpy is not installed: source a ROS 2 or pip install '.[ros]'")
    code = ('import sys\n'
            'import kfvo_ros.node, kfvo_ros.run, kfvo_ros.ros.node\n'
            'from kfvo_ros.odometry.factory import make_odometry\n'
            'from kfvo_ros.odometry.options import OdometryOptions\n'
            'odometry = make_odometry(OdometryOptions())\n'
            'assert (odometry.backbone.name, odometry.policy.name) == ("geometric", "learned")\n'
            'print(*sys.modules)')
    done = run_python('-c', code)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert 'rclpy' in loaded and not loaded & {'torch', 'PIL', 'huggingface_hub'}


# Missing dependencies


def test_a_missing_dependency_names_its_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = {root for path in SOURCES for name in imported_modules(path)
                for root in [name.split('.')[0]]} - sys.stdlib_module_names - {'kfvo_ros'}
    installed = importlib.metadata.packages_distributions()
    named = set()
    for module in sorted(imported - ROS_MODULES - {'tf2_ros'}):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ModuleNotFoundError) as caught:
            importlib.import_module(module)
        line = str(missing_dependency(caught.value))
        assert line.startswith(f'{module} is missing: pip install ')
        distribution = line.split()[-1]
        assert canonical(distribution) in map(canonical, installed[module])
        named.add(canonical(distribution))
    assert {'opencv-python-headless', 'pyyaml', 'numpy', 'torch', 'pillow'} <= named


def test_a_missing_module_of_the_package_stays_an_import_error() -> None:
    with pytest.raises(ModuleNotFoundError) as caught:
        importlib.import_module('kfvo_ros.no_such_module')
    with pytest.raises(ModuleNotFoundError, match='no_such_module'):
        missing_dependency(caught.value)


@pytest.mark.parametrize('module', ['numpy', 'poselib'])
def test_run_names_a_missing_dependency(module: str, tmp_path: Path) -> None:
    code = ('import sys\n'
            f'sys.modules[{module!r}] = None\n'
            'from kfvo_ros.run import main\n'
            'sys.exit(main(["synthetic:0", "--stop", "2", "--output", sys.argv[1]]))')
    done = run_python('-c', code, tmp_path)
    assert_one_readable_line(done, f'{module} is missing: pip install {module}')


# Installation by colcon


@pytest.fixture(scope='module')
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace in which colcon built a copy of this source tree."""
    if importlib.util.find_spec('colcon') is None:
        pytest.skip('colcon is not installed: pip install colcon-common-extensions')
    folder = tmp_path_factory.mktemp('workspace')
    source = folder / 'src' / 'kfvo_ros'
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*BUILT))
    # An extra file in each folder that setup.py installs.
    for name in ('config', 'launch', 'rviz', 'foxglove'):
        (source / name).mkdir(exist_ok=True)
        (source / name / 'probe').touch()
    done = subprocess.run([sys.executable, '-m', 'colcon', 'build'], cwd=folder, text=True,
                          env={**os.environ, 'COLCON_HOME': str(folder)},
                          timeout=time_limit(300.0), capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope='module')
def distribution(workspace: Path) -> importlib.metadata.Distribution:
    """Return the metadata of the installed package."""
    site_packages = next(workspace.glob('install/kfvo_ros/lib/python3*/site-packages'))
    return next(iter(importlib.metadata.distributions(name='kfvo_ros', path=[str(site_packages)])))


def start(workspace: Path, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run an installed script as `ros2 run` does, after sourcing the workspace."""
    script = workspace / 'install' / 'kfvo_ros' / 'lib' / 'kfvo_ros' / command
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ['PATH']])
    return subprocess.run(['sh', '-c', '. install/local_setup.sh && exec "$0" "$@"', str(script),
                           *arguments], cwd=workspace, env={**os.environ, 'PATH': path},
                          text=True, capture_output=True, timeout=time_limit(120.0), check=False)


def test_declarations_agree(distribution: importlib.metadata.Distribution) -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    declared = distribution.metadata
    assert manifest.findtext('name') == declared['Name'].replace('-', '_') == 'kfvo_ros'
    assert manifest.findtext('version') == distribution.version == kfvo_ros.__version__
    assert manifest.findtext('description') == declared['Summary']
    assert manifest.findtext('license') == 'Apache-2.0'
    assert 'Apache-2.0' in (declared.get('License'), declared.get('License-Expression'))
    assert manifest.findtext('export/build_type') == 'ament_python'
    assert f'## {kfvo_ros.__version__}' in (ROOT / 'CHANGELOG.md').read_text(encoding='utf-8')


def test_every_requirement_has_a_pin(distribution: importlib.metadata.Distribution) -> None:
    requires = distribution.requires or []
    named = {canonical(re.match(r'[\w.-]+', line)[0]) for line in requires}
    for file in ('constraints.txt', 'constraints-jazzy.txt'):
        pins = set(re.findall(r'^([\w.-]+)==', (ROOT / file).read_text(), re.MULTILINE))
        assert named <= pins, f'{file} lacks {named - pins}'


def test_installed_files(workspace: Path) -> None:
    installed = workspace / 'install' / 'kfvo_ros'
    share = installed / 'share' / 'kfvo_ros'
    assert (installed / 'share/ament_index/resource_index/packages/kfvo_ros').is_file()
    assert (share / 'package.xml').is_file()
    for folder in ('config', 'launch', 'rviz', 'foxglove'):
        assert (share / folder / 'probe').is_file()
    package = next(installed.glob('lib/python3*/site-packages')) / 'kfvo_ros'
    assert (package / 'evaluation' / 'published.yaml').is_file()
    assert (package / 'keyframes' / 'geometric.safetensors').is_file()
    assert (package / 'py.typed').is_file()
    scripts = {path.name: path for path in (installed / 'lib' / 'kfvo_ros').iterdir()}
    assert set(scripts) == set(COMMANDS)
    for script in scripts.values():
        assert script.read_text().startswith('#!/usr/bin/env python3\n')
        assert os.access(script, os.X_OK)


@pytest.mark.parametrize(('command', 'word'), COMMANDS.items())
def test_installed_commands_start(command: str, word: str, workspace: Path) -> None:
    done = start(workspace, command, '--help')
    assert done.returncode == 0, done.stderr
    assert word in done.stdout


# Files


@pytest.mark.parametrize('path', [ROOT / 'setup.py', *SOURCES, *(ROOT / 'test').rglob('*.py'),
                                  *(ROOT / 'launch').rglob('*.py')],
                         ids=lambda path: str(path.relative_to(ROOT)))
def test_licence_header(path: Path) -> None:
    lines = path.read_text(encoding='utf-8').splitlines()
    assert not lines or lines[:2] == HEADER


def test_camera_of_the_euroc_bags() -> None:
    camera = read_camera_info(ROOT / 'config' / 'euroc_cam0.yaml')
    assert (camera.width, camera.height) == (752, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (458.654, 457.296, 367.215, 248.375)
    assert camera.distortion[:4] == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


def test_ros_messages_are_serialised() -> None:
    if importlib.util.find_spec('rclpy') is None:
        pytest.skip("rclpy is not installed: source a ROS 2 or pip install '.[ros]'")
    done = run_python('-c', 'import rclpy\n'
                         'from nav_msgs.msg import Odometry, Path\n'
                         'from rclpy.serialization import deserialize_message, serialize_message\n'
                         'message = Odometry(child_frame_id="camera_body")\n'
                         'again = deserialize_message(serialize_message(message), Odometry)\n'
                         'assert again == message')
    assert done.returncode == 0, done.stderr

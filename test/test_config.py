# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Presets, calibrations, launch file and views that are installed."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from kfvo_ros.ros.options import node_parameters
from kfvo_ros.sequences.calibration import read_camera_info
from kfvo_ros.sequences.tum import FREIBURG
from kfvo_ros.utils.files import find_config

ROOT = Path(__file__).resolve().parent.parent
LAUNCH = ROOT / 'launch' / 'kfvo.launch.py'
PRESETS = ('euroc', 'tum', 'kitti')


@pytest.mark.parametrize('name', PRESETS)
def test_presets_set_existing_parameters(name: str) -> None:
    preset = yaml.safe_load((ROOT / 'config' / f'{name}.yaml').read_text())
    values = preset['/**']['ros__parameters']
    assert values['image_topic'].startswith('/')
    assert set(values) <= {each.name for each in node_parameters()}
    if 'camera_info_file' in values:
        read_camera_info(find_config(values['camera_info_file']))


@pytest.mark.parametrize('number', sorted(FREIBURG))
def test_tum_calibrations_equal_those_of_the_reader(number: str) -> None:
    read = read_camera_info(ROOT / 'config' / f'tum_freiburg{number}.yaml')
    assert read == FREIBURG[number]


def test_find_config_searches_the_config_folder(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config('euroc_cam0.yaml').samefile(ROOT / 'config' / 'euroc_cam0.yaml')
    assert find_config('none_such.yaml') == Path('none_such.yaml')
    (tmp_path / 'euroc_cam0.yaml').touch()
    assert find_config('euroc_cam0.yaml').samefile(tmp_path / 'euroc_cam0.yaml')


def test_find_config_searches_installed_prefixes(tmp_path: Path,
                                             monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / 'share' / 'kfvo_ros' / 'config' / 'of_my_robot.yaml'
    installed.parent.mkdir(parents=True)
    installed.touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(('/nowhere', str(tmp_path))))
    assert find_config('of_my_robot.yaml') == installed


class FakeLaunch:
    """Replaces classes of launch, which has no wheels, and records their arguments."""

    def __init__(self, *arguments: object, **keywords: object) -> None:
        self.arguments, self.keywords = arguments, keywords

    def perform(self, context: Any) -> str:
        """Return the value of a LaunchConfiguration in a context of arguments."""
        return context.launch_configurations[self.arguments[0]]


class PackageNotFoundError(Exception):
    """Replaces that of ament_index_python."""


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the launch file as a module, with FakeLaunch for the classes of launch.

    No package is installed, as far as it can see.
    """
    def get_package_prefix(name: str) -> str:
        raise PackageNotFoundError(name)

    names = ('Action', 'DeclareLaunchArgument', 'LogInfo', 'OpaqueFunction', 'Shutdown',
             'LaunchConfiguration', 'Node', 'LaunchContext', 'LaunchDescription')
    classes = {name: type(name, (FakeLaunch,), {}) for name in names}
    for module in ('launch', 'launch.action', 'launch.actions', 'launch.substitutions',
                   'launch_ros', 'launch_ros.actions'):
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**classes))
    packages = SimpleNamespace(get_package_prefix=get_package_prefix,
                               PackageNotFoundError=PackageNotFoundError)
    monkeypatch.setitem(sys.modules, 'ament_index_python', SimpleNamespace(packages=packages))
    monkeypatch.setitem(sys.modules, 'ament_index_python.packages', packages)
    spec = importlib.util.spec_from_file_location('kfvo_launch', LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module


def start(launch_file: Any, **given: str) -> list[Any]:
    """Return the actions for launch arguments; those that are not given are empty."""
    arguments = dict.fromkeys((*launch_file.PARAMETERS, *launch_file.OTHERS), '') | given
    return launch_file._start(SimpleNamespace(launch_configurations=arguments))


def test_every_parameter_is_a_launch_argument(launch_file: Any) -> None:
    actions = launch_file.generate_launch_description().arguments[0]
    declared = {each.arguments[0]: each.keywords['description'] for each in actions
                if type(each).__name__ == 'DeclareLaunchArgument'}
    parameters = {each.name: each.description for each in node_parameters()}
    assert len(parameters) >= 30
    assert set(declared) == {*parameters, 'use_sim_time', 'preset', 'namespace', 'bag', 'rviz'}
    assert all(declared[name].startswith(text) for name, text in parameters.items())
    for name in PRESETS:
        assert name in declared['preset']


def test_launch_arguments_reach_the_node_in_their_types(launch_file: Any) -> None:
    node, = start(launch_file, preset='euroc', scale='2', publish_tf='False', window_size='5',
                  keyframes='every', use_sim_time='true')
    preset, values = node.keywords['parameters']
    assert Path(preset).samefile(ROOT / 'config' / 'euroc.yaml')
    assert values == {'scale': 2.0, 'publish_tf': False, 'window_size': 5, 'keyframes': 'every',
                      'use_sim_time': True}
    assert [type(values[name]) for name in ('scale', 'window_size')] == [float, int]
    assert 'on_exit' not in node.keywords


@pytest.mark.parametrize(('simulated', 'clock'), [('', []), ('true', ['--clock'])])
def test_a_bag_is_played_in_full_and_its_end_ends_all(launch_file: Any, tmp_path: Path,
                                                      simulated: str, clock: list[str]) -> None:
    node, player = start(launch_file, bag=str(tmp_path), use_sim_time=simulated, preset='kitti')
    assert node.keywords['parameters'][0] == {'process_every_frame': True}  # a preset may differ
    assert player.keywords['executable'] == 'kfvo_play'
    assert player.keywords['arguments'] == [str(tmp_path), *clock, '--wait-for-processing',
                                            '--wait-for-subscribers']
    for action in (node, player):
        assert type(action.keywords['on_exit']).__name__ == 'Shutdown'


def test_missing_rviz_is_said_and_the_node_starts(launch_file: Any,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    node, line = start(launch_file, rviz='true')
    assert node.keywords['executable'] == 'kfvo_node'
    assert 'rviz2 is not installed' in line.keywords['msg']
    monkeypatch.setattr(launch_file, 'get_package_prefix', lambda name: '/opt')
    node, viewer = start(launch_file, rviz='true')
    assert viewer.keywords['package'] == 'rviz2' and 'on_exit' not in viewer.keywords


def test_a_misspelt_launch_argument_is_named(launch_file: Any) -> None:
    line, node = start(launch_file, window_sise='5', arm_length='1')
    assert line.keywords['msg'] == 'unknown launch argument window_sise: is window_size meant?'


@pytest.mark.parametrize(('name', 'text', 'expected'), [
    ('window_size', '2', 'a whole number of at least 3 and at most 32'),
    ('keyframes', 'often', 'one of every, optical_flow, survival'),
    ('publish_tf', 'perhaps', 'true or false'), ('scale', 'nan', 'a number of at least'),
    ('rviz', 'maybe', 'true or false'), ('bag', '/no/such.bag', 'a bag, /no/such.bag does not'),
    ('preset', 'eurok', 'one of euroc, kitti, tum, or a parameter file'),
    ('preset', 'train', 'one of euroc, kitti, tum, or a parameter file')])
def test_an_invalid_launch_argument_is_an_error(launch_file: Any, name: str, text: str,
                                          expected: str) -> None:
    with pytest.raises(RuntimeError) as error:
        start(launch_file, **{name: text})
    assert f'launch argument {name}: expected {expected}' in str(error.value)
    assert text in str(error.value)


def test_documented_parameters_equal_those_of_the_node() -> None:
    lines = (ROOT / 'docs' / 'parameters.md').read_text().splitlines()
    rows = [[cell.strip(' `') for cell in line.split(' | ')] for line in lines
            if line.startswith('| `')]
    documented = {name.lstrip('| `'): (default, text.rstrip(' |')) for name, default, text in rows}
    assert list(documented) == [each.name for each in node_parameters()]
    for each in node_parameters():
        default, text = documented[each.name]
        plain = '' if each.default is None else str(each.default)
        assert default == (plain.lower() if isinstance(each.default, bool) else plain)
        choices = f' ({", ".join(each.choices)})' if each.choices else ''
        assert text.replace('`', '') == each.description + choices


def test_rviz_shows_the_topics_of_the_node() -> None:
    text = (ROOT / 'rviz' / 'kfvo.rviz').read_text()
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    topics = {display['Topic']['Value'] for display in displays if 'Topic' in display}
    assert topics == {'/kfvo/odometry', '/kfvo/path'}


def test_foxglove_layout_contains_every_panel() -> None:
    """test/ros compares the topics with those of the node."""
    layout = json.loads((ROOT / 'foxglove' / 'kfvo.json').read_text())

    def panels(part: str | dict) -> list[str]:
        return [part] if isinstance(part, str) else [*panels(part['first']),
                                                     *panels(part['second'])]

    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    scene = layout['configById']['3D!kfvo']
    assert (scene['followTf'], scene['layers']['grid']['frameId']) == ('odom', 'odom')

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

from kfvo_ros.camera import read_camera_info
from kfvo_ros.ros.options import node_parameters
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

    def perform(self, context: dict[str, str]) -> str:
        """Return the value of a LaunchConfiguration in a context of arguments."""
        return context[self.arguments[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the launch file as a module, with FakeLaunch for the classes of launch."""
    names = ('Action', 'DeclareLaunchArgument', 'ExecuteProcess', 'OpaqueFunction', 'IfCondition',
             'LaunchConfiguration', 'Node', 'LaunchContext', 'LaunchDescription')
    classes = {name: type(name, (FakeLaunch,), {}) for name in names}
    for module in ('launch', 'launch.action', 'launch.actions', 'launch.conditions',
                   'launch.substitutions', 'launch_ros', 'launch_ros.actions'):
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**classes))
    spec = importlib.util.spec_from_file_location('kfvo_launch', LAUNCH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module


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
    given = dict.fromkeys((*launch_file.PARAMETERS, *launch_file.OTHERS), '')
    given |= {'preset': 'euroc', 'bag': 'a.bag', 'scale': '2', 'publish_tf': 'False',
              'window_size': '5', 'keyframes': 'every', 'use_sim_time': 'true'}
    node, player = launch_file._start(given)
    preset, values = node.keywords['parameters']
    assert Path(preset).samefile(ROOT / 'config' / 'euroc.yaml')
    assert values == {'scale': 2.0, 'publish_tf': False, 'window_size': 5, 'keyframes': 'every',
                      'use_sim_time': True}
    assert [type(values[name]) for name in ('scale', 'window_size')] == [float, int]
    assert player.keywords['cmd'][-2:] == ['a.bag', '--wait-for-subscribers']


@pytest.mark.parametrize(('name', 'text', 'expected'), [
    ('window_size', '2', 'a whole number of at least 3 and at most 32'),
    ('keyframes', 'often', 'one of every, optical_flow, survival'),
    ('publish_tf', 'perhaps', 'true or false'), ('scale', 'nan', 'a number of at least')])
def test_an_invalid_launch_argument_is_an_error(launch_file: Any, name: str, text: str,
                                          expected: str) -> None:
    given = dict.fromkeys((*launch_file.PARAMETERS, *launch_file.OTHERS), '') | {name: text}
    with pytest.raises(RuntimeError) as error:
        launch_file._start(given)
    assert f'launch argument {name}: expected {expected}' in str(error.value)
    assert repr(text) in str(error.value)


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

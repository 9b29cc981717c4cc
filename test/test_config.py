# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The presets, calibrations and launch file that are installed."""

from __future__ import annotations

import ast
import json
import os
from dataclasses import fields
from pathlib import Path

import pytest
import yaml

from kfvo_ros.camera import read_camera_info
from kfvo_ros.odometry.options import OdometryOptions, VggtOptions
from kfvo_ros.sequences.tum import FREIBURG
from kfvo_ros.utils.files import find_config

ROOT = Path(__file__).resolve().parent.parent
PRESETS = ('euroc', 'tum', 'kitti')


def node_parameters() -> set[str]:
    parameters = pytest.importorskip('kfvo_ros.ros.parameters', reason='rclpy is not installed')
    return {field.name for kind in (OdometryOptions, VggtOptions, parameters.NodeOptions)
            for field in fields(kind)}


@pytest.mark.parametrize('name', PRESETS)
def test_preset_sets_parameters_that_exist(name: str) -> None:
    preset = yaml.safe_load((ROOT / 'config' / f'{name}.yaml').read_text())
    values = preset['/**']['ros__parameters']
    assert values['image_topic'].startswith('/')
    assert set(values) <= node_parameters()
    if 'camera_info_file' in values:
        read_camera_info(find_config(values['camera_info_file']))


@pytest.mark.parametrize('number', sorted(FREIBURG))
def test_tum_calibrations_are_those_of_its_reader(number: str) -> None:
    read = read_camera_info(ROOT / 'config' / f'tum_freiburg{number}.yaml')
    assert read == FREIBURG[number]


def test_a_file_of_the_config_folder_is_found_from_anywhere(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config('euroc_cam0.yaml').samefile(ROOT / 'config' / 'euroc_cam0.yaml')
    assert find_config('none_such.yaml') == Path('none_such.yaml')
    (tmp_path / 'euroc_cam0.yaml').touch()
    assert find_config('euroc_cam0.yaml').samefile(tmp_path / 'euroc_cam0.yaml')


def test_an_installed_config_folder_is_found(tmp_path: Path,
                                             monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / 'share' / 'kfvo_ros' / 'config' / 'of_my_robot.yaml'
    installed.parent.mkdir(parents=True)
    installed.touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(('/nowhere', str(tmp_path))))
    assert find_config('of_my_robot.yaml') == installed


def test_launch_arguments_are_parameters_of_the_node() -> None:
    tree = ast.parse((ROOT / 'launch' / 'kfvo.launch.py').read_text())
    tables = {node.targets[0].id: ast.literal_eval(node.value) for node in tree.body
              if isinstance(node, ast.Assign) and node.targets[0].id in ('PARAMETERS', 'OTHERS')}
    assert set(tables['PARAMETERS']) - {'use_sim_time'} <= node_parameters()
    assert all(text for text in tables['PARAMETERS'].values())
    for name in PRESETS:
        assert name in tables['OTHERS']['preset'][1]


def test_rviz_shows_what_the_node_publishes() -> None:
    text = (ROOT / 'rviz' / 'kfvo.rviz').read_text()
    displays = yaml.safe_load(text)['Visualization Manager']['Displays']
    topics = {display['Topic']['Value'] for display in displays if 'Topic' in display}
    assert topics == {'/kfvo/odometry', '/kfvo/path'}


def test_foxglove_layout_has_a_place_for_every_panel() -> None:
    """Which topics they show, test_node compares with what the node publishes."""
    layout = json.loads((ROOT / 'foxglove' / 'kfvo.json').read_text())

    def places(part: str | dict) -> list[str]:
        return [part] if isinstance(part, str) else [*places(part['first']),
                                                     *places(part['second'])]

    assert sorted(places(layout['layout'])) == sorted(layout['configById'])
    scene = layout['configById']['3D!kfvo']
    assert (scene['followTf'], scene['layers']['grid']['frameId']) == ('odom', 'odom')

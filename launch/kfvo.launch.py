# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start kfvo_node, optionally a bag and RViz; ``-s`` lists the launch arguments."""

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from kfvo_ros.ros.options import node_parameters
from kfvo_ros.utils.config import Option
from launch import LaunchContext, LaunchDescription

SHARE = Path(__file__).resolve().parent.parent
USE_SIM_TIME = Option('use_sim_time', bool, False, False, False, 'use the time of /clock')
PARAMETERS = {each.name: each for each in (*node_parameters(), USE_SIM_TIME)}
"""Parameters of the node; an empty argument is not passed on."""
RVIZ = Option('rviz', bool, False, False, False)
PRESETS = {path.stem: path for path in sorted((SHARE / 'config').glob('*.yaml'))
           if 'ros__parameters:' in path.read_text('utf-8')}
OTHERS = {
    'preset': ('', f'parameters of a dataset ({", ".join(PRESETS)}), or a parameter file'),
    'namespace': ('', 'namespace of the node'),
    'bag': ('', 'bag to play, ROS 1 or ROS 2, without dropping images; at its end all is ended'),
    'rviz': ('false', 'show odometry and path in RViz: true or false'),
}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments with their descriptions, and the actions."""
    arguments = {name: ('', _describe(each)) for name, each in PARAMETERS.items()} | OTHERS
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in arguments.items()),
        OpaqueFunction(function=_start)])


def _describe(parameter: Option) -> str:
    """Return description and default; an empty argument keeps the value of preset or node."""
    default = '' if parameter.default in (None, '') else f' (default of the node: ' \
                                                         f'{parameter.default})'
    return f'{parameter.description}{default}'


def _start(context: LaunchContext) -> list[Action]:
    """Return the actions that start node, bag and RViz; RuntimeError for a wrong argument."""
    given = {name: LaunchConfiguration(name).perform(context) for name in (*PARAMETERS, *OTHERS)}
    values = {name: _value(each, given[name]) for name, each in PARAMETERS.items() if given[name]}
    bag, simulated = given['bag'], bool(values.get('use_sim_time'))
    parameters: list[str | dict] = [{'process_every_frame': True}] if bag else []
    if given['preset']:
        parameters.append(str(_find_preset(given['preset'])))
    end = {'on_exit': Shutdown(reason='the bag or the node has ended')} if bag else {}
    actions: list[Action] = [
        *_unknown(context.launch_configurations),
        Node(package='kfvo_ros', executable='kfvo_node', output='screen',
             namespace=given['namespace'], parameters=[*parameters, values], **end)]
    if bag:
        path = Path(os.path.expanduser(bag))
        if not path.exists():
            raise RuntimeError(f'launch argument bag: expected a bag, {bag} does not exist')
        # Not by `ros2 run`, which does not pass on the signal that ends a launch.
        actions.append(Node(
            package='kfvo_ros', executable='kfvo_play', output='screen', **end,
            arguments=[str(path), *(['--clock'] if simulated else []), '--wait-for-processing',
                       '--wait-for-subscribers']))
    if _value(RVIZ, given['rviz'] or 'false'):
        actions.append(_rviz(simulated))
    return actions


def _find_preset(name: str) -> Path:
    """Return the file of a preset, or a parameter file of this path."""
    path = PRESETS.get(name, Path(os.path.expanduser(name)))
    if not path.is_file():
        raise RuntimeError(f'launch argument preset: expected one of {", ".join(PRESETS)}, or a '
                           f'parameter file; came {name!r}')
    return path


def _rviz(simulated: bool) -> Action:
    """Return the action that starts RViz, or says that it is not installed."""
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return LogInfo(msg='rviz:=true, but rviz2 is not installed (apt install '
                           'ros-jazzy-rviz2): the node runs without it')
    return Node(package='rviz2', executable='rviz2', parameters=[{'use_sim_time': simulated}],
                arguments=['-d', str(SHARE / 'rviz' / 'kfvo.rviz')])


def _unknown(names: Iterable[str]) -> list[Action]:
    """Return a log line for each argument that looks like a misspelt one.

    Others may belong to a launch file that includes this one.
    """
    known = (*PARAMETERS, *OTHERS)
    similar = {name: difflib.get_close_matches(name, known, 1, 0.8)
               for name in names if name not in known}
    return [LogInfo(msg=f'unknown launch argument {name}: is {found[0]} meant?')
            for name, found in similar.items() if found]


def _value(parameter: Option, text: str) -> str | bool | int | float:
    """Return the value of a launch argument in the type of its parameter."""
    try:
        return parameter.parse(text)
    except ValueError as error:
        raise RuntimeError(f'launch argument {parameter.name}: {error}') from error

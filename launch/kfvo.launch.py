# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start kfvo_node, optionally a bag and RViz; ``-s`` lists the launch arguments."""

from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from kfvo_ros.ros.options import node_parameters
from kfvo_ros.utils.config import Option
from launch import LaunchContext, LaunchDescription

SHARE = Path(__file__).resolve().parent.parent
USE_SIM_TIME = Option('use_sim_time', bool, False, False, False, 'use the time of /clock')
PARAMETERS = {each.name: each for each in (*node_parameters(), USE_SIM_TIME)}
"""Parameters of the node; an empty argument is not passed on."""
OTHERS = {
    'preset': ('', 'parameters of a dataset (euroc, tum, kitti), or a parameter file'),
    'namespace': ('', 'namespace of the node'),
    'bag': ('', 'bag to play, ROS 1 or ROS 2'),
    'rviz': ('false', 'show odometry and path in RViz: true or false'),
}


def generate_launch_description() -> LaunchDescription:
    """Return the arguments with their descriptions, and the actions."""
    arguments = {name: ('', _describe(each)) for name, each in PARAMETERS.items()} | OTHERS
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in arguments.items()),
        OpaqueFunction(function=_start),
        Node(package='rviz2', executable='rviz2', condition=IfCondition(
            LaunchConfiguration('rviz')), arguments=['-d', str(SHARE / 'rviz' / 'kfvo.rviz')])])


def _describe(parameter: Option) -> str:
    """Return description and default; an empty argument keeps the value of preset or node."""
    default = '' if parameter.default in (None, '') else f' (default of the node: ' \
                                                         f'{parameter.default})'
    return f'{parameter.description}{default}'


def _start(context: LaunchContext) -> list[Action]:
    """Return the actions that start the node, with the given arguments, and the bag."""
    given = {name: LaunchConfiguration(name).perform(context)
             for name in (*PARAMETERS, 'preset', 'namespace', 'bag')}
    parameters: list[str | dict] = []
    if given['preset']:
        preset = SHARE / 'config' / f'{given["preset"]}.yaml'
        parameters.append(str(preset if preset.is_file() else given['preset']))
    parameters.append({name: _value(each, given[name]) for name, each in PARAMETERS.items()
                       if given[name]})
    actions: list[Action] = [Node(package='kfvo_ros', executable='kfvo_node', output='screen',
                                  namespace=given['namespace'], parameters=parameters)]
    if given['bag']:
        actions.append(ExecuteProcess(cmd=['ros2', 'run', 'kfvo_ros', 'kfvo_play', given['bag'],
                                           '--wait-for-subscribers'], output='screen'))
    return actions


def _value(parameter: Option, text: str) -> str | bool | int | float:
    """Return the value of a launch argument in the type of its parameter."""
    try:
        return parameter.parse(text)
    except ValueError as error:
        raise RuntimeError(f'launch argument {parameter.name}: {error}') from error

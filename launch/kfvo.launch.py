# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start kfvo_node, and if asked a bag and RViz: ros2 launch kfvo_ros kfvo.launch.py -s."""

from pathlib import Path

from launch.action import Action
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

SHARE = Path(__file__).resolve().parent.parent

# Parameters of the node: what is left empty here is what the preset or the node says.
PARAMETERS = {
    'image_topic': 'images to follow; ends in /compressed for CompressedImage',
    'camera_info_file': 'calibration (camera_info.yaml) that wins over the CameraInfo topic',
    'keyframes': 'keyframe policy: every, optical_flow, survival or learned',
    'backbone': 'model: geometric, or vggt on a GPU',
    'weights': 'weights of vggt: a repository on the hub, or a file',
    'base_frame': 'frame whose pose is given, such as base_link',
    'base_to_camera': 'where the camera is on the base: "x y z qx qy qz qw"',
    'scale': 'metres per unit of the trajectory',
    'publish_tf': 'send odom -> base as TF: true or false',
    'trajectory_file': 'TUM file to write',
    'use_sim_time': 'take the time of /clock: true or false',
}
OTHERS = {
    'preset': ('', 'parameters of a dataset (euroc, tum, kitti), or a parameter file'),
    'namespace': ('', 'namespace of the node'),
    'bag': ('', 'bag to play, of ROS 1 too'),
    'rviz': ('false', 'show odometry and path in RViz: true or false'),
}


def generate_launch_description() -> LaunchDescription:
    """Return arguments, each with its description, and what they start."""
    texts = {name: ('', text) for name, text in PARAMETERS.items()} | OTHERS
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, (default, text) in texts.items()),
        OpaqueFunction(function=_start),
        Node(package='rviz2', executable='rviz2', condition=IfCondition(
            LaunchConfiguration('rviz')), arguments=['-d', str(SHARE / 'rviz' / 'kfvo.rviz')])])


def _start(context: LaunchContext) -> list[Action]:
    """Start the node with the arguments that were given, and the bag."""
    given = {name: LaunchConfiguration(name).perform(context)
             for name in (*PARAMETERS, 'preset', 'namespace', 'bag')}
    parameters: list[str | dict] = []
    if given['preset']:
        preset = SHARE / 'config' / f'{given["preset"]}.yaml'
        parameters.append(str(preset if preset.is_file() else given['preset']))
    parameters.append({name: _typed(name, given[name]) for name in PARAMETERS if given[name]})
    actions: list[Action] = [Node(package='kfvo_ros', executable='kfvo_node', output='screen',
                                  namespace=given['namespace'], parameters=parameters)]
    if given['bag']:
        actions.append(ExecuteProcess(cmd=['ros2', 'run', 'kfvo_ros', 'kfvo_play', given['bag'],
                                           '--wait-for-subscribers'], output='screen'))
    return actions


def _typed(name: str, text: str) -> str | bool | float:
    """Return a parameter's value in its type."""
    if name in ('publish_tf', 'use_sim_time'):
        return text.lower() in ('true', '1', 'yes')
    return float(text) if name == 'scale' else text

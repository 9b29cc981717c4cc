# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where each module comes from, for the line that names a missing one."""

from __future__ import annotations

from kfvo_ros.errors import KfvoError, reason_of

PIP_NAMES = {'cv2': 'opencv-python-headless', 'mcap': 'mcap', 'numba': 'numba',
             'numpy': 'numpy', 'poselib': 'poselib', 'rosbags': 'rosbags',
             'safetensors': 'safetensors', 'threadpoolctl': 'threadpoolctl', 'tqdm': 'tqdm',
             'yaml': 'PyYAML'}
"""The modules of setup.py's install_requires, by the name they are imported under."""

OPTIONAL_PIP_NAMES = {'matplotlib': 'matplotlib', 'torch': 'torch', 'PIL': 'pillow',
                      'huggingface_hub': 'huggingface-hub', 'gymnasium': 'gymnasium',
                      'stable_baselines3': 'stable-baselines3', 'tensorboard': 'tensorboard'}
"""Modules that one command needs: an extra of setup.py brings them."""

ROS_MODULES = frozenset(('rclpy', 'rcl_interfaces', 'rosgraph_msgs', 'sensor_msgs', 'nav_msgs',
                         'geometry_msgs', 'diagnostic_msgs', 'std_msgs', 'std_srvs',
                         'builtin_interfaces'))
"""What a ROS 2 installation brings; setup.py has it as wheels, under the extra ``ros``."""


def missing_dependency(error: ImportError) -> KfvoError:
    """Return the one line to show for a module that is missing, or is there and does not load.

    Raises the error itself when no package of setup.py would bring the module: that is a
    mistake of ours, not of the installation.
    """
    module = (error.name or '').partition('.')[0]
    problem = 'is missing' if isinstance(error, ModuleNotFoundError) else \
        f'cannot be imported ({reason_of(error)})'
    if module in ROS_MODULES:
        return KfvoError(f"{module} {problem}: source /opt/ros/jazzy/setup.bash, or pip install "
                         "'kfvo_ros[ros]' where there is none")
    packages = PIP_NAMES | OPTIONAL_PIP_NAMES
    if module not in packages:
        raise error
    return KfvoError(f'{module} {problem}: pip install {packages[module]}')

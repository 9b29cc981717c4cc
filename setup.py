# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Install kfvo_ros, by pip or as an ament_python package by colcon."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'kfvo_ros'
INSTALLED_FOLDERS = ('config', 'launch', 'rviz', 'foxglove')

setup(
    name=NAME,
    version='0.1.0',
    description='Keyframe-based feed-forward visual odometry for ROS 2',
    license='Apache-2.0',
    maintainer='The kfvo_ros authors',
    maintainer_email='maintainers@kfvo-ros.example',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed'], f'{NAME}.evaluation': ['published.yaml'],
                  f'{NAME}.keyframes': ['*.safetensors']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *((f'share/{NAME}/{folder}', glob(f'{folder}/*')) for folder in INSTALLED_FOLDERS),
    ],
    python_requires='>=3.10',
    install_requires=[
        'lz4>=4.0',
        'mcap>=1.0',
        'numba>=0.58',
        'numpy>=1.26',
        'opencv-python-headless>=4.6',
        'poselib>=2.0.4',
        'PyYAML>=6.0',
        'rosbags>=0.11',
        'safetensors>=0.4',
        'threadpoolctl>=3.1',
        'tqdm>=4.60',
        'zstandard>=0.20',
    ],
    extras_require={
        # ROS 2 Jazzy as wheels (Linux x86-64 only), for machines without /opt/ros. The
        # ros-jazzy-* packages select the distribution; the exact versions prevent a newer one.
        'ros': [
            'ros-jazzy-rclpy',
            'ros-jazzy-common-interfaces',
            'ros-rclpy[fastrtps]==7.1.6',
            'ros-common-interfaces==5.3.6',
        ],
        'vggt': ['torch>=2.3', 'huggingface_hub>=0.23', 'pillow>=9.0'],
        'train': ['stable-baselines3>=2.4', 'gymnasium>=0.29.1', 'matplotlib>=3.6', 'pillow>=9.0',
                  'tensorboard>=2.9'],
        'demo': ['matplotlib>=3.6'],
        'test': ['colcon-common-extensions', 'evo>=1.31', 'mypy', 'pytest>=7.0',
                 'pytest-xdist>=3.3', 'ruff'],
    },
    entry_points={
        'console_scripts': [
            'kfvo_run = kfvo_ros.run:main',
            'kfvo_node = kfvo_ros.node:main',
            'kfvo_convert = kfvo_ros.convert:main',
            'kfvo_play = kfvo_ros.play:main',
            'kfvo_train = kfvo_ros.train:main',
            'kfvo_benchmark = kfvo_ros.benchmark:main',
        ],
    },
)

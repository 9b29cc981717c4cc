# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe-based feed-forward visual odometry for ROS 2."""

__version__ = '0.1.0'

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node and bag player; the only package that imports rclpy."""

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What meets ROS 2: the only package that imports rclpy."""

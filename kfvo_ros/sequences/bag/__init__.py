# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 1 and ROS 2 bags, read and written without a ROS installation."""

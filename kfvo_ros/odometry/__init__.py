# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method: keyframe odometry, and its online and offline results."""

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe odometry: the method, its options and its online form."""

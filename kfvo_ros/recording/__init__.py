# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings for ROS 2, written without ROS."""

CODECS = ('png', 'jpeg')
"""Compressions of images by the name that ROS gives them; the first loses nothing."""

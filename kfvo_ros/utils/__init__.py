# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Helpers that know nothing of odometry: options, commands, files, process, signals."""

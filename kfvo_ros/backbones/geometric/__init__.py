# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Geometric backbone for any CPU: KLT tracks and windowed bundle adjustment."""

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Metrics of trajectories, and the benchmark: runs, tables and plots."""

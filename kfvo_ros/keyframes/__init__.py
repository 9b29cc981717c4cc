# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies: which frames stay in the window."""

HEURISTICS = ('every', 'optical_flow', 'survival')
"""Rules that the benchmark compares by default."""
POLICIES = (*HEURISTICS, 'parallax', 'learned')
"""Names of all policies, as in options and results."""

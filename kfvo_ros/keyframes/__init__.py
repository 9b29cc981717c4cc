# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies: which frames stay in the window."""

HEURISTICS = ('every', 'optical_flow', 'survival')
"""Names of the policies by rule."""
POLICIES = (*HEURISTICS, 'learned')
"""Names of the policies, as options and results have them."""

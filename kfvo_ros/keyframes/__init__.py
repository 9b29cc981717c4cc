# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframe policies: which frames stay in the window."""

POLICIES = ('every', 'optical_flow', 'survival', 'learned')
"""Names of the policies, as options and results have them."""

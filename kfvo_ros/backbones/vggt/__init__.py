# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT as a backbone: written for windows that slide, with the published weights."""

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Models that place the frames of a window; `base` is the contract."""

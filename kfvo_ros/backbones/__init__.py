# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Models that estimate the poses of a window's frames; `base` is the contract."""

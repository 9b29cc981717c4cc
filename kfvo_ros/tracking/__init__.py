# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""KLT front end: corner detection and tracking from image to image."""

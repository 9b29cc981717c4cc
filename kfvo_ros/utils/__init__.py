# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all rooms use and none owns: files, processes, command lines, options."""

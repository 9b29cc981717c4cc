# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a benchmark makes of many runs: scores, tables, pictures, pages."""

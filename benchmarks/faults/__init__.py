# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0

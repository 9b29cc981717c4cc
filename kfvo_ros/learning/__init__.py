# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learning to choose keyframes; nothing here is needed to run a policy that was learned."""

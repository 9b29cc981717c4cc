# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""PPO training of keyframe policies; running a policy does not need this package."""

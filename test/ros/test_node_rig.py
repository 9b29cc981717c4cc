# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rig of the node's tests ends its node where that never becomes ready."""

from __future__ import annotations

import pytest
from command_lines import leftovers
from node_rig import Rig

from kfvo_ros.utils.process import time_limit


def test_a_node_that_is_not_ready_in_time_is_ended():
    rig = Rig(timeout_s=0.01)
    with pytest.raises(AssertionError, match='not true within'), rig:
        pass
    assert rig.process.poll() is not None and leftovers(time_limit(5.0)) == {}

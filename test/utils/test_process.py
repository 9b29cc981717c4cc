# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Information about host and process."""

from __future__ import annotations

from kfvo_ros.utils.process import host_info


def test_host_info_names_processor_cores_and_python():
    name = host_info()
    assert 'cores, Python 3.' in name and not name.startswith(',')

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which pip package brings which module, for the line that names a missing one."""

from __future__ import annotations

from kfvo_ros.errors import KfvoError

PIP_NAMES = {'cv2': 'opencv-python-headless', 'mcap': 'mcap', 'numba': 'numba',
             'numpy': 'numpy', 'poselib': 'poselib', 'rosbags': 'rosbags',
             'threadpoolctl': 'threadpoolctl', 'tqdm': 'tqdm', 'yaml': 'PyYAML'}
"""The modules of setup.py's install_requires, by the name they are imported under."""


def missing_dependency(error: ModuleNotFoundError) -> KfvoError:
    """Return the one line to show for an import that failed.

    Raises the error itself when no package of setup.py would bring the module: that is a
    mistake of ours, not of the installation.
    """
    module = (error.name or '').partition('.')[0]
    if module not in PIP_NAMES:
        raise error
    return KfvoError(f'{module} is missing: pip install {PIP_NAMES[module]}')

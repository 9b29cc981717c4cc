# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Training with VGGT: one encode and one estimate per step of all environments."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from sequence_writers import make_image, make_poses, write_tartanair
from vggt_models import WIDTH, small_model

pytest.importorskip('stable_baselines3', reason="stable-baselines3 is not installed: pip install "
                    "'.[train]'")

from kfvo_ros.backbones.base import Backbone
from kfvo_ros.backbones.vggt.backbone import VggtBackbone
from kfvo_ros.keyframes.guard import NO_GUARD
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions
from kfvo_ros.training.augmentation import Augmentation
from kfvo_ros.training.env import OBSERVATION
from kfvo_ros.training.sampler import EnvironmentConfig, make_environment

ENVIRONMENTS, FRAMES = 20, 20


@dataclass(frozen=True)
class SmallConfig(EnvironmentConfig):
    """Environments with the small model."""

    def make_backbone(self) -> Backbone:
        return VggtBackbone(small_model(), WIDTH)


def test_twenty_sequences_take_one_encode_and_one_estimate_per_step(tmp_path):
    sequences = [write_tartanair(tmp_path / str(number),
                                 [make_image(FRAMES * number + frame) for frame in range(FRAMES)],
                                 make_poses(FRAMES, number))[0] for number in range(ENVIRONMENTS)]
    calls: Counter[str] = Counter()

    def counter(name):
        return lambda module, inputs, output: calls.update([name])

    config = SmallConfig(
        tuple(map(str, sequences)),
        SequenceOptions(stop=FRAMES), OdometryOptions(backbone='vggt', scale_rule='none'),
        augmentation=Augmentation(drop_share=0.0, max_stride=1, frames=FRAMES),
        variants=1, reward='paper', guard=NO_GUARD)
    environment = make_environment(config, ENVIRONMENTS, 1, 0)
    observed = environment.reset()[OBSERVATION]
    assert len(np.unique(observed, axis=0)) == ENVIRONMENTS
    parts = {'encode': small_model().aggregator.patch_embed,
             'estimate': small_model().camera_head}
    hooks = [part.register_forward_hook(counter(name)) for name, part in parts.items()]
    try:
        rng = np.random.default_rng(0)
        for step in range(1, FRAMES - 8 + 1):
            _, rewards, dones, _ = environment.step(rng.integers(0, 2, ENVIRONMENTS))
            assert not dones.any() and np.isfinite(rewards).all()
            assert calls == {'encode': step, 'estimate': step}
    finally:
        for hook in hooks:
            hook.remove()

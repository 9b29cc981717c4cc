# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learned policies of random numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.learned import Actor, Layer, PolicyFile, PolicySignature

ALWAYS, NEVER = (-1e6, 1e6), (1e6, -1e6)
"""Biases to drop and to keep: of a policy that keeps, and one that drops but for the rail."""


def random_actor(size: int, seed: int = 0) -> Actor:
    """Return an actor that sees so many numbers."""
    random = np.random.default_rng(seed)
    sizes = [size, 256, 256, 2]
    return Actor(random.normal(size=size), random.uniform(0.5, 2.0, size),
                 tuple(Layer(random.normal(0.0, last ** -0.5, (out, last)).astype(np.float32),
                             random.normal(size=out).astype(np.float32))
                       for last, out in zip(sizes, sizes[1:])))


def write_policy(path: Path, setting: PolicySignature, bias: tuple[float, float]) -> Path:
    """Write a policy for this setting that does what the bias says."""
    actor = random_actor(sum(size for _, size in setting.observation))
    last = replace(actor.layers[-1], bias=np.array(bias, np.float32))
    PolicyFile(replace(actor, layers=(*actor.layers[:-1], last)), KeyframeGuard(), setting).write(path)
    return path

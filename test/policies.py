# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learned policies with random weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kfvo_ros.keyframes.guard import KeyframeGuard
from kfvo_ros.keyframes.learned import Actor, Layer, PolicyFile, PolicySignature

ALWAYS, NEVER = (-1e6, 1e6), (1e6, -1e6)
"""Output biases (drop, keep) of policies that always and never keep where the guard allows."""


def random_actor(size: int, seed: int = 0) -> Actor:
    """Return an actor of `size` inputs."""
    rng = np.random.default_rng(seed)
    sizes = [size, 256, 256, 2]
    return Actor(rng.normal(size=size), rng.uniform(0.5, 2.0, size),
                 tuple(Layer(rng.normal(0.0, last ** -0.5, (out, last)).astype(np.float32),
                             rng.normal(size=out).astype(np.float32))
                       for last, out in zip(sizes, sizes[1:])))


def write_policy(path: Path, signature: PolicySignature, bias: tuple[float, float]) -> Path:
    """Write a policy of this signature and output bias; return the path."""
    actor = random_actor(sum(size for _, size in signature.observation))
    last = replace(actor.layers[-1], bias=np.array(bias, np.float32))
    actor = replace(actor, layers=(*actor.layers[:-1], last))
    PolicyFile(actor, KeyframeGuard(), signature).write(path)
    return path

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small files of tensors, policies, checkpoints and weights, and their readers."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.outcomes import Answer
from kfvo_ros.errors import KfvoError

WIDTH, DEPTH = 64, 2
"""Width and layers of the VGGT model."""


def write_policy(folder: Path) -> Path:
    """Write a keyframe policy of random weights."""
    from kfvo_ros.keyframes.guard import KeyframeGuard
    from kfvo_ros.keyframes.learned import Actor, Layer, PolicyFile, PolicySignature
    rng, sizes = np.random.default_rng(0), (12, 16, 2)
    layers = tuple(Layer(rng.normal(size=(out, last)).astype(np.float32),
                         rng.normal(size=out).astype(np.float32))
                   for last, out in zip(sizes, sizes[1:]))
    path = folder / 'policy.safetensors'
    PolicyFile(Actor(rng.normal(size=12), rng.uniform(0.5, 2.0, 12), layers), KeyframeGuard(),
               PolicySignature('geometric', 'depth', 8, (('descriptor', 5), ('poses', 7))),
               {'steps': 0}).write(path)
    return path


def read_policy(path: Path) -> Answer:
    """Read a policy."""
    from kfvo_ros.keyframes.learned import read_policy as read
    try:
        policy = read(path)
    except KfvoError as error:
        return Answer(error=str(error))
    arrays = [policy.actor.mean, policy.actor.std,
              *(array for layer in policy.actor.layers for array in (layer.weight, layer.bias))]
    about = [repr(each) for each in (policy.guard, policy.signature, policy.training,
                                     policy.actor.clip)]
    return Answer(len(arrays), _digest(arrays, *about))


def _plan() -> Any:
    """Return the plan of the checkpoint's training."""
    from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
    from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
    from kfvo_ros.training.config import read_training_config
    from kfvo_ros.training.plan import TrainingSetup
    setup = TrainingSetup(0, read_training_config('train.yaml').shortened(),
                          OdometryOptions(scale_rule='depth'), SequenceOptions(), VggtOptions(),
                          None)
    return setup.plan(('synthetic:1',), ('synthetic:3',), GeometricBackbone())


def write_checkpoint(folder: Path) -> Path:
    """Write a checkpoint of a small network and its optimiser."""
    import torch

    from kfvo_ros.training.checkpoint import Checkpoint
    from kfvo_ros.utils.config import to_mapping
    torch.manual_seed(0)
    network = torch.nn.Linear(12, 16)
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(12)).sum().backward()
    optimiser.step()
    parameters = {'policy': dict(network.state_dict()),
                  'policy.optimizer': optimiser.state_dict()}
    statistics = {'returns': {'mean': torch.zeros(()), 'var': torch.ones(()), 'count': 4.0}}
    path = folder / 'checkpoint.pt'
    Checkpoint(to_mapping(_plan()), 128, 0.5, parameters, statistics).write(path)
    return path


def read_checkpoint(path: Path) -> Answer:
    """Read a checkpoint as kfvo_train --resume does."""
    from kfvo_ros.training.checkpoint import read_checkpoint as read
    try:
        checkpoint = read(path, _plan())
    except KfvoError as error:
        return Answer(error=str(error))
    return Answer(1, hashlib.sha256(repr(vars(checkpoint)).encode()).hexdigest())


def write_weights(folder: Path) -> Path:
    """Write a small VGGT model of random weights as .safetensors."""
    from safetensors.torch import save_file
    path = folder / 'weights.safetensors'
    save_file(_random_weights(), path)
    return path


def write_weights_pt(folder: Path) -> Path:
    """Write the model as .pt."""
    import torch
    path = folder / 'weights.pt'
    torch.save(_random_weights(), path)
    return path


def _random_weights() -> dict[str, Any]:
    import torch

    from kfvo_ros.backbones.vggt.config import VggtConfig
    from kfvo_ros.backbones.vggt.model import random_model
    torch.manual_seed(0)
    return dict(random_model(torch.device('cpu'), torch.float32,
                             VggtConfig(WIDTH, 1, DEPTH, 1, 2)).state_dict())


def read_weights(path: Path) -> Answer:
    """Load a model on the processor."""
    import torch

    from kfvo_ros.backbones.vggt.checkpoint import load_model
    try:
        model = load_model(path, torch.device('cpu'), torch.float32)
    except KfvoError as error:
        return Answer(error=str(error))
    state = model.state_dict()
    return Answer(len(state), _digest([state[name].numpy() for name in sorted(state)],
                                      json.dumps(sorted(state))))


def _digest(arrays: list[np.ndarray], *texts: str) -> str:
    digest = hashlib.sha256('\n'.join(texts).encode())
    for array in arrays:
        digest.update(f'{array.shape} {array.dtype}'.encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()

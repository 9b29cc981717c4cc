# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model of full size, without a single weight: its tensors and its operations."""

from __future__ import annotations

import pytest
from vggt_models import SMALL, published_shapes, small_model, torch

from benchmarks.vggt import STEPS, count_flops
from kfvo_ros.backbones.vggt.checkpoint import PARTS
from kfvo_ros.backbones.vggt.config import VggtConfig, config_of
from kfvo_ros.backbones.vggt.model import Vggt

FRAMES = 8


def shapes_built(config: VggtConfig | None = None) -> dict[str, tuple[int, ...]]:
    with torch.device('meta'):
        model = Vggt(config)
    return {name: tuple(each.shape) for name, each in model.state_dict().items()}


def test_tensors_are_those_of_the_published_checkpoint():
    wanted = {name: shape for name, shape in published_shapes().items() if name.startswith(PARTS)}
    built = shapes_built()
    assert built == wanted
    assert sum(torch.Size(shape).numel() for shape in built.values()) == 1_125_286_930
    assert len(wanted) < len(published_shapes())  # the other heads are not built


def test_every_tensor_is_a_parameter_in_float32():
    with torch.device('meta'):
        model = Vggt()
    assert not list(model.buffers())
    assert {each.dtype for each in model.parameters()} == {torch.float32}


def test_sizes_are_read_off_the_tensors():
    assert config_of(published_shapes()) == VggtConfig()
    assert config_of(shapes_built(SMALL)) == SMALL == small_model().config


def test_a_step_that_reuses_takes_less_than_three_quarters():
    plain, sliding, kept = (count_flops(step, 168, 224, FRAMES) for step in STEPS.values())
    assert list(STEPS) == ['plain', 'sliding', 'anchor kept']
    assert kept < sliding < 0.72 * plain  # an anchor that is kept was seen in that role before


def test_operations_of_a_step_at_the_size_of_the_training():
    plain, sliding = (count_flops(STEPS[kind], 392, 518, FRAMES) for kind in ('plain', 'sliding'))
    assert plain == pytest.approx(23.6e12, rel=0.005)
    assert sliding == pytest.approx(17.8e12, rel=0.005)

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT against the output of the official code, with the same weights and images."""

from __future__ import annotations

import copy
import json
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from vggt_models import (
    DATA,
    make_model,
    noise_images,
    record_calls,
    to_tensor,
    torch,
    with_precision,
)

from kfvo_ros.backbones.vggt import aggregator, camera_head
from kfvo_ros.backbones.vggt.aggregator import FrameRole, GlobalAttentionInput, patch_grid
from kfvo_ros.backbones.vggt.config import NUM_PREFIX_TOKENS, VggtConfig
from kfvo_ros.backbones.vggt.dinov2 import DinoV2
from kfvo_ros.backbones.vggt.layers import ROPE_BASE, Rope
from kfvo_ros.backbones.vggt.runtime import use_onednn_layout

CASES = ('s1_70x98', 's3_70x98', 's8_70x98', 's4_140x182', 's2_518x518')
TOKENS, FEATURES, POSE, EXTRINSIC, INTRINSIC_PX = 2e-5, 2e-5, 3e-6, 5e-6, 5e-4
"""Largest differences in float32: a few times those of the official code to float64."""
EXACT = 1e-12
"""Largest difference in float64."""
EVERY = 137
"""Step between the stored patches of s2_518x518."""


@pytest.fixture(scope='module')
def recipe() -> dict[str, dict]:
    return json.loads((DATA / 'weights_check.json').read_text())['weights']


@pytest.fixture(scope='module')
def model(recipe):
    return make_model({key: tuple(each['shape']) for key, each in recipe.items()})


@pytest.fixture(scope='module')
def double(model):
    return copy.deepcopy(model).double()


@pytest.fixture(scope='module', params=CASES)
def case(request, model) -> SimpleNamespace:
    """Images, the official arrays, and the model's intermediate and final results."""
    with np.load(DATA / f'{request.param}.npz') as file:
        golden = dict(file)
    images = golden.get('images')
    if images is None:
        images = noise_images(int(golden['seed']), 2, 518, 518)
    blocks = {f'{kind}{index}': block for kind in ('frame', 'global') for index, block
              in enumerate(getattr(model.aggregator, f'{kind}_blocks'))}
    with torch.inference_mode(), record_calls(
            dinov2=model.aggregator.patch_embed, head=model.camera_head, **blocks) as calls:
        encodings = model(to_tensor(images)[None])[:, 0].numpy()
    frames = len(images)
    pairs = [np.concatenate([calls[f'{kind}{i}'][0][1].reshape(frames, -1, 384).numpy()
                             for kind in ('frame', 'global')], axis=-1) for i in range(4)]
    return SimpleNamespace(images=images, golden=golden, pairs=pairs, encodings=encodings,
                           tokens=calls['dinov2'][0][1].numpy(),
                           features=calls['head'][0][0][0].numpy())


def largest_difference(found: np.ndarray, golden: np.ndarray) -> float:
    assert found.shape == golden.shape
    return float(np.abs(found - golden).max())


def test_weights_have_the_checksums_of_the_official_run(recipe, model):
    state, checksum = model.state_dict(), 0
    assert set(state) == set(recipe)
    for key in sorted(state):
        content = state[key].numpy().astype('<f4').tobytes()
        assert f'{zlib.crc32(content):08x}' == recipe[key]['crc32_bytes'], key
        checksum = zlib.crc32(content, checksum)
    assert f'{checksum:08x}' == 'fd4a1233'
    assert model.config == VggtConfig(width=384, dinov2_depth=12, depth=4, camera_depth=2)


def test_tokens_of_dinov2(case):
    golden, patches = case.golden, case.tokens[:, NUM_PREFIX_TOKENS:]
    assert largest_difference(case.tokens[:, 0], golden['dino_cls']) < TOKENS
    if 'dino_patch' in golden:
        assert largest_difference(patches, golden['dino_patch']) < TOKENS
        assert largest_difference(case.tokens[:, 1:NUM_PREFIX_TOKENS], golden['dino_reg']) < TOKENS
    else:
        assert largest_difference(patches[:, ::EVERY], golden['dino_patch_slice']) < TOKENS


def test_features_of_the_aggregator(case):
    golden = case.golden
    assert largest_difference(case.features, golden['last_cam_feat']) < FEATURES
    if 'cam_feat_per_layer' in golden:
        cameras = np.stack([pair[:, 0] for pair in case.pairs])
        assert largest_difference(cameras, golden['cam_feat_per_layer']) < FEATURES
    if 'first_layer' in golden:
        assert largest_difference(case.pairs[0], golden['first_layer']) < FEATURES


def test_poses_and_cameras(case):
    golden = case.golden
    assert largest_difference(case.encodings, golden['pose_enc_iters']) < POSE
    if 'extrinsic' in golden:
        T_camera_world = camera_head.decode_transforms(case.encodings[-1])
        K = camera_head.decode_intrinsics(case.encodings[-1], *case.images.shape[1:3])
        assert largest_difference(T_camera_world[:, :3], golden['extrinsic']) < EXTRINSIC
        assert largest_difference(K, golden['intrinsic']) < INTRINSIC_PX


@pytest.mark.parametrize('name', CASES[:-1])
def test_reuse_gives_the_same_poses(name, model):
    with np.load(DATA / f'{name}.npz') as file, torch.inference_mode():
        images = to_tensor(file['images'])
        module, grid = model.aggregator, patch_grid(images)
        inputs = [module.global_attention_input(
                      module.encode_images(image[None])[:, NUM_PREFIX_TOKENS:], grid,
                      FrameRole.OTHER if index else FrameRole.ANCHOR)
                  for index, image in enumerate(images)]
        features = module.aggregate(
            GlobalAttentionInput(*(torch.cat(each)[None] for each in zip(*inputs))), grid)
        encodings = model.camera_head(features)[:, 0].numpy()
        assert largest_difference(features[0].numpy(), file['last_cam_feat']) < FEATURES
        assert largest_difference(encodings, file['pose_enc_iters']) < POSE


@pytest.fixture
def tables_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """Round like the official code in double precision: its tables are float32."""
    interpolate = DinoV2.interpolate_positions

    def rounded_positions(self, rows, columns):
        table = copy.copy(self)
        table._parameters = {'pos_embed': self.pos_embed.float()}
        return interpolate(table, rows, columns).double()

    def rounded_rope(rows, columns, like):
        frequencies = 1.0 / ROPE_BASE ** (torch.arange(0, 32, 2).float() / 32)
        grid = torch.cartesian_prod(torch.arange(1.0, rows + 1), torch.arange(1.0, columns + 1))
        positions = torch.cat([torch.zeros(NUM_PREFIX_TOKENS, 2), grid])
        angles = (positions[:, :, None] * frequencies).double()
        cos, sin = angles.cos(), angles.sin()
        return Rope(torch.stack([cos, cos], dim=2).flatten(1)[:, None],
                    torch.stack([-sin, sin], dim=2).flatten(1)[:, None])

    monkeypatch.setattr(DinoV2, 'interpolate_positions', rounded_positions)
    monkeypatch.setattr(aggregator, 'make_rope', rounded_rope)
    for name in ('MEAN', 'STD'):
        monkeypatch.setattr(aggregator, name, np.float32(getattr(aggregator, name)).tolist())


@pytest.mark.usefixtures('tables_in_float32')
@pytest.mark.parametrize('name', CASES[:-1])
def test_double_precision_is_exact(name, double):
    with np.load(DATA / f'{name}.npz') as file, torch.inference_mode():
        images = torch.from_numpy(file['images']).permute(0, 3, 1, 2).double() / 255.0
        features = double.aggregator(images[None])
        encodings = double.camera_head(features)[:, 0].numpy()
        assert largest_difference(features[0].numpy(), file['last_cam_feat_fp64']) < EXACT
        assert largest_difference(encodings, file['pose_enc_iters_fp64']) < EXACT


def test_onednn_layout_gives_the_same_poses(model):
    packed = use_onednn_layout(copy.deepcopy(model))
    with np.load(DATA / 's3_70x98.npz') as file, torch.inference_mode():
        encodings = packed(to_tensor(file['images'])[None])[:, 0].numpy()
        assert largest_difference(encodings, file['pose_enc_iters']) < POSE


def test_bfloat16_is_near_and_limited_to_matrices(model):
    with np.load(DATA / 's3_70x98.npz') as file:
        images, golden = to_tensor(file['images'])[None], file['pose_enc_iters'][-1]
    half = with_precision(model, torch.bfloat16)
    with torch.inference_mode():
        encodings = half(images)[-1, 0]
    assert encodings.dtype is torch.float32
    assert 1e-4 < largest_difference(encodings.numpy(), golden) < 1e-2
    matrices = {name for name, each in half.named_parameters() if each.dtype is torch.bfloat16}
    linear = ('qkv', 'proj', 'fc1', 'fc2')
    assert matrices == {name for name, _ in half.aggregator.named_parameters(prefix='aggregator')
                        if name.split('.')[-2] in linear}
    assert {each.dtype for name, each in half.named_parameters() if name not in matrices} == {
        torch.float32}


def test_fields_of_view_are_clipped_in_the_output_only(model):
    """The next iteration continues from the unclipped pose, which may be below zero."""
    with np.load(DATA / 'relu_carry.npz') as file:
        head = copy.deepcopy(model.camera_head)
        head.pose_branch.fc2.bias[7:] += float(file['fov_bias_shift'])
        with torch.inference_mode():
            encodings = head(torch.from_numpy(file['last_cam_feat'])[None])[:, 0].numpy()
        assert (encodings[0, :, 7:] == 0.0).any()
        assert largest_difference(encodings, file['pose_enc_iters']) < POSE


@pytest.mark.parametrize('grid', ['5x7', '10x13', '28x37', '40x20', '37x37'])
def test_interpolated_positions(grid, model):
    rows, columns = map(int, grid.split('x'))
    dinov2 = model.aggregator.patch_embed
    with np.load(DATA / 'pos_embed.npz') as file:
        positions = dinov2.interpolate_positions(rows, columns)[0].numpy()
        positions = positions.reshape(rows, columns, -1)
        assert largest_difference(positions[..., :16], file[grid]) < 1e-5
        assert np.array_equal(dinov2.pos_embed[0, 0, :16].numpy(), file[f'{grid}_cls'])


def test_pose_encoding():
    with np.load(DATA / 'pose_encoding.npz') as file:
        encodings = file['pose_enc']
        extrinsic = camera_head.decode_transforms(encodings)[..., :3, :]
        K = camera_head.decode_intrinsics(encodings, *file['image_hw'])
        assert largest_difference(extrinsic, file['extrinsic']) < 2e-6
        assert largest_difference(K / K.max(), file['intrinsic'] / K.max()) < 1e-6

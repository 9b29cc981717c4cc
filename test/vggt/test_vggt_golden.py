# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""VGGT against what the official code computed, with the same weights and images."""

from __future__ import annotations

import copy
import json
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from vggt_models import DATA, changed, images_of, listening, model_of, to_tensor, torch

from kfvo_ros.backbones.vggt import aggregator, camera_head
from kfvo_ros.backbones.vggt.aggregator import FirstLayer, Role, grid_of
from kfvo_ros.backbones.vggt.config import SPECIAL, VggtConfig
from kfvo_ros.backbones.vggt.dinov2 import DinoV2
from kfvo_ros.backbones.vggt.layers import ROPE_BASE, Rope
from kfvo_ros.backbones.vggt.preprocessing import fit
from kfvo_ros.backbones.vggt.runtime import use_onednn_layout

CASES = ('s1_70x98', 's3_70x98', 's8_70x98', 's4_140x182', 's2_518x518')
TOKENS, FEATURES, POSE, EXTRINSIC, INTRINSIC_PX = 2e-5, 2e-5, 3e-6, 5e-6, 5e-4
"""Largest differences in float32, a few times what the official code has against float64."""
EXACT = 1e-12
"""Largest difference in float64."""
EVERY = 137
"""Of s2_518x518 only every so many patch is stored."""


@pytest.fixture(scope='module')
def recipe() -> dict[str, dict]:
    return json.loads((DATA / 'weights_check.json').read_text())['weights']


@pytest.fixture(scope='module')
def model(recipe):
    return model_of({key: tuple(each['shape']) for key, each in recipe.items()})


@pytest.fixture(scope='module')
def double(model):
    return copy.deepcopy(model).double()


@pytest.fixture(scope='module', params=CASES)
def case(request, model) -> SimpleNamespace:
    """Return what is expected, and what came on the way through the model."""
    with np.load(DATA / f'{request.param}.npz') as file:
        golden = dict(file)
    images = golden.get('images')
    if images is None:
        images = images_of(int(golden['seed']), 2, 518, 518)
    blocks = {f'{kind}{index}': block for kind in ('frame', 'global') for index, block
              in enumerate(getattr(model.aggregator, f'{kind}_blocks'))}
    with torch.inference_mode(), listening(
            trunk=model.aggregator.patch_embed, head=model.camera_head, **blocks) as heard:
        encodings = model(to_tensor(images)[None])[:, 0].numpy()
    frames = len(images)
    pairs = [np.concatenate([heard[f'{kind}{i}'][0][1].reshape(frames, -1, 384).numpy()
                             for kind in ('frame', 'global')], axis=-1) for i in range(4)]
    return SimpleNamespace(images=images, golden=golden, pairs=pairs, encodings=encodings,
                           tokens=heard['trunk'][0][1].numpy(),
                           features=heard['head'][0][0][0].numpy())


def largest(found: np.ndarray, golden: np.ndarray) -> float:
    assert found.shape == golden.shape
    return float(np.abs(found - golden).max())


def test_weights_are_those_of_the_recipe(recipe, model):
    state, whole = model.state_dict(), 0
    assert set(state) == set(recipe)
    for key in sorted(state):
        content = state[key].numpy().astype('<f4').tobytes()
        assert f'{zlib.crc32(content):08x}' == recipe[key]['crc32_bytes'], key
        whole = zlib.crc32(content, whole)
    assert f'{whole:08x}' == 'fd4a1233'
    assert model.config == VggtConfig(width=384, trunk_depth=12, depth=4, camera_depth=2)


def test_tokens_of_the_trunk(case):
    golden, patches = case.golden, case.tokens[:, SPECIAL:]
    assert largest(case.tokens[:, 0], golden['dino_cls']) < TOKENS
    if 'dino_patch' in golden:
        assert largest(patches, golden['dino_patch']) < TOKENS
        assert largest(case.tokens[:, 1:SPECIAL], golden['dino_reg']) < TOKENS
    else:
        assert largest(patches[:, ::EVERY], golden['dino_patch_slice']) < TOKENS


def test_features_of_the_aggregator(case):
    golden = case.golden
    assert largest(case.features, golden['last_cam_feat']) < FEATURES
    if 'cam_feat_per_layer' in golden:
        cameras = np.stack([pair[:, 0] for pair in case.pairs])
        assert largest(cameras, golden['cam_feat_per_layer']) < FEATURES
    if 'first_layer' in golden:
        assert largest(case.pairs[0], golden['first_layer']) < FEATURES


def test_poses_and_cameras(case):
    golden = case.golden
    assert largest(case.encodings, golden['pose_enc_iters']) < POSE
    if 'extrinsic' in golden:
        T_camera_world = camera_head.decode_transforms(case.encodings[-1])
        K = camera_head.decode_intrinsics(case.encodings[-1], *case.images.shape[1:3])
        assert largest(T_camera_world[:, :3], golden['extrinsic']) < EXTRINSIC
        assert largest(K, golden['intrinsic']) < INTRINSIC_PX


@pytest.mark.parametrize('name', CASES[:-1])
def test_reuse_gives_the_same(name, model):
    with np.load(DATA / f'{name}.npz') as file, torch.inference_mode():
        images = to_tensor(file['images'])
        parts, grid = model.aggregator, grid_of(images)
        layers = [parts.first_layer(parts.see(image[None])[:, SPECIAL:], grid,
                                    Role.OTHER if index else Role.ANCHOR)
                  for index, image in enumerate(images)]
        features = parts.relate(
            FirstLayer(*(torch.cat(each)[None] for each in zip(*layers))), grid)
        encodings = model.camera_head(features)[:, 0].numpy()
        assert largest(features[0].numpy(), file['last_cam_feat']) < FEATURES
        assert largest(encodings, file['pose_enc_iters']) < POSE


@pytest.fixture
def tables_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """Round as the official code does in double precision too: its tables are float32."""
    places = DinoV2.places

    def rounded_places(self, rows, columns):
        table = copy.copy(self)
        table._parameters = {'pos_embed': self.pos_embed.float()}
        return places(table, rows, columns).double()

    def rounded_rotary(rows, columns, like):
        frequencies = 1.0 / ROPE_BASE ** (torch.arange(0, 32, 2).float() / 32)
        grid = torch.cartesian_prod(torch.arange(1.0, rows + 1), torch.arange(1.0, columns + 1))
        angles = (torch.cat([torch.zeros(SPECIAL, 2), grid])[:, :, None] * frequencies).double()
        cos, sin = angles.cos(), angles.sin()
        return Rope(torch.stack([cos, cos], dim=2).flatten(1)[:, None],
                    torch.stack([-sin, sin], dim=2).flatten(1)[:, None])

    monkeypatch.setattr(DinoV2, 'places', rounded_places)
    monkeypatch.setattr(aggregator, 'make_rope', rounded_rotary)
    for name in ('MEAN', 'STD'):
        monkeypatch.setattr(aggregator, name, np.float32(getattr(aggregator, name)).tolist())


@pytest.mark.usefixtures('tables_in_float32')
@pytest.mark.parametrize('name', CASES[:-1])
def test_double_precision_is_exact(name, double):
    with np.load(DATA / f'{name}.npz') as file, torch.inference_mode():
        images = torch.from_numpy(file['images']).permute(0, 3, 1, 2).double() / 255.0
        features = double.aggregator(images[None])
        encodings = double.camera_head(features)[:, 0].numpy()
        assert largest(features[0].numpy(), file['last_cam_feat_fp64']) < EXACT
        assert largest(encodings, file['pose_enc_iters_fp64']) < EXACT


def test_packed_matrices_give_the_same(model):
    """As `load_backbone` lays them out on a processor."""
    packed = use_onednn_layout(copy.deepcopy(model))
    with np.load(DATA / 's3_70x98.npz') as file, torch.inference_mode():
        encodings = packed(to_tensor(file['images'])[None])[:, 0].numpy()
        assert largest(encodings, file['pose_enc_iters']) < POSE


def test_bfloat16_is_near_and_is_on(model):
    with np.load(DATA / 's3_70x98.npz') as file:
        images, golden = to_tensor(file['images'])[None], file['pose_enc_iters'][-1]
    half = changed(model, torch.bfloat16)
    with torch.inference_mode():
        encodings = half(images)[-1, 0]
    assert encodings.dtype is torch.float32
    assert 1e-4 < largest(encodings.numpy(), golden) < 1e-2
    matrices = {name for name, each in half.named_parameters() if each.dtype is torch.bfloat16}
    linear = ('qkv', 'proj', 'fc1', 'fc2')
    assert matrices == {name for name, _ in half.aggregator.named_parameters(prefix='aggregator')
                        if name.split('.')[-2] in linear}
    assert {each.dtype for name, each in half.named_parameters() if name not in matrices} == {
        torch.float32}


def test_fields_of_view_are_clipped_in_what_is_told_only(model):
    """The next iteration goes on from the pose as it is: they come back from below zero."""
    with np.load(DATA / 'relu_carry.npz') as file:
        head = copy.deepcopy(model.camera_head)
        head.pose_branch.fc2.bias[7:] += float(file['fov_bias_shift'])
        with torch.inference_mode():
            encodings = head(torch.from_numpy(file['last_cam_feat'])[None])[:, 0].numpy()
        assert (encodings[0, :, 7:] == 0.0).any()
        assert largest(encodings, file['pose_enc_iters']) < POSE


@pytest.mark.parametrize('grid', ['5x7', '10x13', '28x37', '40x20', '37x37'])
def test_embedding_of_places(grid, model):
    rows, columns = map(int, grid.split('x'))
    trunk = model.aggregator.patch_embed
    with np.load(DATA / 'pos_embed.npz') as file:
        places = trunk.places(rows, columns)[0].numpy().reshape(rows, columns, -1)
        assert largest(places[..., :16], file[grid]) < 1e-5
        assert np.array_equal(trunk.pos_embed[0, 0, :16].numpy(), file[f'{grid}_cls'])


def test_pose_encoding():
    with np.load(DATA / 'pose_encoding.npz') as file:
        encodings = file['pose_enc']
        extrinsic = camera_head.decode_transforms(encodings)[..., :3, :]
        K = camera_head.decode_intrinsics(encodings, *file['image_hw'])
        assert largest(extrinsic, file['extrinsic']) < 2e-6
        assert largest(K / K.max(), file['intrinsic'] / K.max()) < 1e-6


@pytest.mark.parametrize('name', ['land', 'port', 'wide'])
def test_preprocessing_is_that_of_the_official_loader(name):
    with np.load(DATA / 'preprocess.npz') as file:
        image = file[f'{name}_in']
        fitted = fit(*image.shape[:2], 518).apply(image)
        assert fitted.shape == tuple(file[f'{name}_crop_shape'])
        assert np.array_equal(fitted[3::7, 3::7], file[f'{name}_crop_sub7'])
        assert zlib.crc32(fitted.tobytes()) == file[f'{name}_crop_crc32']

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of weights: the published tensors, every dtype and format, malformed and hostile files."""

from __future__ import annotations

import os
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from vggt_models import (
    SMALL_CONFIG,
    noise_frames,
    published_shapes,
    save_file,
    small_model,
    to_tensor,
    torch,
)

from kfvo_ros.backbones.vggt.checkpoint import MODEL_PREFIXES, load_model
from kfvo_ros.backbones.vggt.config import VggtConfig, config_from_shapes
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.errors import KfvoError, MemoryFullError

CPU = torch.device('cpu')
STATE = dict(small_model().state_dict())
SAVERS: dict[str, Callable] = {'.safetensors': save_file, '.pt': torch.save, '.pth': torch.save}
POSITIONS, MASK = 'aggregator.patch_embed.pos_embed', 'aggregator.patch_embed.mask_token'
CAMERA = 'aggregator.camera_token'
PROJECTION = 'aggregator.frame_blocks.0.attn.proj.weight'


def load(path: Path, dtype: torch.dtype = torch.float32) -> Vggt:
    return load_model(path, CPU, dtype)


def save(path: Path, state: object) -> Path:
    SAVERS[path.suffix](state, path)
    return path


def pose_encodings(model: Vggt) -> np.ndarray:
    images = np.stack([frame.image[:56, :70] for frame in noise_frames(3)])
    with torch.inference_mode():
        return model(to_tensor(images)[None])[-1, 0].numpy()


def model_shapes(config: VggtConfig | None = None) -> dict[str, tuple[int, ...]]:
    with torch.device('meta'):
        model = Vggt(config)
    return {name: tuple(each.shape) for name, each in model.state_dict().items()}


def test_tensors_are_those_of_the_published_checkpoint():
    expected = {name: shape for name, shape in published_shapes().items()
                if name.startswith(MODEL_PREFIXES)}
    built = model_shapes()
    assert built == expected
    assert sum(torch.Size(shape).numel() for shape in built.values()) == 1_125_286_930
    assert len(expected) < len(published_shapes())  # the other heads are not built


def test_every_tensor_is_a_parameter_in_float32():
    with torch.device('meta'):
        model = Vggt()
    assert not list(model.buffers())
    assert {each.dtype for each in model.parameters()} == {torch.float32}


def test_sizes_follow_from_the_tensors():
    assert config_from_shapes(published_shapes()) == VggtConfig()
    assert config_from_shapes(model_shapes(SMALL_CONFIG)) == SMALL_CONFIG == small_model().config


@pytest.mark.parametrize('suffix', SAVERS)
def test_round_trip(suffix, tmp_path):
    model = load(save(tmp_path / f'small{suffix}', STATE))
    assert model.config == SMALL_CONFIG
    assert not model.training and not any(each.requires_grad for each in model.parameters())
    assert np.array_equal(pose_encodings(model), pose_encodings(small_model()))


@pytest.mark.parametrize('stored', [torch.float64, torch.float16, torch.bfloat16])
def test_dtypes_are_converted(stored, tmp_path):
    path = save(tmp_path / 'small.safetensors',
                 {name: each.to(stored) for name, each in STATE.items()})
    model = load(path)
    assert {each.dtype for each in model.parameters()} == {torch.float32}
    difference = np.abs(pose_encodings(model) - pose_encodings(small_model())).max()
    assert difference == 0.0 if stored is torch.float64 else 1e-7 < difference < 2e-2


def test_matrices_are_loaded_in_the_requested_dtype(tmp_path):
    model = load(save(tmp_path / 'small.pt', STATE), torch.bfloat16)
    for name, each in model.named_parameters():
        assert torch.equal(each, STATE[name].to(each.dtype))
    assert model.aggregator.frame_blocks[0].attn.qkv.weight.dtype is torch.bfloat16
    assert model.camera_head.trunk[0].attn.qkv.weight.dtype is torch.float32


@pytest.mark.parametrize('suffix', ['.safetensors', '.pt'])
def test_weights_are_a_copy_of_the_file(suffix, tmp_path):
    path = save(tmp_path / f'small{suffix}', STATE)
    model = load(path)
    with path.open('r+b') as file:  # the same pages, not a new file of this name
        file.write(bytes(path.stat().st_size))
        file.flush()
        os.fsync(file.fileno())
    assert np.array_equal(pose_encodings(model), pose_encodings(small_model()))
    path.unlink()


@pytest.mark.parametrize('suffix', ['.safetensors', '.pt'])
def test_other_heads_are_skipped(suffix, tmp_path):
    others = {'point_head.norm.weight': torch.zeros(2048), 'track_head.x': torch.zeros(3).int()}
    model = load(save(tmp_path / f'full{suffix}', STATE | others))
    assert set(model.state_dict()) == set(STATE)
    assert np.array_equal(pose_encodings(model), pose_encodings(small_model()))


# Malformed files


def load_error(path: Path) -> str:
    """Return the error of a file that cannot be loaded."""
    with pytest.raises(KfvoError) as caught:
        load(path)
    line = str(caught.value)
    assert str(path) in line and len(line.splitlines()) == 1 and line.isprintable()
    return line


@pytest.mark.parametrize('suffix', ['.safetensors', '.pt'])
def test_unreadable_files(suffix, tmp_path):
    path = tmp_path / f'small{suffix}'
    assert 'No such file' in load_error(path)
    for content in (b'', b'version https://git-lfs.github.com/spec/v1\noid sha256:0'):
        path.write_bytes(content)
        assert 'cannot read the weights' in load_error(path)
    whole = save(path, STATE).read_bytes()
    for size in (len(whole) - 1, len(whole) // 2, 100):
        path.write_bytes(whole[:size])
        assert 'expected a whole .safetensors file, or a .pt file' in load_error(path)
    path.unlink()
    path.mkdir()
    load_error(path)


class Bomb:
    """Creates a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = str(folder)

    def __reduce__(self) -> tuple[Callable, tuple[str]]:
        return os.mkdir, (self.folder,)


def test_code_in_a_file_is_not_executed(tmp_path):
    folder, path = tmp_path / 'executed', tmp_path / 'weights.pt'
    save(path, {**STATE, MASK: Bomb(folder)})
    line = load_error(path)
    assert not folder.exists()
    assert 'tensors by name and nothing else' in line
    assert 'weights_only' not in line  # torch would advise to run it
    path.write_bytes(pickle.dumps({MASK: Bomb(folder)}))
    load_error(path)
    assert not folder.exists()
    torch.load(save(path, {MASK: Bomb(folder)}), weights_only=False)
    assert folder.exists()  # the bomb works


@pytest.mark.parametrize('content', [
    {'epoch': 3}, {'model': STATE}, [1, 2], STATE[MASK], {1: STATE[MASK]}, small_model()],
    ids=['number', 'nested', 'list', 'tensor', 'numbered', 'module'])
def test_other_contents_of_a_torch_file(content, tmp_path):
    assert 'expected tensors by name' in load_error(save(tmp_path / 'odd.pt', content))


def test_other_contents_of_a_zip_file(tmp_path):
    path = tmp_path / 'odd.pt'
    with zipfile.ZipFile(path, 'w') as file:
        file.writestr('readme/readme.txt', 'nothing')
    assert 'cannot read the weights' in load_error(path)


def test_weights_of_another_model(tmp_path):
    line = load_error(save(tmp_path / 'resnet.safetensors', {
        'fc.bias': torch.zeros(2), 'layer1.0.conv1.weight': torch.zeros(3)}))
    assert 'aggregator.camera_token' in line and 'fc.bias, layer1.0.conv1.weight' in line
    assert 'nothing' in load_error(save(tmp_path / 'empty.safetensors', {}))


@pytest.mark.parametrize(('changes', 'parts'), [
    ({'camera_head.token_norm.bias': None}, ['camera_head.token_norm.bias is missing']),
    ({'camera_head.more': torch.zeros(1)}, ['camera_head.more is unknown']),
    ({MASK: torch.zeros(1, 64)}, [f'{MASK} has the shape [1, 64] instead of [1, 128]']),
    ({POSITIONS: torch.zeros(1, 51, 128)}, [f'{POSITIONS} has the shape [1, 51, 128]']),
    ({MASK: torch.zeros(1, 128).to(torch.int8)}, [MASK, 'floating point', 'torch.int8']),
    ({MASK: torch.zeros(1, 128).to_sparse()}, [MASK, 'torch.sparse_coo']),
    ({MASK: torch.zeros(1, 128, device='meta')}, [MASK, 'on meta']),
    ({CAMERA: torch.zeros(1, 2, 1, 192)}, ['has the shape', 'more']),
    ({CAMERA: torch.zeros(1, 2, 1, 100)}, ['64 divides', 'width 100']),
    ({CAMERA: torch.zeros(1, 2, 1, 0)}, ['width 0']),
    ({CAMERA: torch.zeros(1).expand(1, 2, 1, 64 * 10 ** 9)}, ['up to 8192', '64000000000']),
    ({CAMERA: torch.zeros(5)}, ['aggregator.camera_token']),
    ({POSITIONS: torch.zeros(1, 0, 128)}, ['0 rows of positions']),
    ({'aggregator.frame_blocks.1000000000.norm1.bias': torch.zeros(128)}, ['and 3']),
], ids=lambda value: None if isinstance(value, dict) else '-'.join(value))
def test_mismatched_tensors_are_named(changes, parts, tmp_path):
    state = {name: each for name, each in {**STATE, **changes}.items() if each is not None}
    line = load_error(save(tmp_path / 'odd.pt', state))
    assert all(part in line for part in parts), line
    assert len(line) < 700


@pytest.mark.parametrize('suffix', ['.safetensors', '.pt'])
@pytest.mark.parametrize(('number', 'words'), [
    (torch.nan, 'from nan to nan'), (torch.inf, 'to inf'), (-1e30, 'from -1e+30')])
def test_numbers_that_no_weight_has(number, words, suffix, tmp_path):
    weight = STATE[MASK].clone()
    weight[0, 3] = number
    line = load_error(save(tmp_path / f'odd{suffix}', STATE | {MASK: weight}))
    assert MASK in line and words in line and 'copy or download it again' in line


def test_numbers_too_large_for_the_requested_dtype(tmp_path):
    path = save(tmp_path / 'large.pt', STATE | {PROJECTION: STATE[PROJECTION] * 1e6})
    load(path)
    with pytest.raises(KfvoError, match=f'{PROJECTION} has numbers from -inf to inf'):
        load(path, torch.float16)


@pytest.mark.parametrize('place', ['pickle', 'tensors', 'directory'])
def test_a_flipped_bit_of_a_torch_file_is_one_clear_line(place, tmp_path):
    """A few bits of the directory mean nothing, such as the time of writing."""
    path = save(tmp_path / 'small.pt', STATE)
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        pickled = archive.getinfo('small/data.pkl')
        begin, size = pickled.header_offset, pickled.file_size
    first, last = {'pickle': (begin + 100, begin + size),
                   'tensors': (begin + 20_000 + size, len(content) - 20_000),
                   'directory': (content.index(b'PK\1\2', -20_000), len(content))}[place]
    rng, refused = random.Random(place), 0
    for _ in range(12):
        changed, bit = bytearray(content), rng.randrange(8 * first, 8 * last)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            model = load(path)
        except KfvoError:
            load_error(path)
            refused += 1
        else:
            assert all(torch.equal(each, STATE[name])
                       for name, each in model.named_parameters())
    assert refused == 12 if place != 'directory' else refused >= 6


def test_weights_larger_than_the_memory_are_refused(tmp_path):
    """A small file may declare arbitrarily large tensors."""
    path = save(tmp_path / 'large.pt', STATE | {
        POSITIONS: torch.zeros(1).expand(1, 10 ** 12 + 1, 128)})
    with pytest.raises(MemoryFullError, match='the weights take 488.* MiB, .* are free'):
        load(path)

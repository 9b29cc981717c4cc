# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights of a model: located as a file or on the Hugging Face hub, checked, and loaded.

Tensors are checked by name and shape before they are read, straight to their device and dtype,
and their numbers afterwards. A .pt file has checksums, which are checked too; a .safetensors file
has none.
"""

from __future__ import annotations

import os
import pickle
import re
from pathlib import Path

import torch
from huggingface_hub import hf_hub_download, try_to_load_from_cache
from huggingface_hub.errors import (
    EntryNotFoundError,
    GatedRepoError,
    HfHubHTTPError,
    LocalEntryNotFoundError,
)
from safetensors.torch import load_file
from torch import Tensor

from kfvo_ros.backbones.vggt.config import config_from_shapes
from kfvo_ros.backbones.vggt.model import Vggt, set_precision
from kfvo_ros.errors import KfvoError, MemoryFullError, reason_of
from kfvo_ros.utils.process import available_mb
from kfvo_ros.utils.tensor_files import MAX_NUMBER, DamagedFileError, check_zip

HUB_FILES = {'facebook/VGGT-1B-Commercial': 'vggt_1B_commercial.pt'}
DEFAULT_FILE = 'model.safetensors'
"""File of repositories that HUB_FILES does not list."""
SUFFIXES = ('.safetensors', '.pt', '.pth')
MODEL_PREFIXES = ('aggregator.', 'camera_head.')
"""Keys that are loaded; a full checkpoint's heads for depth, points and tracks are skipped."""
TENSORS_PER_MAPPING = 16
"""Tensors read before the file is mapped again: pages read from a mapping count as memory."""
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
NOT_A_STATE_DICT = '{}: expected tensors by name and nothing else, as state_dict() gives them'
UNREADABLE = ('cannot read the weights in {}; expected a whole .safetensors file, or a .pt file '
              'of nothing but tensors: {}')
MAX_LISTED = 3
"""Differing keys named in an error."""


def locate_weights(weights: str, revision: str | None = None) -> Path:
    """Return the file of `weights`, a path or a hub repository such as facebook/VGGT-1B.

    A repository's file is downloaded once, with a progress bar, at `revision` (branch, tag or
    commit), and found in the hub's cache afterwards, even offline. Raises KfvoError.
    """
    path = Path(os.path.expanduser(weights))  # Path.expanduser raises for unknown users
    if path.suffix in SUFFIXES or os.path.exists(path):
        if not os.path.isfile(path):
            raise KfvoError(f'there is no file of weights {path}')
        return path
    if not re.fullmatch(r'[\w.-]+/[\w.-]+', weights):
        raise KfvoError(f'expected weights as a file ({", ".join(SUFFIXES)}) or as a repository '
                        f'such as facebook/VGGT-1B, came {weights!r}')
    return _download(weights, revision)


def _download(repository: str, revision: str | None) -> Path:
    file = HUB_FILES.get(repository, DEFAULT_FILE)
    page = f'https://huggingface.co/{repository}'
    try:
        # Cache first: a robot without network must not wait for the hub's retries.
        cached = try_to_load_from_cache(repository, file, revision=revision)
        if isinstance(cached, str):
            return Path(cached)
        return Path(hf_hub_download(repository, file, revision=revision))
    except GatedRepoError as error:
        raise KfvoError(f'access to {repository} is granted on request: fill in the form on '
                        f'{page}, then run `hf auth login`') from error
    except LocalEntryNotFoundError as error:
        raise KfvoError(
            f'the weights {repository} are not on this machine and cannot be downloaded: '
            f'connect it to the network once, or copy {file} from {page} here and set weights to '
            'its path, or use the geometric backbone, which needs none') from error
    except (EntryNotFoundError, HfHubHTTPError, OSError, ValueError) as error:
        raise KfvoError(f'cannot download {file} of {repository} (revision {revision}); see '
                        f'{page}: {reason_of(error)}') from error


def load_model(path: Path, device: torch.device, dtype: torch.dtype) -> Vggt:
    """Return the model in a ``.safetensors`` or ``.pt`` file, on `device`, ready to run.

    `dtype` is that of `set_precision`; the sizes follow from the tensors. Raises KfvoError for an
    unreadable or damaged file and for tensors that are not a VGGT model's.
    """
    mapped = _map_tensors(path)
    found = {name: each for name, each in mapped.items() if name.startswith(MODEL_PREFIXES)}
    try:
        config = config_from_shapes({name: tuple(each.shape) for name, each in mapped.items()})
        with torch.device('meta'):
            model = set_precision(Vggt(config), dtype)
        expected: dict[str, Tensor] = dict(model.named_parameters())
        _check_tensors(found, expected)
    except KfvoError as error:
        raise KfvoError(f'{path}: {error}') from error
    del found, mapped
    if device.type == 'cpu':
        _check_memory(sum(each.numel() * each.itemsize for each in expected.values()))
    _check_sums(path)
    names, loaded = list(expected), dict[str, Tensor]()
    for first in range(0, len(names), TENSORS_PER_MAPPING):
        mapped = _map_tensors(path)
        loaded |= {name: mapped[name].to(device, expected[name].dtype, copy=True)
                   for name in names[first:first + TENSORS_PER_MAPPING]}
    _check_numbers(path, loaded)
    model.load_state_dict(loaded, assign=True)
    return model.eval().requires_grad_(False)


def _check_memory(size: int) -> None:
    """Raise MemoryFullError for more bytes than are free: Linux kills the process later."""
    needed_mb, free_mb = size / 1024.0 ** 2, available_mb()
    if needed_mb > free_mb:
        raise MemoryFullError(f'the weights take {needed_mb:.0f} MiB, {free_mb:.0f} are free: set '
                              'precision to bf16, which takes little more than half, or close '
                              'what else is running')


def _map_tensors(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file, memory-mapped and unread; raises KfvoError."""
    try:
        if path.suffix == '.safetensors':
            return load_file(path)
        state = torch.load(path, map_location='cpu', weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:  # torch's message advises to run the code
        raise KfvoError(NOT_A_STATE_DICT.format(path)) from error
    except Exception as error:  # torch's reader may raise anything for a damaged file
        raise KfvoError(UNREADABLE.format(path, reason_of(error))) from error
    if not isinstance(state, dict) or not all(
            isinstance(name, str) and isinstance(each, Tensor) for name, each in state.items()):
        raise KfvoError(NOT_A_STATE_DICT.format(path))
    return state


def _check_sums(path: Path) -> None:
    """Raise KfvoError where a checksum in a .pt file differs."""
    if path.suffix == '.safetensors':
        return
    try:
        check_zip(path)
    except DamagedFileError as error:
        raise KfvoError(f'{path}: {error}, or download it again') from error
    except Exception as error:  # so may zipfile
        raise KfvoError(UNREADABLE.format(path, reason_of(error))) from error


def _check_numbers(path: Path, tensors: dict[str, Tensor]) -> None:
    """Raise KfvoError for a number that is not finite, or too large for any weight."""
    for name, each in tensors.items():
        low, high = map(float, each.aminmax())
        if not -MAX_NUMBER <= low <= high <= MAX_NUMBER:
            raise KfvoError(f'{path}: {name} has numbers from {low:.3g} to {high:.3g}, expected '
                            f'up to {MAX_NUMBER:.0e} in size: the file is damaged, copy or '
                            'download it again')


def _check_tensors(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Raise KfvoError naming the first tensors that differ from the expected ones."""
    wrong = [f'{name} is missing' for name in expected if name not in found]
    wrong += [f'{name} is unknown' for name in found if name not in expected]
    for name in (name for name in expected if name in found):
        if found[name].shape != expected[name].shape:
            wrong.append(f'{name} has the shape {list(found[name].shape)} instead of '
                         f'{list(expected[name].shape)}')
        if found[name].dtype not in FLOATS or found[name].layout is not torch.strided \
                or found[name].is_meta:
            wrong.append(f'{name} is not made of floating point numbers ({found[name].dtype}, '
                         f'{found[name].layout}, on {found[name].device})')
    if wrong:
        more = f' and {len(wrong) - MAX_LISTED} more' if len(wrong) > MAX_LISTED else ''
        raise KfvoError(f'not the weights of a VGGT model: {", ".join(wrong[:MAX_LISTED])}{more}')

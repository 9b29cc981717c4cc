# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where weights come from: a file, or a repository on the Hugging Face hub, kept in its cache."""

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
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from kfvo_ros.backbones.vggt.config import config_of
from kfvo_ros.backbones.vggt.model import Vggt
from kfvo_ros.backbones.vggt.runtime import set_precision
from kfvo_ros.errors import KfvoError, MemoryFullError, reason_of
from kfvo_ros.utils.process import available_mb

HUB_FILES = {'facebook/VGGT-1B-Commercial': 'vggt_1B_commercial.pt'}
DEFAULT_FILE = 'model.safetensors'
"""Of repositories that FILES does not name."""
SUFFIXES = ('.safetensors', '.pt', '.pth')
PARTS = ('aggregator.', 'camera_head.')
"""What is built; the heads for depth, points and tracks of a full checkpoint are skipped."""
AT_ONCE = 16
"""Tensors read before the file is closed and opened anew: what is mapped counts as memory."""
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)
NOT_TENSORS = '{}: expected tensors by name and nothing else, as state_dict() gives them'
SHOWN = 3
"""So many keys that differ are named."""


def locate_weights(weights: str, revision: str | None = None) -> Path:
    """Return the file of `weights`, a path or a hub repository such as facebook/VGGT-1B.

    A repository's file is downloaded once, with a progress bar, at `revision` (branch, tag or
    commit), and found in the cache afterwards, without network too. Raises KfvoError.
    """
    path = Path(os.path.expanduser(weights))  # Path's own raises for users that are unknown
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
        # The cache first: a robot without network must not wait for the hub's retries.
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

    `dtype` is that of `precision.set_precision`. The sizes are read off the tensors. Raises
    KfvoError for a file that cannot be read, or that holds other tensors than a VGGT model's.
    """
    mapped = _map(path)
    found = {name: each for name, each in mapped.items() if name.startswith(PARTS)}
    try:
        config = config_of({name: tuple(each.shape) for name, each in mapped.items()})
        with torch.device('meta'):
            model = set_precision(Vggt(config), dtype)
        wanted: dict[str, Tensor] = dict(model.named_parameters())
        _compare(found, wanted)
    except KfvoError as error:
        raise KfvoError(f'{path}: {error}') from error
    del found, mapped
    if device.type == 'cpu':
        _make_sure_of_memory(sum(each.numel() * each.itemsize for each in wanted.values()))
    names, loaded = list(wanted), dict[str, Tensor]()
    for first in range(0, len(names), AT_ONCE):
        mapped = _map(path)
        loaded |= {name: mapped[name].to(device, wanted[name].dtype, copy=True)
                   for name in names[first:first + AT_ONCE]}
    model.load_state_dict(loaded, assign=True)
    return model.eval().requires_grad_(False)


def _make_sure_of_memory(needed: int) -> None:
    """Raise MemoryFullError for more than there is: Linux would promise it, and kill later."""
    needed_mb, free_mb = needed / 1024.0 ** 2, available_mb()
    if needed_mb > free_mb:
        raise MemoryFullError(f'the weights take {needed_mb:.0f} MiB, {free_mb:.0f} are free: set '
                              'precision to bf16, which takes little more than half, or close '
                              'what else is running')


def _map(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file, mapped and not read yet; raises KfvoError."""
    try:
        if path.suffix == '.safetensors':
            return load_file(path)
        state = torch.load(path, map_location='cpu', weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:  # torch's own words advise to let the code run
        raise KfvoError(NOT_TENSORS.format(path)) from error
    except (OSError, SafetensorError, RuntimeError, EOFError) as error:
        raise KfvoError(f'cannot read the weights in {path}; expected a whole .safetensors file, '
                        f'or a .pt file of nothing but tensors: {reason_of(error)}') from error
    if not isinstance(state, dict) or not all(
            isinstance(name, str) and isinstance(each, Tensor) for name, each in state.items()):
        raise KfvoError(NOT_TENSORS.format(path))
    return state


def _compare(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    """Raise KfvoError naming the first tensors that differ from what is wanted."""
    wrong = [f'{name} is missing' for name in wanted if name not in found]
    wrong += [f'{name} is unknown' for name in found if name not in wanted]
    for name in (name for name in wanted if name in found):
        if found[name].shape != wanted[name].shape:
            wrong.append(f'{name} has the shape {list(found[name].shape)} instead of '
                         f'{list(wanted[name].shape)}')
        if found[name].dtype not in FLOATS or found[name].layout is not torch.strided \
                or found[name].is_meta:
            wrong.append(f'{name} is not made of floating point numbers ({found[name].dtype}, '
                         f'{found[name].layout}, on {found[name].device})')
    if wrong:
        more = f' and {len(wrong) - SHOWN} more' if len(wrong) > SHOWN else ''
        raise KfvoError(f'not the weights of a VGGT model: {", ".join(wrong[:SHOWN])}{more}')

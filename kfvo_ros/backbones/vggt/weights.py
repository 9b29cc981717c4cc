# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where weights come from: a file, or a repository on the Hugging Face hub, kept in its cache."""

from __future__ import annotations

import os
import re
from pathlib import Path

from huggingface_hub import hf_hub_download, try_to_load_from_cache
from huggingface_hub.errors import (
    EntryNotFoundError,
    GatedRepoError,
    HfHubHTTPError,
    LocalEntryNotFoundError,
)

from kfvo_ros.errors import KfvoError, reason_of

FILES = {'facebook/VGGT-1B-Commercial': 'vggt_1B_commercial.pt'}
DEFAULT_FILE = 'model.safetensors'
"""Of repositories that FILES does not name."""
SUFFIXES = ('.safetensors', '.pt', '.pth')


def locate(weights: str, revision: str | None = None) -> Path:
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
    file = FILES.get(repository, DEFAULT_FILE)
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

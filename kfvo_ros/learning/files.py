# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a training writes, and where."""

from __future__ import annotations

from pathlib import Path

from kfvo_ros.errors import KfvoError, reason_of

SUFFIX = '.safetensors'


class TrainingFiles:
    """``output`` is the best policy; the rest is in the ``folder`` beside it.

    That is ``checkpoint``, from which a training goes on, the ``last`` policy, and the logs of
    TensorBoard. Raises KfvoError for an output that is no .safetensors file.
    """

    def __init__(self, output: str) -> None:
        self.output = Path(output).expanduser()
        if self.output.suffix != SUFFIX:
            raise KfvoError(f'expected an --output that ends in {SUFFIX}, came {output}')
        self.folder = self.output.with_suffix('.training')
        self.checkpoint = self.folder / 'checkpoint.pt'
        self.last = self.folder / f'last{SUFFIX}'

    def check(self, resume: bool, overwrite: bool) -> None:
        """Raise KfvoError where an earlier training is, neither to `resume` nor to `overwrite`."""
        there = [path for path in (self.output, self.checkpoint, self.last) if path.exists()]
        if there and not resume and not overwrite:
            raise KfvoError(f'{there[0]} is there already; choose another --output, or add '
                            '--resume to go on or --overwrite to begin anew')

    def prepare(self, resume: bool) -> None:
        """Make the folder, empty of an earlier training unless to `resume`; raises KfvoError."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not resume:
                for path in (self.checkpoint, self.last, *self.folder.glob('events.out.*')):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise KfvoError(f'cannot write to {self.folder}: {reason_of(error)}') from error

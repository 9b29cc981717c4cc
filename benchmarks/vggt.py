# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python benchmarks/vggt.py``: time of a VGGT window step, with and without reuse.

A step takes in one frame and estimates a window: as the published model does (plain), with a
window that slides by one frame, and with one that keeps its anchor. The three run in turn in one
process, with random weights and images, which a model's time does not depend on.
"""

from __future__ import annotations

import argparse
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from kfvo_ros.backbones.vggt.aggregator import patch_grid
from kfvo_ros.backbones.vggt.config import NUM_PREFIX_TOKENS, PATCH_SIZE
from kfvo_ros.backbones.vggt.frame_cache import FrameCache, aggregate_cached
from kfvo_ros.backbones.vggt.layers import Block
from kfvo_ros.backbones.vggt.model import Vggt, random_model
from kfvo_ros.backbones.vggt.preprocessing import fit_image
from kfvo_ros.backbones.vggt.runtime import (
    PRECISIONS,
    choose_device,
    choose_dtype,
    compile_blocks,
    compile_errors,
    memory_errors,
    use_onednn_layout,
)
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.process import peak_rss_mb

COMMAND = 'benchmarks/vggt.py'
Times = dict[str, list[float]]


class WindowSteps:
    """A window of random frames, and the three kinds of steps with it.

    With `autocast` the plain step uses bfloat16 arithmetic on float32 weights outside of the
    camera head, as the published code does.
    """

    def __init__(self, model: Vggt, height: int, width: int, frames: int,
                 autocast: bool = False) -> None:
        self.model, self.autocast = model, autocast
        self.device = model.camera_head.empty_pose_tokens.device
        self.images = torch.rand(frames, 3, height, width, device=self.device)
        self._fit = fit_image(height, width, width)
        self._window: list[FrameCache] = []

    def precision(self) -> AbstractContextManager[object]:
        """Return the context of the plain step's matrix products."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.autocast else nullcontext()

    def plain(self) -> Tensor:
        """Estimate the window without reuse; return pose encodings (iterations, 1, S, 9)."""
        with self.precision():
            features = self.model.aggregator(self.images[None])
        return self.model.camera_head(features.float())

    def slide(self) -> Tensor:
        """Replace the oldest frame, so that another one becomes the anchor."""
        self.fill()
        self._window = [*self._window[1:], *self._encode(self.images[-1:])]
        return self._estimate()

    def keep_anchor(self) -> Tensor:
        """Replace the newest frame."""
        self.fill()
        self._window = [*self._window[:-1], *self._encode(self.images[-1:])]
        return self._estimate()

    def fill(self) -> None:
        """Estimate a first window, which fills the cache for all later steps."""
        if not self._window:
            self._window = self._encode(self.images)
            self._estimate()

    def _encode(self, images: Tensor) -> list[FrameCache]:
        patches = self.model.aggregator.encode_images(images)[:, NUM_PREFIX_TOKENS:]
        return [FrameCache(self._fit, patch_grid(images), image, each[None])
                for image, each in zip(images, patches)]

    def _estimate(self) -> Tensor:
        return self.model.camera_head(aggregate_cached(self.model.aggregator, [self._window]))


STEPS: dict[str, Callable[[WindowSteps], Tensor]] = {
    'plain': WindowSteps.plain, 'sliding': WindowSteps.slide,
    'anchor kept': WindowSteps.keep_anchor}


def count_flops(step: Callable[[WindowSteps], Tensor], height: int, width: int, frames: int
                ) -> int:
    """Return the floating-point operations of a step of VGGT-1B, without computing it."""
    with torch.device('meta'):
        steps = WindowSteps(Vggt().requires_grad_(False), height, width, frames)
        if step is not WindowSteps.plain:
            steps.fill()
        with FlopCounterMode(display=False) as counter:
            step(steps)
    return counter.get_total_flops()


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command(COMMAND, _run, argv)


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = make_parser(COMMAND, __doc__ or '')
    parser.add_argument('--size', type=_parse_size, default=(392, 518), metavar='HxW',
                        help='size of the images, multiples of 14 (default: 392x518)')
    parser.add_argument('--frames', type=int, default=8, help='frames of a window '
                        '(default: %(default)s)')
    parser.add_argument('--precision', choices=('auto', *PRECISIONS), default='auto',
                        help="dtype of the aggregator's matrices (default: %(default)s)")
    parser.add_argument('--against', choices=('same', 'fp32', 'official'), default='same',
                        help='model of the plain step: the same, one in fp32, or one with fp32 '
                        'weights under bfloat16 autocast, as published (default: %(default)s)')
    parser.add_argument('--device', default='auto',
                        help='auto, cpu, cuda or cuda:N (default: %(default)s)')
    parser.add_argument('--compile', action='store_true', help='compile the model with torch, '
                        'but not a different one of the plain step')
    parser.add_argument('--rounds', type=int, default=7, help='timed repetitions of each kind of '
                        'step (default: %(default)s)')
    arguments = parser.parse_args(argv)
    if arguments.frames < 2 or arguments.rounds < 1:
        parser.error('expected at least two frames and one round')
    return arguments


def _parse_size(text: str) -> tuple[int, int]:
    found = re.fullmatch('([0-9]{1,6})x([0-9]{1,6})', text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if min(size) < PATCH_SIZE or size[0] % PATCH_SIZE or size[1] % PATCH_SIZE:
        raise argparse.ArgumentTypeError(f'expected HxW in multiples of {PATCH_SIZE}, came {text}')
    return size


def _run(argv: list[str]) -> None:
    arguments = _parse(argv)
    device = choose_device(arguments.device)
    with torch.inference_mode(), memory_errors(device), (
            compile_errors() if arguments.compile else nullcontext()):
        _compare(arguments, device)


def _compare(arguments: argparse.Namespace, device: torch.device) -> None:
    """Time the steps and print the results."""
    dtype = choose_dtype(arguments.precision, device)
    shape: tuple[int, int, int] = (*arguments.size, arguments.frames)
    model = random_model(device, dtype)
    if arguments.compile:
        compile_blocks(model)
    elif device.type == 'cpu':
        use_onednn_layout(model)
    reusing = WindowSteps(model, *shape)
    official = arguments.against == 'official'
    plain = reusing if arguments.against == 'same' else WindowSteps(
        random_model(device, torch.float32), *shape, autocast=official)
    times = _time_steps(plain, reusing, arguments.rounds)
    rate = _matmul_rate(reusing)
    plain_rate = rate if plain is reusing else _matmul_rate(plain)
    name = torch.cuda.get_device_name(device) if device.type == 'cuda' else \
        f'{torch.get_num_threads()} threads'
    print(f'{device} ({name}), torch {torch.__version__}, {shape[2]} frames of '
          f'{shape[0]}x{shape[1]}, matrices in {dtype}, plain in '
          f'{"autocast" if official else "fp32" if plain is not reusing else dtype}')
    _print_table(times, {kind: count_flops(step, *shape) for kind, step in STEPS.items()},
                 {kind: plain_rate if kind == 'plain' else rate for kind in STEPS})
    for kind in ('sliding', 'anchor kept'):
        print(f'{kind}: ' + ', '.join(f'{part} {100 * share:.1f} %'
                                      for part, share in _time_shares(reusing, kind).items()))
    print(f'matmul rate {rate / 1e12:.3f} TFLOP/s, peak memory {_peak_memory_mb(device):.0f} MiB')


def _print_table(times: Times, flops: dict[str, int], rates: dict[str, float]) -> None:
    """Print a row per kind of step: ``ratio`` and ``share`` relate its time and work to plain."""
    print(f'{"step":12} {"ms":>9} {"ratio":>6} {"TFLOP":>7} {"share":>6} {"of matmul":>9}')
    for kind, seconds in times.items():
        median = statistics.median(seconds)
        ratio = statistics.median(map(float.__truediv__, times['plain'], seconds))
        print(f'{kind:12} {1e3 * median:9.1f} {ratio:5.2f}x {flops[kind] / 1e12:7.2f} '
              f'{flops[kind] / flops["plain"]:6.3f} {flops[kind] / median / rates[kind]:9.2f}')


def _time_steps(plain: WindowSteps, reusing: WindowSteps, rounds: int) -> Times:
    """Return the times [s] of each kind of step, run in turn after a warm-up round."""
    times: Times = {kind: [] for kind in STEPS}
    for _ in range(rounds + 1):
        for kind, step in STEPS.items():
            steps = plain if kind == 'plain' else reusing
            start = _now(reusing.device)
            step(steps)
            times[kind].append(_now(reusing.device) - start)
    return {kind: seconds[1:] for kind, seconds in times.items()}


def _time_shares(steps: WindowSteps, kind: str) -> dict[str, float]:
    """Return the share of each part in a step's time."""
    model, device = steps.model, steps.device
    spent = {'encode': 0.0, 'frame': 0.0, 'head': 0.0}
    with _timed(spent, 'encode', model.aggregator.patch_embed, device), \
            _timed(spent, 'frame', model.aggregator.frame_blocks, device), \
            _timed(spent, 'head', model.camera_head, device):
        start = _now(device)
        STEPS[kind](steps)
        total = _now(device) - start
    spent['global and rest'] = total - sum(spent.values())
    return {part: seconds / total for part, seconds in spent.items()}


@contextmanager
def _timed(spent: dict[str, float], part: str, module: nn.Module,
           device: torch.device) -> Iterator[None]:
    """Add the time [s] of a module, or of each module of a list, to ``spent[part]``."""
    def begin(*_: object) -> None:
        spent[part] -= _now(device)

    def end(*_: object) -> None:
        spent[part] += _now(device)

    modules = module if isinstance(module, nn.ModuleList) else [module]
    hooks = [hook for each in modules for hook in (
        each.register_forward_pre_hook(begin), each.register_forward_hook(end))]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _matmul_rate(steps: WindowSteps) -> float:
    """Return the rate of the largest matrix product, in the layout of its weights [FLOP/s]."""
    block = steps.model.aggregator.global_blocks[0]
    assert isinstance(block, Block)
    frames, _, height, width = steps.images.shape
    tokens = torch.randn(frames * height * width // PATCH_SIZE ** 2, steps.model.config.width,
                         device=steps.device)
    seconds = []
    for _ in range(8):
        start = _now(steps.device)
        with steps.precision():
            hidden = block.mlp.fc1(tokens)
        seconds.append(_now(steps.device) - start)
    return 2.0 * tokens.numel() * hidden.shape[-1] / statistics.median(seconds[1:])


def _now(device: torch.device) -> float:
    """Return the time [s], after the device has finished its work."""
    if device.type == 'cuda':
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _peak_memory_mb(device: torch.device) -> float:
    if device.type == 'cuda':
        return torch.cuda.max_memory_allocated(device) / 1024.0 ** 2
    return peak_rss_mb()


if __name__ == '__main__':
    sys.exit(main())

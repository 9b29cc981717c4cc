# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of a window with random weights and images: a model's time does not depend on them."""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from kfvo_ros.backbones.vggt.aggregator import grid_of
from kfvo_ros.backbones.vggt.config import PATCH, SPECIAL
from kfvo_ros.backbones.vggt.frame_cache import FrameCache, features_cached
from kfvo_ros.backbones.vggt.layers import Block
from kfvo_ros.backbones.vggt.model import Vggt, random_model
from kfvo_ros.backbones.vggt.preprocessing import fit
from kfvo_ros.backbones.vggt.runtime import (
    PRECISIONS,
    choose_device,
    choose_dtype,
    compile_blocks,
    compiler_needed,
    memory_bounded,
    use_onednn_layout,
)
from kfvo_ros.utils.commands import make_parser, run_command
from kfvo_ros.utils.process import peak_rss_mb

Times = dict[str, list[float]]


class WindowSteps:
    """A window of random frames, and the three kinds of steps with it.

    `autocast` runs the plain step as the published code does: bfloat16 arithmetic on float32
    weights, but for the camera head.
    """

    def __init__(self, model: Vggt, height: int, width: int, frames: int,
                 autocast: bool = False) -> None:
        self.model, self.autocast = model, autocast
        self.device = model.camera_head.empty_pose_tokens.device
        self.images = torch.rand(frames, 3, height, width, device=self.device)
        self._fit = fit(height, width, width)
        self._window: list[FrameCache] = []

    def arithmetic(self) -> AbstractContextManager[object]:
        """Return the context in which a plain step multiplies matrices."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.autocast else nullcontext()

    def plain(self) -> Tensor:
        """Place the window with nothing reused."""
        with self.arithmetic():
            features = self.model.aggregator(self.images[None])
        return self.model.camera_head(features.float())

    def slide(self) -> Tensor:
        """Take in a frame and leave the oldest: another frame becomes the anchor."""
        self.fill()
        self._window = [*self._window[1:], *self._see(self.images[-1:])]
        return self._place()

    def keep_anchor(self) -> Tensor:
        """Take in a frame in place of the newest, which was dropped."""
        self.fill()
        self._window = [*self._window[:-1], *self._see(self.images[-1:])]
        return self._place()

    def fill(self) -> None:
        """Place a first window, so that every later step finds what it may reuse."""
        if not self._window:
            self._window = self._see(self.images)
            self._place()

    def _see(self, images: Tensor) -> list[FrameCache]:
        patches = self.model.aggregator.see(images)[:, SPECIAL:]
        return [FrameCache(self._fit, grid_of(images), image, each[None])
                for image, each in zip(images, patches)]

    def _place(self) -> Tensor:
        return self.model.camera_head(features_cached(self.model.aggregator, [self._window]))


def count_flops(step: Callable[[WindowSteps], Tensor], height: int, width: int, frames: int) -> int:
    """Return the floating point operations of a step of the full model; nothing is computed."""
    with torch.device('meta'):
        scene = WindowSteps(Vggt().requires_grad_(False), height, width, frames)
        if step is not WindowSteps.plain:
            scene.fill()
        with FlopCounterMode(display=False) as counter:
            step(scene)
    return counter.get_total_flops()


STEPS: dict[str, Callable[[WindowSteps], Tensor]] = {
    'plain': WindowSteps.plain, 'sliding': WindowSteps.slide, 'anchor kept': WindowSteps.keep_anchor}
"""Each takes in one frame and places a window of as many frames."""


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark; return its exit status."""
    return run_command('benchmarks/vggt.py', _run, argv)


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = make_parser('python benchmarks/vggt.py', __doc__ or '')
    parser.add_argument('--size', type=_size, default=(392, 518), metavar='HxW',
                        help='size of the images, multiples of 14 (default: 392x518)')
    parser.add_argument('--frames', type=int, default=8, help='frames of a window '
                        '(default: %(default)s)')
    parser.add_argument('--precision', choices=('auto', *PRECISIONS), default='auto')
    parser.add_argument('--against', choices=('same', 'fp32', 'official'), default='same',
                        help='what computes the plain step: the same model, one in fp32, or one '
                        'with fp32 weights under bfloat16 autocast, as published')
    parser.add_argument('--device', default='auto')
    parser.add_argument('--compile', action='store_true', help='have torch compile the model, '
                        'but for a plain step that another one computes')
    parser.add_argument('--rounds', type=int, default=7, help='each kind of step is timed so '
                        'often (default: %(default)s)')
    arguments = parser.parse_args(argv)
    if arguments.frames < 2 or arguments.rounds < 1:
        parser.error('expected at least two frames and one round')
    return arguments


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition('x')
    size = (int(height), int(width))
    if min(size) < PATCH or size[0] % PATCH or size[1] % PATCH:
        raise argparse.ArgumentTypeError(f'expected HxW in multiples of {PATCH}, came {text}')
    return size


def _run(argv: list[str]) -> None:
    arguments = _parse(argv)
    device = choose_device(arguments.device)
    with torch.inference_mode(), memory_bounded(device), (
            compiler_needed() if arguments.compile else nullcontext()):
        _compare(arguments, device)


def _compare(arguments: argparse.Namespace, device: torch.device) -> None:
    """Time the steps and print the table."""
    dtype = choose_dtype(arguments.precision, device)
    shape: tuple[int, int, int] = (*arguments.size, arguments.frames)
    model = random_model(device, dtype)
    if arguments.compile:
        compile_blocks(model)
    elif device.type == 'cpu':
        use_onednn_layout(model)
    ours = WindowSteps(model, *shape)
    official = arguments.against == 'official'
    plain = ours if arguments.against == 'same' else WindowSteps(
        random_model(device, torch.float32), *shape, autocast=official)
    times = _time(plain, ours, arguments.rounds)
    rates = {scene: _matmul_rate(scene) for scene in {plain, ours}}
    name = torch.cuda.get_device_name(device) if device.type == 'cuda' else \
        f'{torch.get_num_threads()} threads'
    print(f'{device} ({name}), torch {torch.__version__}, {shape[2]} frames of '
          f'{shape[0]}x{shape[1]}, matrices in {dtype}, plain in '
          f'{"autocast" if official else "fp32" if plain is not ours else dtype}')
    print(f'{"step":12} {"ms":>9} {"ratio":>6} {"TFLOP":>7} {"share":>6} {"of matmul":>9}')
    counts = {kind: count_flops(step, *shape) for kind, step in STEPS.items()}
    for kind, flops in counts.items():
        median = statistics.median(times[kind])
        ratio = statistics.median(map(float.__truediv__, times['plain'], times[kind]))
        rate = rates[plain if kind == 'plain' else ours]
        print(f'{kind:12} {1e3 * median:9.1f} {ratio:5.2f}x {flops / 1e12:7.2f} '
              f'{flops / counts["plain"]:6.3f} {flops / median / rate:9.2f}')
    for kind in ('sliding', 'anchor kept'):
        print(f'{kind}: ' + ', '.join(f'{part} {100 * share:.1f} %'
                                      for part, share in _shares(ours, kind).items()))
    print(f'matmul rate {rates[ours] / 1e12:.3f} TFLOP/s, peak memory '
          f'{_peak_memory_mb(device):.0f} MiB')


def _time(plain: WindowSteps, ours: WindowSteps, rounds: int) -> Times:
    """Return the seconds of each kind of step, run in turn after a round to warm up."""
    times: Times = {kind: [] for kind in STEPS}
    for _ in range(rounds + 1):
        for kind, step in STEPS.items():
            scene = plain if kind == 'plain' else ours
            start = _now(ours.device)
            step(scene)
            times[kind].append(_now(ours.device) - start)
    return {kind: seconds[1:] for kind, seconds in times.items()}


def _shares(scene: WindowSteps, kind: str) -> dict[str, float]:
    """Return the share of each part in a step's time."""
    model, device = scene.model, scene.device
    spent = {'encode': 0.0, 'frame': 0.0, 'head': 0.0}
    with _timed(spent, 'encode', model.aggregator.patch_embed, device), \
            _timed(spent, 'frame', model.aggregator.frame_blocks, device), \
            _timed(spent, 'head', model.camera_head, device):
        start = _now(device)
        STEPS[kind](scene)
        total = _now(device) - start
    spent['global and rest'] = total - sum(spent.values())
    return {part: seconds / total for part, seconds in spent.items()}


@contextmanager
def _timed(spent: dict[str, float], part: str, module: nn.Module,
           device: torch.device) -> Iterator[None]:
    """Add to ``spent[part]`` what a module takes, or each module of a list."""
    def begin(*_: object) -> None:
        """Start the clock."""
        spent[part] -= _now(device)

    def end(*_: object) -> None:
        """Stop it."""
        spent[part] += _now(device)

    modules = module if isinstance(module, nn.ModuleList) else [module]
    hooks = [hook for each in modules for hook in (
        each.register_forward_pre_hook(begin), each.register_forward_hook(end))]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _matmul_rate(scene: WindowSteps) -> float:
    """Return the operations per second of the model's largest matrix, in its layout [1/s]."""
    block = scene.model.aggregator.global_blocks[0]
    assert isinstance(block, Block)
    frames, _, height, width = scene.images.shape
    tokens = torch.randn(frames * height * width // PATCH ** 2, scene.model.config.width,
                         device=scene.device)
    seconds = []
    for _ in range(8):
        start = _now(scene.device)
        with scene.arithmetic():
            hidden = block.mlp.fc1(tokens)
        seconds.append(_now(scene.device) - start)
    return 2.0 * tokens.numel() * hidden.shape[-1] / statistics.median(seconds[1:])


def _now(device: torch.device) -> float:
    """Return the time [s] at which all that was asked of the device is done."""
    if device.type == 'cuda':
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _peak_memory_mb(device: torch.device) -> float:
    if device.type == 'cuda':
        return torch.cuda.max_memory_allocated(device) / 1024.0 ** 2
    return peak_rss_mb()


if __name__ == '__main__':
    sys.exit(main())

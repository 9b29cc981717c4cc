# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What users may choose, declared once: command lines and the node's parameters follow."""

from __future__ import annotations

import argparse
import types
import typing
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, TypeVar

from kfvo_ros.keyframes import POLICIES
from kfvo_ros.scale import SCALE_RULES

Options = TypeVar('Options')

REWARDS = ('local', 'paper')
"""What a decision can be worth in training."""


def option(default: Any, description: str, choices: tuple[str, ...] = (),
           least: float | None = None, most: float | None = None, bare: Any = None,
           flag: str = '') -> Any:
    """Declare one field: its default, what it does, what it may be, and what no value means.

    `flag` is its name on command lines, if another than the field's.
    """
    return field(default=default, metadata={'description': description, 'choices': choices,
                                            'least': least, 'most': most, 'bare': bare,
                                            'flag': flag})


@dataclass(frozen=True)
class OdometryOptions:
    """The method's choices."""

    backbone: str = option('geometric', 'model that places the frames of a window: geometric '
                           'on any processor, vggt on a GPU', ('geometric', 'vggt'))
    scale_rule: str | None = option(
        None, "scale alignment between windows; default the backbone's own", SCALE_RULES,
        flag='scale')
    keyframes: str | None = option(
        None, 'policy that decides which frames stay; default: a policy file, or the learned one '
        'that comes with the backbone where it fits, else survival', POLICIES)
    flow_threshold: float = option(
        50.0, 'optical_flow: keep when the tracks moved farther since the last keyframe [px]',
        least=0.0)
    survival_share: float = option(
        0.8, "survival: keep when fewer of the last keyframe's tracks are left", least=0.0,
        most=1.0)
    policy: str | None = option(
        None, 'learned: file of the policy (.safetensors); default: the one that comes with the '
        'backbone')
    window_size: int = option(8, 'frames in a window', least=3, most=32)
    seed: int = option(0, 'seed of every random choice', least=0)


@dataclass(frozen=True)
class VggtOptions:
    """The VGGT backbone's choices."""

    weights: str = option(
        'facebook/VGGT-1B', 'vggt: repository on the Hugging Face hub, or a .safetensors or .pt '
        'file')
    revision: str | None = option(
        None, "vggt: the repository's branch, tag or commit; default: main")
    device: str = option('auto', 'vggt: auto (a GPU if there is one), cpu, cuda or cuda:N')
    precision: str = option(
        'auto', 'vggt: numbers of the matrices; auto: what the device does fast',
        ('auto', 'fp32', 'bf16', 'fp16'))
    image_width: int = option(
        518, 'vggt: width of the images that the model sees [px], a multiple of 14; the model '
        'was trained at 518', least=14, most=4200)
    recompute: bool = option(
        False, 'vggt: compute every window in full instead of reusing what is known of its '
        'frames; the poses are the same')
    compile: bool = option(
        False, 'vggt: have torch compile the model, a minute or so at the start; worth trying on '
        'a GPU')


@dataclass(frozen=True)
class SequenceOptions:
    """How a sequence is read."""

    kind: str | None = option(
        None, 'kind of sequence (euroc, tum, kitti, tartanair, bag, folder, video, synthetic); '
        'default: detected')
    camera: str | None = option(None, 'calibration (camera_info.yaml) that wins over all others')
    image_topic: str | None = option(None, 'image topic of a bag; default: the first by name')
    ground_truth_topic: str | None = option(None, 'ground truth topic of a bag')
    ground_truth_to_camera: str | None = option(
        None, 'where the camera is on the body of the ground truth: "x y z qx qy qz qw"')
    rate: float = option(10.0, 'frames per second of what has no stamps [Hz]', least=1e-3)
    stop: int | None = option(None, 'stop after so many frames', least=1)


@dataclass(frozen=True)
class PlayOptions:
    """What of a bag is played, and how."""

    topic: tuple[str, ...] = option(
        (), 'play only this topic; may be given several times. Default: all topics, but of '
        'several image topics only the first by name')
    rate: float = option(1.0, 'speed; 2 is twice as fast as recorded', least=1e-3, most=1e3)
    start: float = option(0.0, 'skip so much of the beginning of the bag [s]', least=0.0, most=1e9)
    duration: float | None = option(None, 'play so much of the bag [s]; default: all',
                                    least=1e-3, most=1e9)
    loop: bool = option(False, 'begin again at the end, until interrupted')
    clock: float | None = option(None, 'publish the time of the bag on /clock, so often [Hz]; '
                                 '40 without a value', least=1e-3, most=1e3, bare=40.0)
    wait_for_subscribers: int | None = option(
        None, 'begin when the image topic has so many subscribers (without images: every topic); '
        '1 without a value', least=1, bare=1)


@dataclass(frozen=True)
class TrainOptions:
    """How a policy is trained."""

    recipe: str = option('train.yaml', 'every number of the training: a YAML file, or the name '
                         'of one in config/')
    steps: int | None = option(None, "decisions to learn from; default the recipe's", least=1)
    reward: str | None = option(None, "what a decision is worth; default the recipe's", REWARDS)
    environments: int | None = option(
        None, "episodes that are driven side by side; default the recipe's", least=1, most=1000)
    workers: int = option(1, 'processes that drive them', least=1, most=256)
    cache: str | None = option(
        None, 'folder that keeps what the backbone made of the training sequences; default: none '
        'is kept')
    resume: bool = option(False, 'go on from the checkpoint beside --output')
    overwrite: bool = option(False, 'begin anew where there is a policy or a checkpoint')
    smoke: bool = option(False, 'try everything in a minute, on short rendered sequences unless '
                         'others are named')


def add_arguments(parser: argparse.ArgumentParser, options: type[Any],
                  without: tuple[str, ...] = ()) -> None:
    """Add one ``--name`` for each field of an options dataclass, `without` some of them."""
    group = parser.add_argument_group((options.__doc__ or '').splitlines()[0].rstrip('.'))
    for declared in fields(options):
        if declared.name in without:
            continue
        meta = declared.metadata
        about: dict[str, Any] = {'help': meta['description'], 'default': declared.default}
        if isinstance(declared.default, bool):
            about |= {'action': 'store_true'}
        else:
            about |= {'choices': meta['choices'] or None,
                      'metavar': None if meta['choices'] else declared.name.upper(),
                      'type': _parser_of(options, declared.name, meta)}
            if declared.default not in (None, MISSING, ()):
                about['help'] += ' (default: %(default)s)'
        if isinstance(declared.default, tuple):
            about |= {'action': 'append', 'default': None}
        if meta['bare'] is not None:
            about |= {'nargs': '?', 'const': meta['bare']}
        group.add_argument(_flag(declared), dest=declared.name, **about)


def from_arguments(options: type[Options], arguments: argparse.Namespace) -> Options:
    """Build the dataclass from parsed arguments; what was left out is the default."""
    values = {declared.name: getattr(arguments, declared.name, None)
              for declared in fields(options)}  # type: ignore[arg-type]
    return options(**{name: tuple(value) if isinstance(value, list) else value
                      for name, value in values.items() if value is not None})


def to_arguments(options: Any) -> list[str]:
    """Return the command line that gives these options; defaults stay unsaid."""
    arguments = []
    for declared in fields(options):
        value = getattr(options, declared.name)
        if value == declared.default:
            continue
        if value is True:
            arguments.append(_flag(declared))
        else:
            # With '=', for a value may begin with a dash.
            arguments += [f'{_flag(declared)}={each}'
                          for each in (value if isinstance(value, tuple) else (value,))]
    return arguments


def type_of(options: type[Any], name: str) -> type[Any]:
    """Return the type of a field, that of its elements if it is a tuple, without None."""
    hint = typing.get_type_hints(options)[name]
    return next(part for part in typing.get_args(hint) or (hint,) if part is not types.NoneType)


def _flag(declared: Field[Any]) -> str:
    return f'--{(declared.metadata["flag"] or declared.name).replace("_", "-")}'


def _parser_of(options: type[Any], name: str, meta: Any) -> Any:
    """Return a function from text to the field's type, within its range."""
    kind = type_of(options, name)

    def parse(text: str) -> Any:
        """Return the value of a text; raises what argparse reports."""
        try:
            value = kind(text)
        except ValueError as error:
            if meta['bare'] is None:
                raise
            raise argparse.ArgumentTypeError(
                f'invalid {kind.__name__} value: {text!r}; without a value it must not stand '
                'before another argument') from error
        if kind is not str and not (meta['least'] is None or value >= meta['least']):
            raise argparse.ArgumentTypeError(f'expected at least {meta["least"]}, came {text}')
        if kind is not str and not (meta['most'] is None or value <= meta['most']):
            raise argparse.ArgumentTypeError(f'expected at most {meta["most"]}, came {text}')
        return value

    parse.__name__ = kind.__name__
    return parse

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of a dataclass: the command line that follows from them."""

from __future__ import annotations

import argparse
from dataclasses import FrozenInstanceError, asdict, fields

import pytest

from kfvo_ros.ablation import AblationOptions
from kfvo_ros.benchmark import BenchmarkOptions
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.ros.options import NodeOptions, PlayOptions
from kfvo_ros.training.config import TrainOptions
from kfvo_ros.utils.config import add_arguments, from_arguments, options_of, to_arguments

OTHER = {
    OdometryOptions: OdometryOptions(scale_rule='translation', keyframes='optical_flow',
                                     backbone='vggt', flow_threshold=12.5, survival_share=0.25,
                                     policy='a policy.safetensors', window_size=5, seed=17),
    VggtOptions: VggtOptions(weights='model.pt', revision='v1', device='cuda:1', precision='fp16',
                             image_width=140, recompute=True, compile=True),
    SequenceOptions: SequenceOptions(kind='tum', camera='a b.yaml', image_topic='/cam0/image',
                                     ground_truth_topic='/vicon',
                                     ground_truth_to_camera='0 0 0 0 0 0 1', rate=29.97, stop=3),
    TrainOptions: TrainOptions(recipe='own.yaml', steps=7, reward='paper', environments=3,
                               workers=2, cache='a folder', resume=True, overwrite=True,
                               smoke=True),
}


def parse(options, *arguments):
    parser = argparse.ArgumentParser()
    add_arguments(parser, options)
    return from_arguments(options, parser.parse_args(list(arguments)))


def flag_of(field):
    return f'--{(field.metadata["flag"] or field.name).replace("_", "-")}'


@pytest.mark.parametrize('options', list(OTHER))
def test_no_arguments_give_the_defaults(options):
    assert parse(options) == options()


@pytest.mark.parametrize('options', list(OTHER))
def test_every_field_is_an_argument(options):
    given = OTHER[options]
    different = [name for name, value in asdict(given).items()
                 if value != getattr(options(), name)]
    assert set(different) == {field.name for field in fields(options)}
    arguments = [text for field in fields(options) for text in (
        [flag_of(field)] if getattr(given, field.name) is True
        else [flag_of(field), str(getattr(given, field.name))])]
    parsed = parse(options, *arguments)
    assert parsed == given
    assert [type(value) for value in asdict(parsed).values()] == [
        type(value) for value in asdict(given).values()]
    assert parse(options, *to_arguments(given)) == given


@pytest.mark.parametrize(('options', 'arguments', 'expected'), [
    (OdometryOptions, ['--window-size', '2'], 'at least 3'),
    (OdometryOptions, ['--window-size', '33'], 'at most 32'),
    (OdometryOptions, ['--window-size', '8.5'], '8.5'),
    (OdometryOptions, ['--survival-share', '1.01'], 'at most 1'),
    (OdometryOptions, ['--survival-share', '-0.1'], 'at least 0'),
    (OdometryOptions, ['--survival-share', 'nan'], 'nan'),
    (OdometryOptions, ['--flow-threshold', '-1'], 'at least 0'),
    (OdometryOptions, ['--flow-threshold', 'far'], 'far'),
    (OdometryOptions, ['--seed', '-1'], 'at least 0'),
    (OdometryOptions, ['--keyframes', 'often'], "'often'"),
    (OdometryOptions, ['--scale', 'metric'], "'metric'"),
    (OdometryOptions, ['--backbone', 'orb'], "'orb'"),
    (OdometryOptions, ['--unheard-of', '1'], '--unheard-of'),
    (SequenceOptions, ['--stop', '0'], 'at least 1'),
    (SequenceOptions, ['--rate', '0'], 'at least 0.001'),
    (SequenceOptions, ['--rate', 'nan'], 'nan'),
])
def test_invalid_values_are_errors_that_name_the_value(options, arguments, expected, capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(options, *arguments)
    assert stopped.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert expected in message


@pytest.mark.parametrize('options', [*OTHER, NodeOptions, PlayOptions, BenchmarkOptions,
                                     AblationOptions])
def test_every_number_has_a_largest_value(options):
    for declared in options_of(options):
        if declared.kind not in (int, float):
            continue
        assert declared.check(declared.most) == declared.most < 1e10
        for text in ('1' + '0' * 30, '9' * 5000, '1e400', 'inf', 'nan'):
            with pytest.raises(ValueError, match='^expected a .*at most .*, came .{1,500}$'):
                declared.parse(text)
        for value in (10 ** 30, 1 << 20_000, float('inf'), float('nan')):
            with pytest.raises((ValueError, OverflowError)):
                declared.check(value)


def test_play_options():
    assert parse(PlayOptions) == PlayOptions()
    assert parse(PlayOptions, '--topic', '/a', '--topic', 'b', '--rate', '0.5', '--start', '1.5',
                 '--duration', '2', '--loop', '--clock', '25', '--wait-for-subscribers',
                 '3') == PlayOptions(('/a', 'b'), 0.5, 1.5, 2.0, True, 25.0, 3)
    bare = parse(PlayOptions, '--clock', '--wait-for-subscribers')
    assert (bare.clock, bare.wait_for_subscribers) == (40.0, 1)


@pytest.mark.parametrize(('arguments', 'expected'), [
    (['--clock', 'walk.bag'], "came 'walk.bag'; without a value"),
    (['--wait-for-subscribers', '0'], 'at least 1'),
    (['--start', '-1'], 'at least 0'),
    (['--duration', 'nan'], 'nan'),
    (['--rate', 'fast'], 'fast'),
])
def test_invalid_play_options(arguments, expected, capsys):
    with pytest.raises(SystemExit):
        parse(PlayOptions, *arguments)
    assert expected in capsys.readouterr().err.splitlines()[-1]


def test_range_ends_are_allowed():
    assert parse(OdometryOptions, '--survival-share', '1').survival_share == 1.0
    assert parse(OdometryOptions, '--window-size', '3').window_size == 3
    assert parse(OdometryOptions, '--window-size', '32').window_size == 32


def test_help_describes_each_option():
    parser = argparse.ArgumentParser()
    for options in OTHER:
        add_arguments(parser, options)
    text = ' '.join(parser.format_help().split())
    for declared in (field for options in OTHER for field in fields(options)):
        assert flag_of(declared) in text
        assert ' '.join(declared.metadata['description'].split()) in text
    assert '(default: 0.8)' in text
    assert all(name in text for name in (*POLICIES, *SCALE_RULES))


def test_excluded_fields_are_no_options_and_keep_their_defaults():
    parser = argparse.ArgumentParser()
    add_arguments(parser, OdometryOptions, without=('keyframes', 'policy'))
    assert '--keyframes' not in parser.format_help() and '--seed' in parser.format_help()
    options = from_arguments(OdometryOptions, parser.parse_args(['--seed', '5']))
    assert options == OdometryOptions(seed=5)


def test_to_arguments_yields_the_options():
    assert to_arguments(OdometryOptions()) == []
    assert to_arguments(OdometryOptions(scale_rule='none')) == ['--scale=none']
    transform = SequenceOptions(ground_truth_to_camera='-1 0 0 0 0 0 1')
    assert parse(SequenceOptions, *to_arguments(transform)) == transform
    topics = PlayOptions(topic=('/a', '/b'), loop=True)
    assert to_arguments(topics) == ['--topic=/a', '--topic=/b', '--loop']


def test_options_are_frozen():
    with pytest.raises(FrozenInstanceError):
        OdometryOptions().seed = 1

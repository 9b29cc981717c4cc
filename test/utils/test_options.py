# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options declared once: the command line that follows from them, and what is built."""

from __future__ import annotations

import argparse
from dataclasses import FrozenInstanceError, asdict, fields

import numpy as np
import pytest

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.ros.options import PlayOptions
from kfvo_ros.training.config import TrainOptions
from kfvo_ros.utils.config import add_arguments, from_arguments, to_arguments

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
def test_no_arguments_are_the_defaults(options):
    assert parse(options) == options()


@pytest.mark.parametrize('options', list(OTHER))
def test_every_field_goes_through_the_command_line(options):
    wanted = OTHER[options]
    different = [name for name, value in asdict(wanted).items()
                 if value != getattr(options(), name)]
    assert set(different) == {field.name for field in fields(options)}
    arguments = [text for field in fields(options) for text in (
        [flag_of(field)] if getattr(wanted, field.name) is True
        else [flag_of(field), str(getattr(wanted, field.name))])]
    parsed = parse(options, *arguments)
    assert parsed == wanted
    assert [type(value) for value in asdict(parsed).values()] == [
        type(value) for value in asdict(wanted).values()]
    assert parse(options, *to_arguments(wanted)) == wanted


@pytest.mark.parametrize(('options', 'arguments', 'complaint'), [
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
def test_wrong_values_are_refused_with_what_came(options, arguments, complaint, capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(options, *arguments)
    assert stopped.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert complaint in message


def test_play_options():
    assert parse(PlayOptions) == PlayOptions()
    assert parse(PlayOptions, '--topic', '/a', '--topic', 'b', '--rate', '0.5', '--start', '1.5',
                 '--duration', '2', '--loop', '--clock', '25', '--wait-for-subscribers',
                 '3') == PlayOptions(('/a', 'b'), 0.5, 1.5, 2.0, True, 25.0, 3)
    bare = parse(PlayOptions, '--clock', '--wait-for-subscribers')
    assert (bare.clock, bare.wait_for_subscribers) == (40.0, 1)


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--clock', 'walk.bag'], "came 'walk.bag'; without a value"),
    (['--wait-for-subscribers', '0'], 'at least 1'),
    (['--start', '-1'], 'at least 0'),
    (['--duration', 'nan'], 'nan'),
    (['--rate', 'fast'], 'fast'),
])
def test_wrong_play_options(arguments, complaint, capsys):
    with pytest.raises(SystemExit):
        parse(PlayOptions, *arguments)
    assert complaint in capsys.readouterr().err.splitlines()[-1]


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


def test_what_is_left_out_is_no_option_and_keeps_its_default():
    parser = argparse.ArgumentParser()
    add_arguments(parser, OdometryOptions, without=('keyframes', 'policy'))
    assert '--keyframes' not in parser.format_help() and '--seed' in parser.format_help()
    options = from_arguments(OdometryOptions, parser.parse_args(['--seed', '5']))
    assert options == OdometryOptions(seed=5)


def test_options_become_the_command_line_that_gives_them():
    assert to_arguments(OdometryOptions()) == []
    assert to_arguments(OdometryOptions(scale_rule='none')) == ['--scale=none']
    transform = SequenceOptions(ground_truth_to_camera='-1 0 0 0 0 0 1')
    assert parse(SequenceOptions, *to_arguments(transform)) == transform
    topics = PlayOptions(topic=('/a', '/b'), loop=True)
    assert to_arguments(topics) == ['--topic=/a', '--topic=/b', '--loop']


def test_options_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        OdometryOptions().seed = 1


@pytest.mark.parametrize('keyframes', [name for name in POLICIES if name != 'learned'])
def test_odometry_is_what_the_options_say(keyframes):
    odometry = factory.make_odometry(OdometryOptions(
        keyframes=keyframes, flow_threshold=12.5, survival_share=0.25, window_size=5,
        scale_rule='none'))
    assert odometry.policy.name == keyframes
    assert odometry.window_size == 5
    assert odometry.scale.rule == 'none'
    assert odometry.backbone.name == 'geometric'
    if keyframes == 'optical_flow':
        assert odometry.policy.threshold == 12.5
    if keyframes == 'survival':
        assert odometry.policy.share == 0.25


def test_policy_file_is_not_ignored_where_nothing_learned_was_asked_for():
    with pytest.raises(KfvoError, match='every is for keyframes learned, came keyframes survival'):
        factory.make_odometry(OdometryOptions(keyframes='survival', policy='every'))
    with pytest.raises(KfvoError, match='cannot read the policy none-such'):
        factory.make_odometry(OdometryOptions(policy='none-such'))


@pytest.mark.parametrize(('options', 'policy'), [
    ({}, 'learned'), ({'scale_rule': 'depth'}, 'learned'), ({'scale_rule': 'none'}, 'survival'),
    ({'window_size': 6}, 'survival'), ({'keyframes': 'every'}, 'every')])
def test_the_default_policy_is_the_learned_one_where_it_fits(options, policy):
    assert factory.make_odometry(OdometryOptions(**options)).policy.name == policy


def test_scale_rule_is_the_backbones_unless_chosen():
    assert factory.make_odometry(OdometryOptions()).scale.rule == 'depth'


def test_transform_of_seven_numbers():
    transform = factory.parse_transform('1, 2 3 0 0 0.5 0.5')
    np.testing.assert_allclose(transform[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(transform[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert factory.parse_transform(None) is None


@pytest.mark.parametrize('text', ['', '1 2 3', '1 2 3 0 0 0 0', 'a b c d e f g',
                                  'nan 0 0 0 0 0 1', '1 2 3 0 0 0 1 9'])
def test_other_transforms_are_refused(text):
    with pytest.raises(KfvoError, match='seven numbers'):
        factory.parse_transform(text)


def test_sequence_takes_its_options(tmp_path):
    with pytest.raises(KfvoError, match='unknown kind'):
        factory.make_sequence('synthetic:1', SequenceOptions(kind='nothing'))
    with pytest.raises(KfvoError, match='cannot read the calibration'):
        factory.make_sequence('synthetic:1', SequenceOptions(camera=str(tmp_path / 'no.yaml')))
    assert factory.make_sequence('synthetic:1:fast', SequenceOptions()).name == 'synthetic:1:fast'

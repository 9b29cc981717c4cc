# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Construction of odometry, policies and sequences from options."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions


@pytest.mark.parametrize('keyframes', [name for name in POLICIES if name != 'learned'])
def test_odometry_follows_the_options(keyframes):
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


def test_a_policy_file_is_not_ignored():
    with pytest.raises(KfvoError, match='every is for keyframes learned, came keyframes survival'):
        factory.make_odometry(OdometryOptions(keyframes='survival', policy='every'))
    with pytest.raises(KfvoError, match='cannot read the policy none-such'):
        factory.make_odometry(OdometryOptions(policy='none-such'))


@pytest.mark.parametrize(('options', 'policy'), [
    ({}, 'learned'), ({'scale_rule': 'depth'}, 'learned'), ({'scale_rule': 'none'}, 'survival'),
    ({'window_size': 6}, 'survival'), ({'keyframes': 'every'}, 'every')])
def test_the_default_policy_is_the_learned_one_if_it_fits(options, policy):
    assert factory.make_odometry(OdometryOptions(**options)).policy.name == policy


def test_the_default_scale_rule_is_that_of_the_backbone():
    assert factory.make_odometry(OdometryOptions()).scale.rule == 'depth'


def test_transform_of_seven_numbers():
    transform = factory.parse_transform('1, 2 3 0 0 0.5 0.5')
    np.testing.assert_allclose(transform[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(transform[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert factory.parse_transform(None) is None


@pytest.mark.parametrize('text', ['', '1 2 3', '1 2 3 0 0 0 0', 'a b c d e f g',
                                  'nan 0 0 0 0 0 1', '1 2 3 0 0 0 1 9'])
def test_invalid_transforms_are_errors(text):
    with pytest.raises(KfvoError, match='seven numbers'):
        factory.parse_transform(text)


def test_make_sequence_applies_its_options(tmp_path):
    with pytest.raises(KfvoError, match='unknown kind'):
        factory.make_sequence('synthetic:1', SequenceOptions(kind='nothing'))
    with pytest.raises(KfvoError, match='cannot read the calibration'):
        factory.make_sequence('synthetic:1', SequenceOptions(camera=str(tmp_path / 'no.yaml')))
    assert factory.make_sequence('synthetic:1:fast', SequenceOptions()).name == 'synthetic:1:fast'

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Construct backbone, keyframe policy, odometry and sequence from their options."""

from __future__ import annotations

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.backbones.base import Backbone
from kfvo_ros.errors import KfvoError
from kfvo_ros.keyframes.base import KeyframePolicy, layout_of
from kfvo_ros.keyframes.heuristics import (
    EveryFrame,
    OpticalFlow,
    ParallaxPolicy,
    ParallaxRule,
    Survival,
)
from kfvo_ros.keyframes.learned import PolicySignature, find_policy, read_policy
from kfvo_ros.odometry.keyframe_odometry import KeyframeOdometry
from kfvo_ros.odometry.options import OdometryOptions, SequenceOptions, VggtOptions
from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.base import Sequence
from kfvo_ros.sequences.calibration import read_calibration
from kfvo_ros.utils.files import user_path


def make_backbone(options: OdometryOptions, vggt: VggtOptions | None = None) -> Backbone:
    """Return the backbone that `options` name; raises KfvoError."""
    if options.backbone == 'vggt':
        from kfvo_ros.backbones.vggt.backbone import load_backbone
        vggt = vggt or VggtOptions()
        return load_backbone(vggt.weights, vggt.revision, vggt.device, vggt.precision,
                             vggt.image_width, not vggt.recompute, options.window_size,
                             vggt.compile)
    from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
    return GeometricBackbone(options.seed)


def make_policy(options: OdometryOptions, backbone: Backbone) -> KeyframePolicy:
    """Return the keyframe policy of `options` for this backbone; raises KfvoError.

    The default is the learned policy of the backbone where its signature matches, else `Survival`.
    """
    if options.policy is not None and options.keyframes not in (None, 'learned'):
        raise KfvoError(f'the policy file {options.policy} is for keyframes learned, came '
                        f'keyframes {options.keyframes}: choose learned, or leave the policy out')
    if options.keyframes == 'every':
        return EveryFrame()
    if options.keyframes == 'optical_flow':
        return OpticalFlow(options.flow_threshold)
    if options.keyframes == 'survival':
        return Survival(options.survival_share)
    signature = signature_of(options, backbone)
    if options.keyframes == 'parallax':
        return _make_parallax_policy(signature)
    path = find_policy(options.policy, backbone.name)
    file = read_policy(path) if path is not None else None
    is_default = options.keyframes is None and options.policy is None
    if is_default and (file is None or file.signature.mismatch(signature) is not None):
        return Survival(options.survival_share)
    if file is None:
        raise KfvoError(f'no learned policy comes with the {backbone.name} backbone: expected the '
                        'file of one in policy, none came')
    return file.policy(signature)


def _make_parallax_policy(signature: PolicySignature) -> ParallaxPolicy:
    """Return the parallax policy; raises KfvoError for a backbone without its signals."""
    missing = ParallaxRule.missing_signals(signature.observation)
    if missing:
        raise KfvoError('keyframes parallax: expected a backbone with the signals '
                        f'{" and ".join(missing)}, which {signature.backbone} does not offer; '
                        'choose another keyframe policy')
    return ParallaxPolicy(signature.observation)


def signature_of(options: OdometryOptions, backbone: Backbone) -> PolicySignature:
    """Return the signature that a learned policy must match."""
    return PolicySignature(backbone.name, options.scale_rule or backbone.default_scale_rule,
                           options.window_size,
                           layout_of(backbone.descriptor_size, options.window_size,
                                     backbone.signal_names))


def make_odometry(options: OdometryOptions | None = None, backbone: Backbone | None = None,
                  vggt: VggtOptions | None = None) -> KeyframeOdometry:
    """Return the odometry of `options`; None means the defaults. Raises KfvoError.

    Several odometries can share one `backbone`.
    """
    options = options or OdometryOptions()
    backbone = backbone or make_backbone(options, vggt)
    return KeyframeOdometry(backbone, make_policy(options, backbone), options.scale_rule,
                            options.window_size)


def make_sequence(text: str, options: SequenceOptions) -> Sequence:
    """Return the sequence of a path or ``synthetic:SEED[:STYLE]``; raises KfvoError."""
    return open_sequence(
        text, kind=options.kind, image_topic=options.image_topic,
        camera=read_calibration(user_path(options.camera)) if options.camera else None,
        ground_truth_topic=options.ground_truth_topic,
        ground_truth_to_camera=parse_transform(options.ground_truth_to_camera),
        rate=options.rate)


def parse_transform(text: str | None) -> np.ndarray | None:
    """Return the transform (4, 4) of ``x y z qx qy qz qw``, None of None; raises KfvoError."""
    if text is None:
        return None
    try:
        numbers = np.array([float(part) for part in text.replace(',', ' ').split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 7 or not np.isfinite(numbers).all() or np.linalg.norm(numbers[3:]) < 1e-3:
        raise KfvoError(f'expected seven numbers "x y z qx qy qz qw", came {text!r}')
    return geometry.transform_from_xyz_quat(numbers)

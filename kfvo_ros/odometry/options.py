# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of odometry, of the VGGT backbone, and of how a sequence is read."""

from __future__ import annotations

from dataclasses import dataclass

from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.utils.config import option


@dataclass(frozen=True)
class OdometryOptions:
    """Options of the odometry."""

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
    """Options of the VGGT backbone."""

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
    stop: int | None = option(None, 'stop after this many frames', least=1)

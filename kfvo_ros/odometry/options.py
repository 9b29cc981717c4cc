# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options of the odometry, of the VGGT backbone and of reading a sequence."""

from __future__ import annotations

from dataclasses import dataclass

from kfvo_ros.keyframes import POLICIES
from kfvo_ros.odometry.scale import SCALE_RULES
from kfvo_ros.utils.config import option


@dataclass(frozen=True)
class OdometryOptions:
    """Options of the odometry."""

    backbone: str = option('geometric', 'model that estimates the poses of a window: geometric '
                           'on any CPU, vggt on a GPU', ('geometric', 'vggt'))
    scale_rule: str | None = option(
        None, "scale alignment between windows; default: the backbone's rule", SCALE_RULES,
        flag='scale')
    keyframes: str | None = option(
        None, 'policy that selects the keyframes; default: learned if policy is set or the file '
        'shipped for the backbone fits, else survival', POLICIES)
    flow_threshold: float = option(
        50.0, 'optical_flow: keep above this mean flow since the last keyframe [px]',
        least=0.0)
    survival_share: float = option(
        0.8, "survival: keep when a smaller share of the last keyframe's tracks survives",
        least=0.0, most=1.0)
    policy: str | None = option(
        None, 'learned: policy file (.safetensors); default: the one shipped for the backbone')
    window_size: int = option(8, 'frames in a window', least=3, most=32)
    seed: int = option(0, 'seed of all random choices', least=0)


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
        'auto', 'vggt: precision of the matrices; auto: the fastest of the device',
        ('auto', 'fp32', 'bf16', 'fp16'))
    image_width: int = option(
        518, 'vggt: width of the input images [px], a multiple of 14; the model was trained at '
        '518', least=14, most=4200)
    recompute: bool = option(
        False, 'vggt: compute every window in full instead of reusing the results of its frames; '
        'the poses are the same')
    compile: bool = option(
        False, 'vggt: compile the model with torch, about a minute at the start; meant for GPUs')


@dataclass(frozen=True)
class SequenceOptions:
    """Options of reading a sequence."""

    kind: str | None = option(
        None, 'kind of sequence (euroc, tum, kitti, tartanair, bag, folder, video, synthetic); '
        'default: detected')
    camera: str | None = option(None, 'calibration (camera_info.yaml) that takes precedence')
    image_topic: str | None = option(None, 'image topic of a bag; default: the first by name')
    ground_truth_topic: str | None = option(None, 'ground truth topic of a bag')
    ground_truth_to_camera: str | None = option(
        None, 'pose of the camera in the ground truth body: "x y z qx qy qz qw"')
    rate: float = option(10.0, 'frame rate of sequences without stamps [Hz]', least=1e-3)
    stop: int | None = option(None, 'stop after this many frames', least=1)

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Resize and crop of images: the official loader's pixels, native intrinsics, extreme sizes."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from vggt_models import DATA, make_window, small_model

from kfvo_ros.backbones.vggt.backbone import VggtBackbone, load_backbone
from kfvo_ros.backbones.vggt.preprocessing import fit_image
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame


@pytest.mark.parametrize('name', ['land', 'port', 'wide'])
def test_images_equal_those_of_the_official_loader(name):
    with np.load(DATA / 'preprocess.npz') as file:
        image = file[f'{name}_in']
        fitted = fit_image(*image.shape[:2], 518).apply(image)
        assert fitted.shape == tuple(file[f'{name}_crop_shape'])
        assert np.array_equal(fitted[3::7, 3::7], file[f'{name}_crop_sub7'])
        assert zlib.crc32(fitted.tobytes()) == file[f'{name}_crop_crc32']


def test_native_intrinsics_locate_a_marked_pixel():
    image = np.zeros((640, 480), dtype=np.uint8)
    image[300:304, 100:104] = 255
    fit = fit_image(640, 480, 140)
    fitted = fit.apply(image)[..., 0].astype(float)
    assert fitted.shape == (140, 140)
    v, u = (np.average(axis + 0.5, weights=fitted) for axis in np.indices(fitted.shape))
    x, y, _ = fit.native_intrinsics(np.eye(3)) @ [u, v, 1.0]
    assert (x, y) == (pytest.approx(102.0, abs=0.7), pytest.approx(302.0, abs=0.7))


@pytest.mark.parametrize('width', [0, -14, 13, 500, 519])
def test_image_widths_are_multiples_of_the_patch_size(width, small_vggt):
    with pytest.raises(KfvoError, match=f'image_width as a multiple of 14, came {width}'):
        load_backbone(str(small_vggt), None, 'cpu', 'fp32', width, True, 8)


@pytest.mark.parametrize(('height', 'width'), [(1, 200), (2, 300)])
def test_images_smaller_than_a_patch_are_refused(height, width):
    stream = VggtBackbone(small_model(), 140).open(None)
    with pytest.raises(KfvoError, match=f'at least 14 pixels high .*{width}x{height} came'):
        stream.encode(Frame(1, np.zeros((height, width), dtype=np.uint8), None))


@pytest.mark.parametrize(('height', 'width'), [(1, 1), (9, 5), (14, 140), (16, 200)])
def test_the_smallest_images_are_accepted(height, width):
    backbone = VggtBackbone(small_model(), 140)
    rng = np.random.default_rng(0)
    frames = [Frame(index, rng.integers(0, 256, (height, width), dtype=np.uint8), None)
              for index in range(2)]
    assert np.isfinite(backbone.estimate([make_window(backbone, frames)])[0].T_anchor_frame).all()

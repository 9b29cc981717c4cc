# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tiny datasets of every kind, written for the tests of the readers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from kfvo_ros import geometry

WIDTH, HEIGHT = 32, 24
LENGTH = 4
"""Number of frames of `write_dataset`."""


def make_image(index: int, colour: bool = False) -> np.ndarray:
    """Return noise (H, W) or (H, W, 3) RGB uint8, seeded by the index."""
    shape = (HEIGHT, WIDTH, 3) if colour else (HEIGHT, WIDTH)
    return np.random.default_rng(index).integers(0, 256, shape, dtype=np.uint8)


def make_poses(count: int, seed: int = 0) -> np.ndarray:
    """Return random poses (N, 4, 4)."""
    rng = np.random.default_rng(seed)
    return geometry.make_transform(geometry.exp_so3(rng.normal(size=(count, 3))),
                                   rng.normal(size=(count, 3)))


def write_image(path: Path, image: np.ndarray) -> None:
    """Write a lossless image file of a grey or RGB image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1])


def write_text(path: Path, *lines: str) -> None:
    """Write lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n'.join(lines) + '\n', encoding='utf-8')


def numbers(values: Iterable[float]) -> str:
    """Return numbers in the shortest text that reads back exactly."""
    return ' '.join(repr(float(value)) for value in values)


def pose_numbers(pose: np.ndarray) -> list[float]:
    """Return [x y z qx qy qz qw]."""
    return [*pose[:3, 3], *geometry.quat_xyzw_from_rotation(pose[:3, :3])]


def write_camera_info(folder: Path, fx: float, width: int = WIDTH, height: int = HEIGHT,
                      cx: float = 16, cy: float = 12) -> None:
    """Write a camera_info.yaml; tests identify it by its focal length."""
    write_text(folder / 'camera_info.yaml', f'image_width: {width}', f'image_height: {height}',
               f'camera_matrix: {{data: [{fx}, 0, {cx}, 0, {fx}, {cy}, 0, 0, 1]}}',
               'distortion_model: plumb_bob', 'distortion_coefficients: {data: [0, 0, 0, 0, 0]}')


T_BODY_CAMERA = geometry.make_transform(geometry.exp_so3(np.array([0.1, -0.2, 1.6])),
                                        np.array([-0.02, -0.06, 0.01]))

# The writers below take images and T_world_camera, one of each per frame, and return the path
# of the sequence and its stamps [ns].


def write_euroc(root: Path, images: list[np.ndarray], poses: np.ndarray) -> tuple[Path, list[int]]:
    """Write mav0 with stamps that no float64 holds."""
    stamps_ns = [1403715273262142976 + 50_000_001 * index for index in range(len(images))]
    folder, cam0 = root / 'V1_01', root / 'V1_01' / 'mav0' / 'cam0'
    for stamp_ns, image in zip(stamps_ns, images):
        write_image(cam0 / 'data' / f'{stamp_ns}.png', image)
    write_text(cam0 / 'data.csv', '#timestamp [ns],filename',
               *(f'{stamp_ns},{stamp_ns}.png\r' for stamp_ns in stamps_ns))
    write_text(cam0 / 'sensor.yaml', '%YAML:1.0', 'sensor_type: camera', 'T_BS:', '  cols: 4',
               '  rows: 4', f'  data: {T_BODY_CAMERA.ravel().tolist()}',
               f'resolution: [{WIDTH}, {HEIGHT}]', 'intrinsics: [30.0, 31.0, 16.5, 12.5] #fu, fv',
               'distortion_model: radial-tangential',
               'distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]')
    rows = []
    for stamp_ns, pose in zip(stamps_ns, poses @ geometry.invert(T_BODY_CAMERA)):
        x, y, z, qx, qy, qz, qw = pose_numbers(pose)
        rows.append(','.join([str(stamp_ns), *numbers([x, y, z, qw, qx, qy, qz, 9, 9]).split()]))
    write_text(folder / 'mav0' / 'state_groundtruth_estimate0' / 'data.csv',
               '#timestamp, p_RS_R_x [m], ...', *rows)
    return folder, stamps_ns


def write_tum(root: Path, images: list[np.ndarray], poses: np.ndarray) -> tuple[Path, list[int]]:
    """Write a freiburg1 folder with stamps in microseconds."""
    folder = root / 'rgbd_dataset_freiburg1_test'
    stamps = [f'1305031229.{528748 + 33333 * index:06d}' for index in range(len(images))]
    for stamp, image in zip(stamps, images):
        write_image(folder / 'rgb' / f'{stamp}.png', image)
    write_text(folder / 'rgb.txt', '# color images', '# timestamp filename',
               *(f'{stamp} rgb/{stamp}.png' for stamp in stamps))
    write_text(folder / 'groundtruth.txt', '# timestamp tx ty tz qx qy qz qw',
               *(f'{stamp} {numbers(pose_numbers(pose))}' for stamp, pose in zip(stamps, poses)))
    return folder, [int(stamp.replace('.', '')) * 1000 for stamp in stamps]


def write_kitti(root: Path, images: list[np.ndarray], poses: np.ndarray,
                camera: str = 'image_0') -> tuple[Path, list[int]]:
    """Write sequences/03 and poses/03.txt; the camera of image_2 is 6 cm left of camera 0."""
    folder = root / 'sequences' / '03'
    for index, image in enumerate(images):
        write_image(folder / camera / f'{index:06d}.png', image)
    write_text(folder / 'times.txt', *(f'{0.1036224 * n:.6e}' for n in range(len(images))))
    write_text(folder / 'calib.txt', 'P0: 30 0 16 0 0 30 12 0 0 0 1 0',
               'P1: 30 0 16 -16 0 30 12 0 0 0 1 0',
               'P2: 40 0 15 2.4 0 40 11 0 0 0 1 0')
    offset = [0.0, 0.0, 0.0] if camera == 'image_0' else [-0.06, 0.0, 0.0]
    camera0 = poses @ geometry.invert(geometry.make_transform(np.eye(3), np.array(offset)))
    write_text(root / 'poses' / '03.txt', *(numbers(pose[:3].ravel()) for pose in camera0))
    return folder, [round(103622400 * n, -2 if n else 0) for n in range(len(images))]


def write_tartanair(root: Path, images: list[np.ndarray], poses: np.ndarray
                    ) -> tuple[Path, list[int]]:
    """Write hospital/Easy/P000; the NED camera has x forward, y right and z down."""
    folder = root / 'hospital' / 'Easy' / 'P000'
    for index, image in enumerate(images):
        write_image(folder / 'image_left' / f'{index:06d}_left.png', image)
    ned = poses.copy()
    ned[:, :3, :3] = np.stack([poses[:, :3, 2], poses[:, :3, 0], poses[:, :3, 1]], axis=-1)
    write_text(folder / 'pose_left.txt', *(numbers(pose_numbers(pose)) for pose in ned))
    return folder, [100_000_000 * index for index in range(len(images))]


DATASETS = {'euroc': write_euroc, 'tum': write_tum, 'kitti': write_kitti,
            'tartanair': write_tartanair}


def write_dataset(kind: str, root: Path, colour: bool = False) -> tuple[Path, list[int]]:
    """Write LENGTH images and poses as one of DATASETS."""
    images = [make_image(index, colour) for index in range(LENGTH)]
    return DATASETS[kind](root, images, make_poses(LENGTH))

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small sequences of every kind on disk, from a rendered one, and their reader."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from benchmarks.faults.outcomes import Answer
from kfvo_ros import geometry
from kfvo_ros.errors import KfvoError
from kfvo_ros.sequences.base import Frame

COUNT, WIDTH, HEIGHT, SEED = 8, 128, 96, 2
NAME = 'walk'
CHUNK_BYTES = 30_000
"""Size of the chunks of a bag: two images."""
WORDS = ('warnings', 'left_out', 'ground_truth_problem', 'ended_early')
"""Keys of the summary that say what is missing."""


@cache
def rendered() -> tuple[tuple[Frame, ...], np.ndarray]:
    """Return frames and true poses (N, 4, 4)."""
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
    sequence = SyntheticSequence(SEED, 'smooth', COUNT, WIDTH, HEIGHT)
    return tuple(sequence), sequence.ground_truth().trajectory.poses


def write_mcap(folder: Path, zstd: bool = False) -> Path:
    """Write an MCAP recording as kfvo_convert does, in more and smaller chunks."""
    import mcap.writer

    from kfvo_ros.sequences.bag.recorder import Recorder
    from kfvo_ros.sequences.bag.writer import BagWriter
    from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
    sequence = SyntheticSequence(SEED, 'smooth', COUNT, WIDTH, HEIGHT)
    with patch('mcap.writer.Writer', partial(mcap.writer.Writer, chunk_size=CHUNK_BYTES)):
        recorder = Recorder(sequence, BagWriter(folder / NAME, zstd))
        for frame in sequence:
            recorder.write(frame)
        recorder.finish(complete=True)
    return folder / NAME


def write_mcap_zstd(folder: Path) -> Path:
    """Write an MCAP recording with compressed chunks."""
    return write_mcap(folder, zstd=True)


def write_sqlite3(folder: Path) -> Path:
    """Write a recording of ROS 2 in sqlite3."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    path = folder / NAME
    _copy_messages(Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3), None)
    return path


def write_ros1(folder: Path) -> Path:
    """Write a bag of ROS 1."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore
    writer = Writer(folder / f'{NAME}.bag')
    writer.chunk_threshold = CHUNK_BYTES
    _copy_messages(writer, get_typestore(Stores.ROS1_NOETIC))
    return folder / f'{NAME}.bag'


def _copy_messages(writer: Any, typestore: Any) -> None:
    """Write the messages of `write_mcap` as types of a store; None for those of ROS 2."""
    from rosbags.convert.converter import create_connections_converters
    from rosbags.highlevel import AnyReader
    with tempfile.TemporaryDirectory() as folder, \
            AnyReader([write_mcap(Path(folder))]) as reader, writer:
        connections, converters = create_connections_converters(
            reader.connections, typestore, reader, writer)
        for connection, stamp_ns, data in reader.messages():
            writer.write(connections[connection.id, connection.owner], stamp_ns,
                         converters[connection.msgtype](data))


def write_avi(folder: Path) -> Path:
    """Write a video of JPEG images."""
    path = folder / f'{NAME}.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'MJPG'), 10.0, (WIDTH, HEIGHT),
                             False)
    for frame in rendered()[0]:
        writer.write(frame.image)
    writer.release()
    return path


def write_png(folder: Path) -> Path:
    """Write a folder of PNG images with its calibration."""
    return _write_images(folder, 'png')


def write_jpeg(folder: Path) -> Path:
    """Write a folder of JPEG images with its calibration."""
    return _write_images(folder, 'jpg')


def _write_images(folder: Path, suffix: str) -> Path:
    for index, frame in enumerate(rendered()[0]):
        _write_image(folder / NAME / f'{index:06d}.{suffix}', frame.image)
    camera = rendered()[0][0].camera
    assert camera is not None
    _write_lines(folder / NAME / 'camera_info.yaml', [
        f'image_width: {WIDTH}', f'image_height: {HEIGHT}', 'distortion_model: plumb_bob',
        f'camera_matrix: {{rows: 3, cols: 3, data: {camera.matrix.ravel().tolist()}}}',
        'distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]}'])
    return folder / NAME


def write_tum(folder: Path) -> Path:
    """Write a TUM RGB-D folder."""
    frames, poses = rendered()
    root = folder / 'rgbd_dataset_freiburg1_walk'
    stamps = [f'1305031229.{33333 * index:06d}' for index in range(COUNT)]
    for stamp, frame in zip(stamps, frames):
        _write_image(root / 'rgb' / f'{stamp}.png', frame.image)
    _write_lines(root / 'rgb.txt', ['# timestamp filename',
                                    *(f'{stamp} rgb/{stamp}.png' for stamp in stamps)])
    _write_lines(root / 'groundtruth.txt', ['# timestamp tx ty tz qx qy qz qw', *(
        f'{stamp} {_numbers(_xyz_quat(pose), " ")}' for stamp, pose in zip(stamps, poses))])
    return root


def write_kitti(folder: Path) -> Path:
    """Write KITTI sequences/03 and poses/03.txt."""
    frames, poses = rendered()
    root = folder / 'sequences' / '03'
    for index, frame in enumerate(frames):
        _write_image(root / 'image_0' / f'{index:06d}.png', frame.image)
    _write_lines(root / 'times.txt', [f'{0.1036224 * index:.6e}' for index in range(COUNT)])
    _write_lines(root / 'calib.txt', [
        f'P{index}: 80 0 63.5 {-43 * index} 0 80 47.5 0 0 0 1 0' for index in range(4)])
    _write_lines(folder / 'poses' / '03.txt', [_numbers(pose[:3].ravel(), ' ') for pose in poses])
    return root


def write_euroc(folder: Path) -> Path:
    """Write an EuRoC folder."""
    frames, poses = rendered()
    mav, stamps = folder / 'V1_01' / 'mav0', [50_000_000 * (28_074_305_465 + index)
                                              for index in range(COUNT)]
    for stamp, frame in zip(stamps, frames):
        _write_image(mav / 'cam0' / 'data' / f'{stamp}.png', frame.image)
    _write_lines(mav / 'cam0' / 'data.csv', ['#timestamp [ns],filename',
                                             *(f'{stamp},{stamp}.png' for stamp in stamps)])
    _write_lines(mav / 'cam0' / 'sensor.yaml', [
        'sensor_type: camera', 'T_BS:', '  cols: 4', '  rows: 4',
        f'  data: {np.eye(4).ravel().tolist()}', f'resolution: [{WIDTH}, {HEIGHT}]',
        'intrinsics: [80.0, 80.0, 63.5, 47.5]', 'distortion_model: radial-tangential',
        'distortion_coefficients: [0.0, 0.0, 0.0, 0.0]'])
    _write_lines(mav / 'state_groundtruth_estimate0' / 'data.csv', ['#timestamp, ...', *(
        f'{stamp},{_numbers([x, y, z, qw, qx, qy, qz], ",")}' for stamp, pose in zip(stamps, poses)
        for x, y, z, qx, qy, qz, qw in [_xyz_quat(pose)])])
    return folder / 'V1_01'


def _xyz_quat(pose: np.ndarray) -> list[float]:
    return [*pose[:3, 3], *geometry.quat_xyzw_from_rotation(pose[:3, :3])]


def _numbers(values: Any, separator: str) -> str:
    return separator.join(f'{value:.9f}' for value in values)


def _write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def _write_lines(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n'.join(lines) + '\n', encoding='ascii')


def read_sequence(path: Path) -> Answer:
    """Run odometry over a sequence by kfvo_run, and read its frames once more for the digest.

    The units are frames, and one for ground truth.
    """
    from kfvo_ros import run
    errors = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            status = run.main([str(path), '--output', folder])
        if status != 0:
            return Answer(error=_error_line(errors.getvalue()))
        summary = json.loads(Path(folder, 'summary.json').read_text())
        trajectory = Path(folder, 'trajectory.tum').read_bytes()
    words = [f'{key}: {text}' for key in WORDS if key in summary
             for text in (summary[key] if key == 'warnings' else [str(summary[key])])]
    frames, digest = _hash_sequence(path)
    digest.update(trajectory)
    return Answer(frames, digest.hexdigest(), tuple(words))


def _error_line(text: str) -> str:
    """Return the lines of an error, without what was printed before them."""
    _, mark, error = text.partition('kfvo_run: error: ')
    return error if mark else text


def _hash_sequence(path: Path) -> tuple[int, Any]:
    """Return the number of units of a sequence, and a digest of stamps, pixels and truth."""
    from kfvo_ros.sequences import open_sequence
    from kfvo_ros.sequences.base import read_ground_truth
    digest, units = hashlib.sha256(), 0
    with contextlib.suppress(KfvoError):
        sequence = open_sequence(str(path))
        truth, _ = read_ground_truth(sequence)
        if truth is not None:
            units += 1
            digest.update(truth.trajectory.stamps_ns.tobytes())
            digest.update(np.ascontiguousarray(truth.trajectory.poses).tobytes())
        for frame in sequence:
            units += 1
            digest.update(f'{frame.stamp_ns} {frame.image.shape} {frame.camera}'.encode())
            digest.update(frame.image.tobytes())
    return units, digest


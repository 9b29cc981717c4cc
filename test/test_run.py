# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.run`` as a process: files, exit status, errors, interruption."""

from __future__ import annotations

import json
import re
import subprocess
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_lines import (
    ENVIRONMENT,
    assert_one_readable_line,
    run_interrupted,
    run_python,
)
from odometry_scenes import frames_of
from sequence_writers import write_camera_info

import kfvo_ros
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import format_stamp, read_tum
from kfvo_ros.utils.signals import SIGNALS

COUNT = 24
POSE = re.compile(r'\d+\.\d{9}( -?\d+\.\d{9}){7}')

command = partial(run_python, '-m', 'kfvo_ros.run')


@pytest.fixture(scope='module')
def images(tmp_path_factory) -> Path:
    """Return a folder of small images with its calibration."""
    folder = tmp_path_factory.mktemp('images')
    frames = frames_of(0, COUNT)
    for index, frame in enumerate(frames):
        cv2.imwrite(str(folder / f'{index}.png'), frame.image)
    camera = frames[0].camera
    write_camera_info(folder, camera.fx, camera.width, camera.height, camera.cx, camera.cy)
    return folder


@pytest.fixture(scope='module')
def finished(images, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    output = tmp_path_factory.mktemp('out') / 'deep' / 'folder'
    return output, command(images, '--output', output, '--keyframes', 'survival')


def test_files_and_summary_of_a_run(images, finished):
    output, done = finished
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in output.iterdir()) == [
        'keyframes.tum', 'summary.json', 'trajectory.tum']
    summary = json.loads((output / 'summary.json').read_text())
    assert {'frames', 'keyframes', 'lost_frames', 'backbone', 'keyframe_policy', 'scale_rule',
            'seed', 'version', 'ms_per_frame', 'peak_rss_mb', 'extent', 'median_depth',
            'max_rotation_deg'} <= set(summary)
    assert summary['frames'] == COUNT
    assert summary['lost_frames'] == 0
    assert (summary['backbone'], summary['keyframe_policy']) == ('geometric', 'survival')
    assert (summary['scale_rule'], summary['seed']) == ('depth', 0)
    assert summary['version'] == kfvo_ros.__version__
    assert set(summary['ms_per_frame']) == {'encode', 'estimate', 'decide', 'total'}
    for times in summary['ms_per_frame'].values():
        assert 0.0 <= times['median'] <= times['p95']
    assert summary['extent'] > 0.0
    assert summary['max_rotation_deg'] > 0.0
    assert 0.2 < summary['median_depth'] < 5.0
    assert 'ate_rmse_m' not in summary  # no ground truth
    assert 'ended_early' not in summary
    assert f'{COUNT} frames' in done.stdout


def test_trajectory_has_one_line_per_frame(images, finished):
    output, _ = finished
    lines = (output / 'trajectory.tum').read_text().splitlines()
    assert all(POSE.fullmatch(line) for line in lines)
    stamps = [format_stamp(frame.stamp_ns) for frame in open_sequence(str(images))]
    assert [line.split()[0] for line in lines] == stamps
    keyframes = (output / 'keyframes.tum').read_text().splitlines()
    assert set(keyframes) <= set(lines)
    assert keyframes == sorted(keyframes, key=lines.index)
    summary = json.loads((output / 'summary.json').read_text())
    assert len(keyframes) == summary['keyframes'] < COUNT
    assert lines[0].split()[1:] == ['0.000000000'] * 6 + ['1.000000000']
    norms = np.linalg.norm([[float(part) for part in line.split()[4:]] for line in lines], axis=1)
    np.testing.assert_allclose(norms, 1.0, atol=1e-8)


def test_memory_is_small(finished):
    assert json.loads((finished[0] / 'summary.json').read_text())['peak_rss_mb'] <= 250.0


def test_same_seed_gives_same_bytes_and_results_are_not_overwritten(images, finished, tmp_path):
    first = (finished[0] / 'trajectory.tum').read_bytes()
    again = command(images, '--output', tmp_path, '--keyframes', 'survival', '--seed', 0)
    assert again.returncode == 0
    assert (tmp_path / 'trajectory.tum').read_bytes() == first
    rejected = command(images, '--output', tmp_path, '--stop', 3)
    assert_one_readable_line(rejected, 'trajectory.tum', '--overwrite')
    assert (tmp_path / 'trajectory.tum').read_bytes() == first
    replaced = command(images, '--output', tmp_path, '--stop', 3, '--overwrite')
    assert replaced.returncode == 0
    assert len((tmp_path / 'trajectory.tum').read_text().splitlines()) == 3
    assert json.loads((tmp_path / 'summary.json').read_text())['frames'] == 3


def test_ground_truth_and_options(tmp_path):
    done = command('synthetic:3:fast', '--output', tmp_path, '--stop', 30, '--keyframes', 'every',
                   '--scale', 'translation', '--seed', 5, '--window-size', 6)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert (summary['keyframe_policy'], summary['scale_rule']) == ('every', 'translation')
    assert (summary['frames'], summary['keyframes'], summary['seed']) == (30, 30, 5)
    assert summary['ate_alignment'] == 'sim3'
    assert summary['ground_truth_frame'] == 'camera'
    assert 0.0 < summary['ate_rmse_m'] < 0.03 * summary['path_length_m']
    assert summary['ate_scale'] > 0.0
    assert 'ATE' in done.stdout
    assert len(read_tum(tmp_path / 'trajectory.tum')) == 30


@pytest.mark.parametrize('sent', SIGNALS)
def test_interruption_keeps_the_results_so_far(sent, tmp_path):
    trajectory = tmp_path / 'trajectory.tum'
    status, _, errors = run_interrupted(
        sent, lambda: trajectory.exists() and trajectory.read_text().count('\n') >= 3,
        '-m', 'kfvo_ros.run', 'synthetic:1:fast', '--output', tmp_path, '--keyframes', 'every')
    assert status == 128 + sent
    assert 'Traceback' not in errors
    assert 'interrupted' in errors.splitlines()[-1]
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert summary['ended_early'] == 'interrupted'
    lines = trajectory.read_text().splitlines()
    assert all(POSE.fullmatch(line) for line in lines)
    # There is a line for each processed frame, including those in the window.
    assert 10 <= len(lines) == summary['frames'] < 200
    assert len(lines) == len((tmp_path / 'keyframes.tum').read_text().splitlines())


@pytest.mark.parametrize(('arguments', 'parts'), [
    (['/no/such/place'], ['/no/such/place', 'does not exist', 'synthetic']),
    (['synthetic:many'], ['synthetic:many']),
    (['synthetic:1:sideways'], ['sideways']),
    (['synthetic:1', '--keyframes', 'often'], ['often']),
    (['synthetic:1', '--window-size', '1'], ['at least 3']),
    (['synthetic:1', '--kind', 'nothing'], ['nothing', 'euroc']),
    (['synthetic:1', '--camera', '/no/such.yaml'], ['/no/such.yaml']),
])
def test_invalid_arguments_are_errors_of_one_line(arguments, parts, tmp_path):
    done = command(*arguments, '--output', tmp_path / 'out')
    assert_one_readable_line(done, *parts)
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('corruption', ['noise', 'cut', 'size', 'empty'])
def test_a_corrupt_image_keeps_the_earlier_frames(corruption, images, tmp_path):
    folder, output = tmp_path / 'in', tmp_path / 'out'
    folder.mkdir()
    for path in images.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    bad = folder / '11.png'
    if corruption == 'size':
        cv2.imwrite(str(bad), np.zeros((100, 100), dtype=np.uint8))
    else:
        content = bad.read_bytes()
        bad.write_bytes({'noise': b'no image at all', 'empty': b'',
                         'cut': content[:40]}[corruption])
    done = command(folder, '--output', output)
    assert_one_readable_line(done, '11.png')
    assert done.returncode == 1
    assert len((output / 'trajectory.tum').read_text().splitlines()) == 11
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['frames'] == 11
    assert '11.png' in summary['ended_early']


def test_an_output_folder_that_cannot_be_created(images, tmp_path):
    (tmp_path / 'file').write_text('in the way')
    assert_one_readable_line(command(images, '--output', tmp_path / 'file' / 'out'), 'file')


def test_a_full_disk(images, tmp_path):
    """In development mode Python reports errors at its exit too."""
    (tmp_path / 'trajectory.tum').symlink_to('/dev/full')
    done = command(images, '--output', tmp_path, '--overwrite',
                   env=ENVIRONMENT | {'PYTHONDEVMODE': '1'})
    assert_one_readable_line(done, f'cannot write to {tmp_path}', 'No space left on device')


def test_an_invalid_rate(images, tmp_path):
    assert_one_readable_line(command(images, '--output', tmp_path / 'out', '--rate', 'inf'),
                             'inf')


def test_runs_without_torch_and_rclpy(images, tmp_path):
    script = ("import sys; sys.modules['torch'] = sys.modules['rclpy'] = None; "
              'from kfvo_ros.run import main; sys.exit(main())')
    done = run_python('-c', script, images, '--output', tmp_path, '--stop', 10)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / 'summary.json').read_text())['frames'] == 10


def test_a_single_image(images, tmp_path):
    done = command(images, '--output', tmp_path, '--stop', 1)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert (summary['frames'], summary['extent']) == (1, 0.0)
    assert summary['median_depth'] is None


def test_help_and_version():
    assert command('--version').stdout.strip() == f'kfvo_ros {kfvo_ros.__version__}'
    text = command('--help').stdout
    assert all(word in text for word in ('--output', '--keyframes', '--overwrite', 'synthetic:'))

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What ``python -m kfvo_ros.run`` says in summary.json about defects of its input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writers import COUNT, STAMPS_NS, BagBuilder, images, truth_records
from sequence_writers import make_image, write_dataset

from kfvo_ros.run import main


def run(source: Path, output: Path, *arguments: str) -> dict[str, Any]:
    """Return the summary of a run in this process."""
    assert main([str(source), '--output', str(output), *arguments]) == 0
    return json.loads((output / 'summary.json').read_text())


def test_a_good_bag_adds_its_topics_only(tmp_path):
    writer = BagBuilder('mcap')
    path = writer.write(tmp_path / 'walk', [
        *images(writer), *truth_records(writer, '/mocap', writer.pose_stamped),
        ('/cam0/camera_info', 0, writer.camera_info(33.0))])
    summary = run(path, tmp_path / 'out')
    assert (summary['image_topic'], summary['ground_truth_topic']) == ('/cam0/image_raw', '/mocap')
    assert summary['frames'] == COUNT and not {'left_out', 'warnings'} & set(summary)
    assert summary['ground_truth_frame'] == '/mocap'


def test_what_was_left_out_is_in_the_summary(tmp_path, caplog):
    writer = BagBuilder('mcap')
    records = images(writer)
    records[1] = (*records[1][:2], writer.image(STAMPS_NS[1] + 60 * 10 ** 9, make_image(1)))
    records[3] = (*records[3][:2], writer.image(STAMPS_NS[3], make_image(3), encoding='mono12'))
    path = writer.write(tmp_path / 'walk', [
        *records, *truth_records(writer, '/odom', writer.odometry),
        ('/cam0/camera_info', 0, writer.camera_info(33.0))])
    summary = run(path, tmp_path / 'out')
    assert summary['frames'] == COUNT - 2
    assert summary['left_out'] == {'odd_stamp': 1, 'unreadable': 1}
    assert summary['ground_truth_topic'] == '/odom'
    assert any('its name says odometry' in text for text in summary['warnings'])
    assert any('left out 2 images' in text for text in summary['warnings'])
    assert 'its name says odometry' in caplog.text


def test_choices_among_topics_are_visible(tmp_path, caplog):
    writer = BagBuilder('mcap')
    path = writer.write(tmp_path / 'walk', [
        *images(writer), *images(writer, '/cam1/image_raw'),
        *truth_records(writer, '/a/pose', writer.pose_stamped),
        *truth_records(writer, '/b/pose', writer.pose_stamped)])
    summary = run(path, tmp_path / 'out')
    assert 'images of /cam0/image_raw; others are: /cam1/image_raw' in caplog.text
    assert '/a/pose is taken; other candidates: /b/pose' in caplog.text
    assert all('guessing' in text for text in summary['warnings'])  # a choice is no warning


@pytest.mark.parametrize(('text', 'problem'), [
    ('nonsense', 'groundtruth.txt, line 1'), ('1 nan nan nan nan nan nan nan', 'line 1'),
    ('# nothing', 'at least 3 poses'), ('1 1e200 0 0 0 0 0 1', 'line 1')])
def test_ground_truth_never_stops_a_run(text, problem, tmp_path):
    path, _ = write_dataset('tum', tmp_path)
    (path / 'groundtruth.txt').write_text(text)
    summary = run(path, tmp_path / 'out')
    assert summary['frames'] == 4 and problem in summary['ground_truth_problem']


def test_fewer_frames_than_stated_is_a_warning(tmp_path):
    writer = BagBuilder('mcap')
    path = writer.write(tmp_path / 'walk', images(writer))
    metadata = path / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 5', 'message_count: 9'))
    summary = run(path, tmp_path / 'out')
    assert summary['left_out'] == {'missing': 4}
    assert f'walk: read {COUNT} of the 9 frames that it should have; 4 were left out' in \
        summary['warnings']
    stopped = run(path, tmp_path / 'stopped', '--stop', '2')
    assert stopped['frames'] == 2 and not any('read' in text for text in stopped['warnings'])


def test_a_summary_has_finite_numbers_only(tmp_path):
    """A ground truth of huge numbers gives no infinite error."""
    path, stamps_ns = write_dataset('tum', tmp_path)
    rows = [f'{stamp_ns / 1e9:.9f} {value} 0 0 0 0 0 1' for stamp_ns, value in zip(
        stamps_ns, np.geomspace(1e-300, 1e9, len(stamps_ns)))]
    (path / 'groundtruth.txt').write_text('\n'.join(rows))
    summary = run(path, tmp_path / 'out')
    assert summary['frames'] == 4
    assert 'ate_rmse_m' in summary or 'ground_truth_problem' in summary

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command ``python -m kfvo_ros.convert``: errors, interruption, nothing overwritten."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from bag_writers import COUNT
from command_lines import assert_one_readable_line, run_interrupted, run_python
from recordings import assert_same_sequence, write_sequence

from kfvo_ros.sequences import open_sequence
from kfvo_ros.sequences.synthetic.sequence import SyntheticSequence
from kfvo_ros.utils.signals import SIGNALS

command = partial(run_python, '-m', 'kfvo_ros.convert')


@pytest.mark.parametrize('taken', ['folder', 'file', 'dead link'])
def test_an_existing_output_is_refused_before_reading(taken, tmp_path):
    bag = tmp_path / 'out'
    {'folder': bag.mkdir, 'file': bag.touch,
     'dead link': lambda: bag.symlink_to('nowhere')}[taken]()
    assert_one_readable_line(command('/no/such/sequence', bag), str(bag), 'exists already')
    assert list(tmp_path.iterdir()) == [bag]


@pytest.mark.parametrize(('arguments', 'parts'), [
    (['/no/such/place'], ['/no/such/place', 'does not exist']),
    (['synthetic:7', '--kind', 'nothing'], ['nothing', 'euroc']),
    (['synthetic:7', '--metadata-version', '7'], ['7', '8, 9']),
    (['synthetic:7', '--compressed', 'gif'], ['gif', 'png', 'jpeg']),
    (['synthetic:7', '--topic', 'my images'], ['my images', '/camera/image_raw']),
    (['synthetic:7', '--topic', '/a//b'], ['/a//b']),
    (['synthetic:7', '--topic', '/camera/camera_info'], ['/camera/camera_info', '--topic']),
    (['synthetic:7', '--topic', '/ground_truth/odometry'], ['/ground_truth/odometry']),
    (['tum', '--topic', '/camera/image_rect'], ['/camera/image_rect', 'rectified']),
    (['broken'], ['0.png']),
    (['synthetic:7', '--stop', '0'], ['at least 1']),
])
def test_invalid_requests_leave_no_output(arguments, parts, tmp_path):
    if arguments[0] == 'tum':
        arguments = [write_sequence('tum', tmp_path), *arguments[1:]]
    if arguments[0] == 'broken':
        arguments = [write_sequence('folder', tmp_path)]
        Path(arguments[0], '0.png').write_bytes(b'no image')
    assert_one_readable_line(command(*arguments, tmp_path / 'a' / 'out'), *parts)
    assert not (tmp_path / 'a').exists()


def test_invalid_outputs(tmp_path):
    source = write_sequence('folder', tmp_path)
    (tmp_path / 'file').touch()
    assert_one_readable_line(command(source, tmp_path / 'file' / 'out'), 'file/out')
    assert_one_readable_line(command(source, tmp_path / 'out.mcap'), 'out.mcap', 'folder')


def test_stamps_outside_ros_time(tmp_path):
    source = write_sequence('tum', tmp_path)
    index = Path(source, 'rgb.txt')
    lines = index.read_text().splitlines()
    lines = lines[:-COUNT + 3] + [f'500000000{n}.0 {lines[-1].split()[1]}' for n in range(3)]
    index.write_text('\n'.join(lines))
    done = command(source, tmp_path / 'out')
    assert_one_readable_line(done, '5000000000.000000000', '2038', '3 images')
    assert len(list(open_sequence(str(tmp_path / 'out')))) == 3


def test_one_odd_stamp_is_left_out_and_said(tmp_path):
    source = write_sequence('tum', tmp_path)
    index = Path(source, 'rgb.txt')
    lines = index.read_text().splitlines()
    lines[-1] = '5000000000.0 ' + lines[-1].split()[1]
    index.write_text('\n'.join(lines))
    done = command(source, tmp_path / 'out')
    assert done.returncode == 0 and 'left out 1 images' in done.stderr
    assert len(list(open_sequence(str(tmp_path / 'out')))) == COUNT - 1


def test_a_broken_image_keeps_the_earlier_ones(tmp_path):
    source = write_sequence('euroc', tmp_path)
    original = open_sequence(source)
    fourth = sorted(Path(source).rglob('*.png'))[3]
    fourth.write_bytes(b'no image at all')
    done = command(source, tmp_path / 'out')
    assert_one_readable_line(done, fourth.name, '3 images before', str(tmp_path / 'out'))
    copy = open_sequence(str(tmp_path / 'out'))
    assert len(list(copy)) == len(copy.ground_truth().trajectory) == 3
    assert copy.camera == original.camera


def test_a_full_disk(tmp_path):
    """A limit on file sizes simulates it: writing fails in the same place."""
    script = ('import resource, sys; from kfvo_ros.convert import main; '
              'resource.setrlimit(resource.RLIMIT_FSIZE, (2 << 20, 2 << 20)); sys.exit(main())')
    done = run_python('-c', script, 'synthetic:7', tmp_path / 'out', '--stop', 20)
    assert_one_readable_line(done, 'cannot write', str(tmp_path / 'out'), 'incomplete')


@pytest.mark.parametrize('sent', SIGNALS)
def test_interruption_keeps_the_written_images(sent, tmp_path):
    bag = tmp_path / 'out'
    status, _, errors = run_interrupted(
        sent, lambda: bag.exists() and any(file.stat().st_size > 1 << 20
                                           for file in bag.iterdir()),
        '-m', 'kfvo_ros.convert', 'synthetic:7', bag)
    assert status == 128 + sent and 'Traceback' not in errors
    copy = open_sequence(str(bag))
    assert f'interrupted; the {copy.length} images before' in errors.splitlines()[-1]
    assert 3 <= copy.length < 200
    assert_same_sequence(SyntheticSequence(7), copy, copy.length)


def test_help():
    done = command('--help')
    assert done.returncode == 0
    assert all(word in done.stdout for word in ('--compressed', '--zstd', '--metadata-version'))

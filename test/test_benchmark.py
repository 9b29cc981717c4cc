# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``python -m kfvo_ros.benchmark``: runs that finish, fail and are interrupted."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from command_lines import (
    assert_one_readable_line,
    children_of,
    is_running,
    run_python,
    started,
)
from odometry_scenes import frames_of, truth_of
from policies import ALWAYS, write_policy
from sequence_writers import write_camera_info, write_image, write_kitti

pytest.importorskip('matplotlib', reason="matplotlib is not installed: pip install '.[demo]'")

from kfvo_ros import benchmark
from kfvo_ros.evaluation.metrics import absolute_trajectory_error
from kfvo_ros.keyframes.learned import PolicySignature
from kfvo_ros.odometry import factory
from kfvo_ros.odometry.options import OdometryOptions
from kfvo_ros.sequences import open_sequence
from kfvo_ros.trajectory import read_tum
from kfvo_ros.utils.process import time_limit

COUNT = 16
METHODS = ('every', 'learned')
INTERFACE_COLUMNS = [
    'sequence', 'method', 'backbone', 'scale_rule', 'frames', 'keyframes', 'ate_rmse_m',
    'path_length_m', 'ate_percent', 'rpe_trans', 'rpe_rot_deg', 'ms_per_frame', 'seed']
PAGES = ('results.md', 'results.tex', 'results.html', 'trajectories.png', 'errors.png')


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / 'results.csv').open(newline='') as file:
        return list(csv.DictReader(file))


def write_room(root: Path) -> Path:
    """Write a rendered room as KITTI's sequence 03."""
    frames = frames_of(1, COUNT)
    folder, _ = write_kitti(root, [frame.image for frame in frames], truth_of(1, COUNT).poses)
    camera = frames[0].camera
    write_camera_info(folder, camera.fx, camera.width, camera.height, camera.cx, camera.cy)
    return folder


@pytest.fixture(scope='module')
def sequences(tmp_path_factory) -> list[Path]:
    """Return a valid one, one with a broken image and one without ground truth."""
    root = tmp_path_factory.mktemp('data')
    valid = write_room(root)
    broken, without_truth = valid.with_name('04'), root / 'without_truth'
    shutil.copytree(valid, broken)
    (broken / 'image_0' / '000012.png').write_bytes(b'no image')
    without_truth.mkdir()
    write_camera_info(without_truth, 30.0)
    for index in range(2):
        write_image(without_truth / f'{index}.png', frames_of(1, COUNT)[0].image[:24, :32])
    return [valid, broken, without_truth]


@pytest.fixture(scope='module')
def policy(tmp_path_factory) -> Path:
    """Return a policy that keeps every frame."""
    options = OdometryOptions()
    signature = factory.signature_of(options, factory.make_backbone(options))
    return write_policy(tmp_path_factory.mktemp('policy') / 'p.safetensors', signature, ALWAYS)


@pytest.fixture(scope='module')
def finished(sequences, policy, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    folder = tmp_path_factory.mktemp('results')
    return folder, run_python(*command(sequences, policy, folder))


def command(sequences: list[Path], policy: Path, folder: Path, *more: object) -> list[object]:
    return ['-m', 'kfvo_ros.benchmark', *sequences, '--methods', ','.join(METHODS), '--policy',
            policy, '--output', folder, *more]


def test_a_row_for_each_run_and_two_trivial_baselines(finished):
    folder, outcome = finished
    assert outcome.returncode == 0, outcome.stderr
    rows = rows_of(folder)
    assert list(rows[0])[:len(INTERFACE_COLUMNS)] == INTERFACE_COLUMNS
    assert [(row['sequence'], row['method'], row['status']) for row in rows] == [
        ('kitti/03', 'every', 'finished'), ('kitti/03', 'learned', 'finished'),
        ('kitti/03', 'constant_position', 'finished'), ('kitti/03', 'straight_line', 'finished'),
        ('kitti/04', 'every', 'failed'), ('kitti/04', 'learned', 'failed'),
        ('without_truth', 'every', 'finished'), ('without_truth', 'learned', 'finished')]
    for row in rows[:2]:
        assert (row['backbone'], row['scale_rule'], row['seed']) == ('geometric', 'depth', '0')
        assert row['frames'] == row['keyframes'] == str(COUNT)
        assert 0.0 < float(row['ate_percent']) < 5.0
        assert float(row['encode_ms']) > 0.0 and row['head_ms'] == '' and row['jobs'] == '1'
    assert rows[2]['seed'] == rows[2]['backbone'] == rows[2]['ms_per_frame'] == ''
    assert float(rows[2]['ate_rmse_m']) > 10.0 * float(rows[0]['ate_rmse_m'])


def test_the_ate_is_that_of_the_files_of_the_run(finished, sequences):
    folder = finished[0] / 'runs' / 'kitti_03' / 'every' / '0'
    truth = open_sequence(str(sequences[0])).ground_truth().trajectory
    error = absolute_trajectory_error(read_tum(folder / 'trajectory.tum'), truth)
    assert float(rows_of(finished[0])[0]['ate_rmse_m']) == pytest.approx(error.rmse, rel=1e-12)
    assert {'keyframes.tum', 'summary.json'} <= {path.name for path in folder.iterdir()}


def test_a_failed_run_has_a_reason_and_the_others_continue(finished):
    folder, outcome = finished
    failed = rows_of(folder)[4]
    assert '000012.png' in failed['problem'] and failed['ate_rmse_m'] == ''
    assert 'kitti/04, every, seed 0: ' in outcome.stderr
    assert '4 of 6 runs finished' in outcome.stdout
    assert rows_of(folder)[6]['problem'] == 'no ground truth'


def test_report(finished):
    folder, outcome = finished
    for name in PAGES:
        assert (folder / name).stat().st_size > 0, name
    page = (folder / 'results.md').read_text()
    for part in ('| every | ✗ | No |', '| learned | ✓ | No |',
                 '| FastVGGT (published) | ✗ | No | 11.2 | 2.5 | 11.2 |',
                 'Avg: over 03, which all rows have.', 'loop closure', 'learned: p.safetensors',
                 '000012.png', '--methods every,learned', '![trajectories](trajectories.png)'):
        assert part in page, part
    assert 'VGGT-LK is optical_flow' in page and '| every | ✗ |' in outcome.stdout
    assert str(folder) not in page.replace(str(folder / 'runs'), '')


def test_resuming_skips_finished_runs(finished, sequences, policy, tmp_path):
    folder = tmp_path / 'results'
    shutil.copytree(finished[0], folder)
    runs = [folder / 'runs' / name / 'every' / '0'
            for name in ('kitti_03', 'kitti_04', 'without_truth')]
    before = [(run / 'request.json').stat().st_mtime_ns for run in runs]
    again = run_python(*command(sequences, policy, folder, '--resume', '--no-pictures'))
    assert again.returncode == 0, again.stderr
    after = [(run / 'request.json').stat().st_mtime_ns for run in runs]
    assert [old == new for old, new in zip(before, after)] == [True, False, True]
    for old, new in zip(rows_of(finished[0]), rows_of(folder), strict=True):
        changing = [name for name in old if 'ms' in name or name == 'peak_rss_mb']
        assert [old[name] for name in old if name not in changing] == [
            new[name] for name in new if name not in changing]


@pytest.mark.parametrize(('more', 'part'), [
    (['--resume', '--window-size', '6'], '--window-size'), ([], 'already holds results.csv'),
    (['--resume', '--overwrite'], 'both came')])
def test_results_of_other_options_are_rejected(more, part, finished, sequences, policy, capsys):
    folder = finished[0]
    before = (folder / 'results.csv').read_bytes()
    methods = ['--methods', 'every'] if more else []
    arguments = [str(sequences[0]), *methods, '--output', str(folder), *more]
    try:
        status = benchmark.main(arguments)
    except SystemExit as ending:
        status = ending.code
    line = capsys.readouterr().err.splitlines()[-1]
    assert status != 0 and part in line
    assert (folder / 'results.csv').read_bytes() == before


def test_another_policy_of_the_same_name_is_rejected(finished, sequences, policy, capsys):
    kept = policy.read_bytes()
    try:
        write_policy(policy, PolicySignature('geometric', 'depth', 8, (('gap', 1),)), ALWAYS)
        arguments = command(sequences[:1], policy, finished[0], '--resume')[2:]
        assert benchmark.main([str(each) for each in arguments]) == 1
    finally:
        policy.write_bytes(kept)
    assert 'is of another policy' in capsys.readouterr().err


@pytest.mark.parametrize(('arguments', 'part'), [
    (['/no/such/place'], '/no/such/place does not exist'),
    (['synthetic:0', '--methods', 'often'], "survival, parallax, learned, came 'often'"),
    (['synthetic:0', '--methods', 'every,'], "came ''"),
    (['synthetic:0', '--seeds', '1,x'], "seeds: expected whole numbers from 0 to 2147483647 "
     "with commas in between, came '1,x'"),
    (['synthetic:0', '--methods', 'learned', '--backbone', 'vggt'], 'name one with --policy'),
    (['synthetic:0', '--policy', 'p.safetensors', '--methods', 'every'], 'not among the methods'),
    (['synthetic:0', '--policy', '/no/policy'], 'cannot read the policy /no/policy'),
    (['synthetic:9-1'], 'synthetic:A-B'),
    (['synthetic:0', '--camera', '/no/camera.yaml'], '/no/camera.yaml')])
def test_invalid_arguments_are_rejected_before_any_run(arguments, part, tmp_path, capsys):
    assert benchmark.main([*arguments, '--output', str(tmp_path / 'out')]) == 1
    problems = capsys.readouterr().err.splitlines()
    assert len(problems) == 1 and part in problems[0]
    assert not (tmp_path / 'out' / 'runs').exists()


def test_a_policy_for_other_options_is_rejected(policy, tmp_path, capsys):
    assert benchmark.main(['synthetic:0', '--policy', str(policy), '--window-size', '6',
                           '--output', str(tmp_path / 'out')]) == 1
    assert 'window_size 8' in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_rejected(tmp_path, capsys):
    (tmp_path / 'file').write_text('in the way')
    assert benchmark.main(['synthetic:0', '--output', str(tmp_path / 'file' / 'out')]) == 1
    assert 'file/out' in capsys.readouterr().err


def test_tables_need_no_matplotlib():
    script = ("import sys; sys.modules['matplotlib'] = None; "
              'import kfvo_ros.benchmark, kfvo_ros.evaluation.report')
    assert run_python('-c', script).returncode == 0


def test_missing_matplotlib_is_reported_before_any_run(tmp_path):
    script = ("import sys; sys.modules['matplotlib'] = None; "
              'from kfvo_ros.benchmark import main; sys.exit(main())')
    outcome = run_python('-c', script, 'synthetic:0', '--output', tmp_path / 'out')
    assert_one_readable_line(outcome, 'matplotlib is missing: pip install matplotlib')
    assert not (tmp_path / 'out').exists()


# Interrupted runs


def short_command(folder: Path, methods: str, *more: object) -> list[object]:
    return ['-m', 'kfvo_ros.benchmark', 'synthetic:1:smooth', '--stop', 40, '--methods', methods,
            '--no-pictures', '--output', folder, *more]


def running(folder: Path, methods: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """Start a benchmark in a session of its own, as terminals do."""
    return started(*short_command(folder, methods), stdout=subprocess.DEVNULL)


def wait_for_child(process: subprocess.Popen[str], folder: Path, method: str) -> int:
    """Wait until a method has final poses; return the id of its process."""
    path = folder / 'runs' / 'synthetic_1_smooth' / method / '0' / 'trajectory.tum'
    deadline = time.monotonic() + time_limit(60.0)
    while not (path.exists() and path.read_text().count('\n') >= 3):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.01)
    child, = children_of(process.pid)
    return child


def test_a_killed_run_has_a_row_and_ctrl_c_keeps_the_rows(tmp_path):
    with running(tmp_path, 'every,optical_flow,survival') as process:
        os.kill(wait_for_child(process, tmp_path, 'every'), signal.SIGKILL)
        last = wait_for_child(process, tmp_path, 'survival')
        os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the children too
        problems = process.communicate(timeout=time_limit(30.0))[1]
    assert process.returncode == 128 + signal.SIGINT and 'Traceback' not in problems
    line = problems.splitlines()[-1]
    assert 'error: interrupted; 2 of 3 runs are in' in line and '--resume' in line
    rows = rows_of(tmp_path)
    assert [(row['method'], row['status']) for row in rows] == [
        ('every', 'failed'), ('optical_flow', 'finished'), ('constant_position', 'finished'),
        ('straight_line', 'finished')]
    assert rows[0]['problem'] == 'the process was ended by SIGKILL'
    assert not Path('/proc', str(last)).exists()


def test_no_process_outlives_a_terminated_benchmark(tmp_path):
    with running(tmp_path, 'every,survival') as process:
        child = wait_for_child(process, tmp_path, 'every')
        process.terminate()
        problems = process.communicate(timeout=time_limit(30.0))[1]
    assert process.returncode == 128 + signal.SIGTERM
    assert 'interrupted; 0 of 2 runs are in' in problems
    assert rows_of(tmp_path) == [] and not Path('/proc', str(child)).exists()


def test_a_killed_benchmark_leaves_no_process_and_is_resumed_at_once(tmp_path):
    """No second process may write to the folder of a run."""
    runs = tmp_path / 'runs' / 'synthetic_1_smooth'
    with running(tmp_path, 'every,survival') as process:
        child = wait_for_child(process, tmp_path, 'survival')
        before = (runs / 'every' / '0' / 'request.json').stat().st_mtime_ns
        process.kill()
        process.wait()
        again = run_python(*short_command(tmp_path, 'every,survival', '--resume'))
        assert not is_running(child)
    assert again.returncode == 0, again.stderr
    assert [(row['method'], row['status'], row['frames']) for row in rows_of(tmp_path)[:2]] == [
        ('every', 'finished', '40'), ('survival', 'finished', '40')]
    assert (runs / 'every' / '0' / 'request.json').stat().st_mtime_ns == before
    alone = run_python('-m', 'kfvo_ros.run', 'synthetic:1:smooth', '--stop', 40, '--keyframes',
                       'survival', '--output', tmp_path / 'alone')
    assert alone.returncode == 0, alone.stderr
    for name in ('trajectory.tum', 'keyframes.tum'):
        assert (runs / 'survival' / '0' / name).read_bytes() == (
            tmp_path / 'alone' / name).read_bytes()
    assert not list(tmp_path.rglob('*.lock'))

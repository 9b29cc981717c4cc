# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window's bundle adjustment against finite differences, dense algebra and the truth."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import kernels

FRAMES, POINTS, FOCAL = 6, 120, 400.0


def project(state: ba.State, hosts: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return where every frame sees every point (P, F, 2), by the definition."""
    T_w_frame = geometry.make_transform(state.rotations, state.translations)
    local = np.column_stack([(rays / state.inverse_depths[:, None]), np.ones(len(rays))])
    world = np.einsum('pij,pj->pi', T_w_frame[hosts], local)
    points = np.einsum('fij,pj->pfi', geometry.invert(T_w_frame), world)
    return points[..., :2] / points[..., 2:3]


def window(seed: int = 0, noise: float = 0.0, fixed: int = 1,
           prior: float = 0.0) -> tuple[ba.Problem, ba.State]:
    """Return a window with gaps in its tracks, `noise` [px], and its true state."""
    rng = np.random.default_rng(seed)
    rotations = geometry.exp_so3(0.05 * rng.normal(size=(FRAMES, 3)))
    translations = 0.3 * rng.normal(size=(FRAMES, 3))
    rotations[0], translations[0] = np.eye(3), 0.0
    hosts = rng.integers(0, 3, POINTS)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (POINTS, 2)), np.ones(POINTS)])
    state = ba.State(rotations, translations, 1.0 / rng.uniform(2.0, 6.0, POINTS))
    mask = rng.random((POINTS, FRAMES)) < 0.7
    mask[np.arange(POINTS), hosts] = True
    mask &= np.arange(FRAMES) >= hosts[:, None]
    mask[:, -1] = True
    seen = project(state, hosts, rays)
    seen += noise / FOCAL * rng.normal(size=seen.shape)
    seen[np.arange(POINTS), hosts] = rays[:, :2]
    weights = np.full(POINTS, prior)
    values = state.inverse_depths * rng.uniform(0.8, 1.2, POINTS)
    return ba.Problem(hosts, rays, seen, mask, FOCAL, fixed, weights, values), state


def disturbed(problem: ba.Problem, state: ba.State, size: float = 1.0) -> ba.State:
    """Return the state with all that is free some way off."""
    rng = np.random.default_rng(9)
    step = size * rng.normal(size=(FRAMES - problem.fixed, 6)) * np.repeat([0.01, 0.05], 3)
    depths = size * 0.1 * state.inverse_depths * rng.normal(size=POINTS)
    return ba.stepped(state, step.ravel(), depths)


def half_gradient(problem: ba.Problem, state: ba.State) -> np.ndarray:
    normal = ba.linearise(problem, state)
    return np.concatenate([normal.g_c, normal.g_p])


def moved_along(problem: ba.Problem, state: ba.State, index: int, by: float) -> ba.State:
    """Return the state moved along one free parameter: poses first, then depths."""
    size = 6 * (FRAMES - problem.fixed)
    step = np.zeros(size + POINTS)
    step[index] = by
    return ba.stepped(state, step[:size], step[size:])


@pytest.mark.parametrize('fixed', [1, 3])
def test_gradient_is_that_of_half_the_cost(fixed):
    problem, truth = window(noise=1.0, fixed=fixed, prior=30.0)
    state = disturbed(problem, truth, 0.2)
    gradient, eps = half_gradient(problem, state), 1e-6
    numeric = np.array([
        (ba.cost(problem, moved_along(problem, state, index, eps))
         - ba.cost(problem, moved_along(problem, state, index, -eps))) / (4.0 * eps)
        for index in range(len(gradient))])
    assert np.abs(gradient).min() > 0.0
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())


def test_hessian_is_the_derivative_of_the_gradient_where_residuals_vanish():
    problem, state = window(fixed=2, prior=30.0)
    normal, eps = ba.linearise(problem, state), 1e-6
    size = len(normal.g_c)
    H = np.block([[normal.H_cc, normal.H_cp], [normal.H_cp.T, np.diag(normal.H_pp)]])
    indices = [*range(size), *range(size, size + POINTS, 7)]
    numeric = np.array([
        (half_gradient(problem, moved_along(problem, state, index, eps))
         - half_gradient(problem, moved_along(problem, state, index, -eps))) / (2.0 * eps)
        for index in indices])
    np.testing.assert_allclose(H[indices], numeric, rtol=1e-4, atol=1e-6 * np.abs(H).max())


@pytest.mark.parametrize('damping', [1e-4, 1.0])
def test_schur_step_is_the_dense_step(damping):
    problem, truth = window(noise=1.0, prior=3.0)
    normal = ba.linearise(problem, disturbed(problem, truth))
    poses, depths = ba.step(normal, damping)
    H = np.block([[normal.H_cc, normal.H_cp], [normal.H_cp.T, np.diag(normal.H_pp)]])
    H[np.diag_indices(len(H))] *= 1.0 + damping
    dense = -np.linalg.solve(H, np.concatenate([normal.g_c, normal.g_p]))
    np.testing.assert_allclose(np.concatenate([poses, depths]), dense, rtol=1e-5, atol=1e-9)


def test_exact_window_is_recovered_up_to_scale():
    problem, truth = window()
    found = ba.adjust(problem, disturbed(problem, truth), 60)
    scale = np.linalg.norm(truth.translations) / np.linalg.norm(found.translations)
    found = found.scaled(scale)
    np.testing.assert_allclose(found.rotations, truth.rotations, atol=1e-6)
    np.testing.assert_allclose(found.translations, truth.translations, atol=1e-5)
    np.testing.assert_allclose(found.inverse_depths, truth.inverse_depths, rtol=1e-4)


def test_fixed_frames_hold_the_scale_and_never_move():
    problem, truth = window(fixed=3)
    start = disturbed(problem, truth)
    found = ba.adjust(problem, start, 60)
    assert np.array_equal(found.rotations[:3], truth.rotations[:3])
    assert np.array_equal(found.translations[:3], truth.translations[:3])
    assert not np.allclose(start.translations[3:], truth.translations[3:], atol=1e-3)
    np.testing.assert_allclose(found.translations, truth.translations, atol=1e-5)
    np.testing.assert_allclose(found.inverse_depths, truth.inverse_depths, rtol=1e-4)


def test_cost_never_rises_with_more_iterations():
    problem, truth = window(noise=0.1, prior=1.0)
    start = disturbed(problem, truth, 2.0)
    costs = [ba.cost(problem, ba.adjust(problem, start, count)) for count in range(8)]
    assert costs[0] == ba.cost(problem, start)
    assert all(after <= before for before, after in zip(costs, costs[1:]))
    assert costs[-1] < 0.01 * costs[0]


def test_few_wrong_tracks_do_not_pull_the_poses():
    problem, truth = window(noise=0.2, fixed=3)
    wrong = problem.seen.copy()
    wrong[::12, -1] += 30.0 / FOCAL
    found = ba.adjust(problem._replace(seen=wrong), disturbed(problem, truth, 0.3), 30)
    errors = np.linalg.norm(found.translations - truth.translations, axis=1)
    assert errors.max() < 0.01  # the scene is 2 to 6 away


def test_prior_holds_what_nothing_measures():
    problem, truth = window(prior=1.0)
    lonely = problem._replace(mask=np.zeros_like(problem.mask))
    found = ba.adjust(lonely, truth, 20)
    np.testing.assert_allclose(found.inverse_depths, problem.prior_values, rtol=1e-3)
    assert np.array_equal(found.translations, truth.translations)


def test_points_behind_a_camera_count_without_pulling():
    problem, state = window()
    turned = state.rotations.copy()
    turned[-1] = geometry.exp_so3(np.array([0.0, np.pi, 0.0]))
    behind = ba.State(turned, state.translations, state.inverse_depths)
    errors = ba.reprojection_errors(problem, behind)
    assert (errors[:, -1] == ba.BEHIND_ERROR).all()
    normal = ba.linearise(problem, behind)
    assert np.isfinite(normal.H_cc).all()
    assert not normal.g_c[-6:].any()


def test_unseen_and_hosted_observations_have_no_error():
    problem, state = window(noise=1.0)
    errors = ba.reprojection_errors(problem, state)
    hosted = np.arange(FRAMES) == problem.hosts[:, None]
    assert not errors[~problem.mask | hosted].any()
    shift = np.linalg.norm(project(state, problem.hosts, problem.rays) - problem.seen, axis=2)
    measured = problem.mask & ~hosted
    np.testing.assert_allclose(errors[measured], FOCAL * shift[measured], rtol=1e-9)


def test_triangulation_is_exact_and_knows_where_there_is_no_parallax():
    problem, state = window()
    arguments = problem.hosts, problem.rays, problem.seen, problem.mask
    inverse_depths, weights = kernels.triangulate(state.rotations, state.translations, *arguments)
    np.testing.assert_allclose(inverse_depths, state.inverse_depths, rtol=1e-9)
    assert (weights > 0.0).all()
    _, weights = kernels.triangulate(state.rotations, np.zeros_like(state.translations),
                                     *arguments)
    assert not weights.any()


def test_no_frame_waits_for_the_compiler():
    script = textwrap.dedent('''
        import sys
        from numba.core.dispatcher import Dispatcher
        from kfvo_ros.backbones.geometric import bundle_adjustment, kernels
        from kfvo_ros.backbones.geometric.backbone import GeometricBackbone
        from kfvo_ros.keyframes.heuristics import Every
        from kfvo_ros.odometry import KeyframeOdometry
        from kfvo_ros.sequences.synthetic import SyntheticSequence

        def signatures():
            return {name: len(kernel.signatures) for module in (bundle_adjustment, kernels)
                    for name, kernel in vars(module).items()
                    if isinstance(kernel, Dispatcher) and not name.startswith('_')}

        backbone = GeometricBackbone()
        before = signatures()
        odometry = KeyframeOdometry(backbone, Every())
        statuses = [odometry.process(frame).status.value
                    for frame in SyntheticSequence(0, 'fast', 14, 320, 240)]
        assert statuses[-1] == 'ok', statuses
        print(before, signatures())
        sys.exit(not before or max(before.values()) != 1 or signatures() != before)
    ''')
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize('count', range(1, 12))
def test_median_is_that_of_numpy(count):
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=count), rng.integers(0, 4, count).astype(np.float64)):
        before = values.copy()
        assert kernels.median(values) == np.median(values)
        assert np.array_equal(values, before)


def test_nearest_known_points_tell_the_median():
    rng = np.random.default_rng(2)
    places, known, values = rng.random((9, 2)), rng.random((40, 2)), rng.random(40)
    distances = np.linalg.norm(places[:, None] - known, axis=2)
    expected = np.median(values[np.argsort(distances, axis=1)[:, :5]], axis=1)
    assert np.array_equal(kernels.medians_of_nearest(places, known, values, 5), expected)

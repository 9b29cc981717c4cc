# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test bundle adjustment against finite differences, dense algebra and the true state."""

from __future__ import annotations

import numpy as np
import pytest

from kfvo_ros import geometry
from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import reprojection, schur, triangulation
from kfvo_ros.backbones.geometric.reprojection import Problem, State

FRAMES, POINTS, FOCAL, WIDTH = 6, 120, 400.0, 2.0


def positions(problem: Problem, state: State) -> np.ndarray:
    """Return positions (P, 3) of the points."""
    x, y, r = state.points
    local = np.stack([x / r, y / r, 1.0 / r, np.ones(POINTS)], axis=1)
    return np.einsum('pij,pj->pi', problem.origins[problem.hosts], local)[:, :3]


def project(problem: Problem, state: State) -> np.ndarray:
    """Return image points (F, 2, P) of all points in all frames, by the definition."""
    T_frame_w = geometry.invert(geometry.make_transform(state.rotations, state.translations))
    points = np.einsum('fij,pj->fip', T_frame_w[:, :3, :3], positions(problem, state))
    points += T_frame_w[:, :3, 3:]
    return points[:, :2] / points[:, 2:]


def window(seed: int = 0, noise: float = 0.0, fixed: int = 1,
           prior: float = 0.0) -> tuple[Problem, State]:
    """Return a problem with gaps in its tracks and `noise` [px], and its true state."""
    rng = np.random.default_rng(seed)
    rotations = geometry.exp_so3(0.05 * rng.normal(size=(FRAMES, 3)))
    translations = 0.3 * rng.normal(size=(FRAMES, 3))
    rotations[0], translations[0] = np.eye(3), 0.0
    origins = geometry.make_transform(
        rotations @ geometry.exp_so3(0.02 * rng.normal(size=(FRAMES, 3))),
        translations + 0.05 * rng.normal(size=(FRAMES, 3)))
    hosts = rng.integers(0, 3, POINTS)
    points = np.stack([*rng.uniform(-0.5, 0.5, (2, POINTS)), 1.0 / rng.uniform(2.0, 6.0, POINTS)])
    state = State(rotations, translations, points)
    mask = rng.random((FRAMES, POINTS)) < 0.7
    mask[hosts, np.arange(POINTS)] = True
    mask &= np.arange(FRAMES)[:, None] >= hosts
    mask[-1] = True
    weights, values = np.full(POINTS, prior), points[2] * rng.uniform(0.8, 1.2, POINTS)
    certainty = rng.uniform(0.3, 1.0, POINTS)
    problem = Problem(hosts, origins, np.zeros((FRAMES, 2, POINTS)), mask, FOCAL, fixed,
                      certainty, weights, values, WIDTH)
    image_points = project(problem, state)
    image_points += noise / FOCAL * rng.normal(size=image_points.shape)
    return problem._replace(image_points=image_points), state


def disturbed(problem: Problem, state: State, size: float = 1.0) -> State:
    """Return the state with errors in all unknowns."""
    rng = np.random.default_rng(9)
    step = size * rng.normal(size=(FRAMES - problem.fixed, 6)) * np.repeat([0.01, 0.05], 3)
    points = size * rng.normal(size=(3, POINTS)) * [[2e-3], [2e-3], [0.1]]
    points[2] *= state.points[2]
    return ba.retract(state, step.ravel(), points)


def half_gradient(problem: Problem, state: State) -> np.ndarray:
    normal = ba.linearise(problem, state, False, np.float64)
    return np.concatenate([normal.g_c, normal.g_p.ravel()])


def dense(normal: ba.NormalEquations) -> np.ndarray:
    """Return the dense Hessian: poses, then x, y and inverse depths of points."""
    xx, yx, yy, rx, ry, rr = map(np.diag, normal.H_pp)
    H_pp = np.block([[xx, yx, rx], [yx, yy, ry], [rx, ry, rr]])
    H_cp = normal.H_cp.reshape(len(normal.g_c), -1)
    return np.block([[normal.H_cc, H_cp], [H_cp.T, H_pp]])


def perturbed(problem: Problem, state: State, index: int, by: float) -> State:
    """Return the state after a step `by` of one unknown: poses first, then points."""
    size = 6 * (FRAMES - problem.fixed)
    step = np.zeros(size + 3 * POINTS)
    step[index] = by
    return ba.retract(state, step[:size], step[size:].reshape(3, POINTS))


@pytest.mark.parametrize(('fixed', 'width'), [(1, 2.0), (3, 2.0), (1, 0.5)])
def test_gradient_is_that_of_half_the_cost(fixed, width):
    problem, truth = window(noise=1.0, fixed=fixed, prior=30.0)
    problem = problem._replace(width=width)
    state = disturbed(problem, truth, 0.2)
    gradient, eps = half_gradient(problem, state), 1e-6
    numeric = np.array([
        (reprojection.cost(problem, perturbed(problem, state, index, eps))
         - reprojection.cost(problem, perturbed(problem, state, index, -eps))) / (4.0 * eps)
        for index in range(len(gradient))])
    assert np.abs(gradient).min() > 0.0
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())


def test_hessian_is_the_derivative_of_the_gradient_where_residuals_vanish():
    problem, state = window(fixed=2, prior=30.0)
    normal, eps = ba.linearise(problem, state, False, np.float64), 1e-6
    size, H = len(normal.g_c), dense(normal)
    indices = [*range(size), *range(size, size + 3 * POINTS, 7)]
    numeric = np.array([
        (half_gradient(problem, perturbed(problem, state, index, eps))
         - half_gradient(problem, perturbed(problem, state, index, -eps))) / (2.0 * eps)
        for index in indices])
    np.testing.assert_allclose(H[indices], numeric, rtol=1e-4, atol=1e-6 * np.abs(H).max())


@pytest.mark.parametrize('damping', [1e-4, 1.0])
@pytest.mark.parametrize(('precision', 'rtol', 'atol'),
                         [(np.float64, 1e-5, 1e-9), (np.float32, 1e-3, 1e-6)])
def test_schur_step_is_the_dense_step(damping, precision, rtol, atol):
    problem, truth = window(noise=1.0, prior=3.0)
    state = disturbed(problem, truth)
    H = dense(ba.linearise(problem, state, False, np.float64))
    H[np.diag_indices(len(H))] *= 1.0 + damping
    normal = ba.linearise(problem, state, False, precision)
    assert normal.H_cp.dtype == precision
    found = np.concatenate([part.ravel() for part in schur.solve_step(normal, damping)])
    np.testing.assert_allclose(found, -np.linalg.solve(H, half_gradient(problem, state)),
                               rtol=rtol, atol=atol)


def test_marginalised_system_matches_the_dense_one():
    problem, truth = window(noise=1.0, prior=3.0)
    normal = ba.linearise(problem, truth, False, np.float64)
    size, inverse = len(normal.g_c), np.linalg.inv(dense(normal))
    system, gradient = schur.marginalise_points(normal)
    np.testing.assert_allclose(np.linalg.inv(system), inverse[:size, :size], rtol=1e-4)
    np.testing.assert_allclose(np.linalg.solve(system, gradient),
                               (inverse @ half_gradient(problem, truth))[:size], rtol=1e-4)


def test_depth_information_marginalises_the_ray():
    problem, truth = window(noise=1.0, prior=3.0)
    normal = ba.linearise(problem, truth, False, np.float64)
    variances = np.linalg.inv(dense(normal)[len(normal.g_c):, len(normal.g_c):]).diagonal()
    given_poses = ba.linearise(problem._replace(fixed=FRAMES), truth, False, np.float64)
    assert not given_poses.H_cc.size
    np.testing.assert_allclose(schur.depth_information(given_poses), 1.0 / variances[2 * POINTS:],
                               rtol=1e-5)


def test_exact_window_is_recovered_up_to_scale():
    problem, truth = window()
    found = ba.adjust(problem, disturbed(problem, truth), 60)
    scale = np.linalg.norm(truth.translations) / np.linalg.norm(found.translations)
    np.testing.assert_allclose(found.rotations, truth.rotations, atol=1e-6)
    np.testing.assert_allclose(scale * found.translations, truth.translations, atol=1e-5)
    np.testing.assert_allclose(scale * positions(problem, found), positions(problem, truth),
                               atol=1e-3)


def test_fixed_frames_hold_the_scale_and_never_move():
    problem, truth = window(fixed=3)
    start = disturbed(problem, truth)
    found = ba.adjust(problem, start, 60)
    assert np.array_equal(found.rotations[:3], truth.rotations[:3])
    assert np.array_equal(found.translations[:3], truth.translations[:3])
    assert not np.allclose(start.translations[3:], truth.translations[3:], atol=1e-3)
    np.testing.assert_allclose(found.translations, truth.translations, atol=1e-5)
    np.testing.assert_allclose(found.points, truth.points, rtol=1e-4, atol=1e-6)


def test_cost_never_rises_with_more_iterations():
    problem, truth = window(noise=0.1, prior=1.0)
    start = disturbed(problem, truth, 2.0)
    costs = [reprojection.cost(problem, ba.adjust(problem, start, count)) for count in range(8)]
    assert costs[0] == reprojection.cost(problem, start)
    assert all(after <= before for before, after in zip(costs, costs[1:]))
    assert costs[-1] < 0.01 * costs[0]


def test_few_outliers_do_not_pull_the_poses():
    problem, truth = window(noise=0.2, fixed=3)
    wrong = problem.image_points.copy()
    wrong[-1, :, ::12] += 30.0 / FOCAL
    found = ba.adjust(problem._replace(image_points=wrong), disturbed(problem, truth, 0.3), 30)
    errors = np.linalg.norm(found.translations - truth.translations, axis=1)
    assert errors.max() < 0.01  # the scene is 2 to 6 away


def test_prior_determines_unobserved_depths():
    problem, truth = window(prior=1.0)
    unobserved = problem._replace(mask=np.zeros_like(problem.mask))
    found = ba.adjust(unobserved, truth, 20)
    np.testing.assert_allclose(found.points[2], problem.prior_values, rtol=1e-3)
    assert np.array_equal(found.translations, truth.translations)


def test_points_behind_a_camera_have_an_error_and_no_gradient():
    problem, state = window()
    turned = state.rotations.copy()
    turned[-1] = geometry.exp_so3(np.array([0.0, np.pi, 0.0]))
    behind = State(turned, state.translations, state.points)
    errors = reprojection.errors(problem, behind)
    assert (errors[-1] == reprojection.BEHIND_ERROR).all()
    normal = ba.linearise(problem, behind, False, np.float64)
    assert np.isfinite(normal.H_cc).all()
    assert not normal.g_c[-6:].any()


def test_errors_are_weighted_reprojection_errors():
    problem, state = window(noise=1.0)
    errors = reprojection.errors(problem, state)
    assert not errors[~problem.mask].any()
    shift = np.linalg.norm(project(problem, state) - problem.image_points, axis=1)
    expected = problem.certainty * FOCAL * shift
    np.testing.assert_allclose(errors[problem.mask], expected[problem.mask], rtol=1e-9)


def test_uncertain_points_have_less_weight():
    """A quarter of the points slides sideways as if the camera moved."""
    problem, truth = window(fixed=FRAMES - 1)
    sliding = np.arange(POINTS) % 4 == 0
    image_points = problem.image_points.copy()
    image_points[-1, 0, sliding] += 1.0 / FOCAL
    certainty = np.where(sliding, 0.1, 1.0)
    errors = []
    for each in (np.ones(POINTS), certainty):
        found = ba.adjust(problem._replace(image_points=image_points, certainty=each), truth, 20)
        errors.append(np.linalg.norm(found.translations[-1] - truth.translations[-1]))
    assert errors[1] < 0.1 * errors[0]


@pytest.mark.parametrize('unobserving', (0, 2, FRAMES - 1))
def test_frame_without_observations_stays(unobserving):
    problem, truth = window(noise=0.3, fixed=1)
    problem.mask[unobserving] = False
    normal, pose = ba.linearise(problem, truth, True, np.float64), 6 * (unobserving - 1)
    assert not reprojection.errors(problem, truth)[unobserving].any()
    if unobserving > 0:
        assert not normal.H_cc[pose:pose + 6].any() and not normal.H_cp[pose:pose + 6].any()
    found = ba.adjust(problem, truth, 3)
    assert reprojection.cost(problem, found) < reprojection.cost(problem, truth)
    assert np.array_equal(found.rotations[unobserving], truth.rotations[unobserving])
    assert np.array_equal(found.translations[unobserving], truth.translations[unobserving])


def test_host_observation_has_the_weight_of_any_other():
    """With rays fixed to the host's observation its noise would look like parallax of one sign.

    Nothing moves, so depths are unobserved and held by priors.
    """
    problem, truth = window(fixed=FRAMES - 1, prior=100.0)
    still = State(np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)), truth.points)
    problem = problem._replace(origins=np.tile(np.eye(4), (FRAMES, 1, 1)), width=100.0,
                               hosts=np.zeros(POINTS, dtype=np.int64),
                               mask=np.ones_like(problem.mask), certainty=np.ones(POINTS))
    noise = np.random.default_rng(3).choice([-1.0, 1.0], (2, POINTS)) / FOCAL
    image_points = project(problem, still)
    image_points[0] += noise
    found = ba.adjust(problem._replace(image_points=image_points), still, 20)
    np.testing.assert_allclose(found.points[:2] - truth.points[:2], noise / FRAMES, rtol=0.15)


def test_narrow_loss_rejects_slightly_sliding_tracks():
    problem, truth = window(noise=0.05, fixed=3)
    problem.image_points[-1, :, ::3] += 1.5 / FOCAL
    errors = []
    for width in (2.0, 0.5):
        found = ba.adjust(problem._replace(width=width), truth, 30)
        errors.append(np.linalg.norm(found.translations[-1] - truth.translations[-1]))
    assert errors[1] < 0.5 * errors[0]


def test_intrinsics_gradient_is_that_of_half_the_cost():
    problem, truth = window(noise=0.3, prior=3.0)
    normal, poses = ba.linearise(problem, truth, True, np.float64), 6 * (FRAMES - 1)
    plain = ba.linearise(problem, truth, False, np.float64)
    assert np.array_equal(normal.H_cc[:poses, :poses], plain.H_cc)
    assert np.array_equal(normal.g_p, plain.g_p)
    points, eps = project(problem, truth), 1e-6
    for row, shares in enumerate([1.0, (points ** 2).sum(axis=1, keepdims=True)]):
        # Points farther off the axis by a share equal tracks nearer to it by that share.
        at = [problem._replace(image_points=problem.image_points - sign * eps * shares * points)
              for sign in (1.0, -1.0)]
        slope = (reprojection.cost(at[0], truth)
                 - reprojection.cost(at[1], truth)) / (4.0 * eps)
        assert normal.g_c[poses + row] == pytest.approx(slope, rel=1e-5, abs=1e-3)


def test_triangulation_is_exact_and_has_no_weight_without_parallax():
    problem, state = window()
    problem = problem._replace(
        origins=geometry.make_transform(state.rotations, state.translations))
    image_points = np.ascontiguousarray(project(problem, state).transpose(2, 0, 1))
    rays = np.stack([*state.points[:2], np.ones(POINTS)], axis=1)
    arguments = problem.hosts, rays, image_points, np.ascontiguousarray(problem.mask.T)
    inverse_depths, weights = triangulation.triangulate(state.rotations, state.translations,
                                                        *arguments)
    np.testing.assert_allclose(inverse_depths, state.points[2], rtol=1e-9)
    assert (weights > 0.0).all()
    _, weights = triangulation.triangulate(state.rotations, np.zeros_like(state.translations),
                                           *arguments)
    assert not weights.any()

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled loops around the bundle adjustment: what goes into a window, what comes out of it.

Arrays are those of `Observations`: hosts (P,), rays (P, 3), seen (P, F, 2), mask (P, F).
"""

from __future__ import annotations

import math

import numpy as np

from kfvo_ros.backbones.geometric import bundle_adjustment as ba
from kfvo_ros.backbones.geometric import reprojection, schur
from kfvo_ros.backbones.geometric.compilation import compiled
from kfvo_ros.backbones.geometric.medians import median, median_where
from kfvo_ros.backbones.geometric.problem import Problem, State

END = np.iinfo(np.int64).max
"""No track has this id."""


@compiled
def straighten(points, errors):
    """Return where points (N, 2) lie through a lens with these errors (ba.LENS,), see `Lens`."""
    straight = np.empty(points.shape)
    for k in range(len(points)):
        x, y = points[k]
        r2 = min(x * x + y * y, ba.WIDE_ANGLE)
        longer = 1.0 + errors[0] + errors[1] * r2 + errors[2] * r2 * r2
        straight[k, 0], straight[k, 1] = (x - errors[3]) / longer, (y - errors[4]) / longer
    return straight


@compiled
def merge(ids, points, doubts, ends, first_moving):
    """Return the tracks (ids, seen, mask, hosts, doubts) that two views see, one of them moving.

    `ids` (N,), `points` (N, 2) and `doubts` (N,) are those of all views, one after the other; each
    view's ids increase, and end before `ends` (F,). Views from `first_moving` on move. Of doubts
    the last one counts.
    """
    frames, count = len(ends), 0
    heads = np.zeros(frames, dtype=np.int64)
    for frame in range(1, frames):
        heads[frame] = ends[frame - 1]
    merged = np.empty(len(ids) // 2, dtype=np.int64)
    seen = np.empty((len(merged), frames, 2))
    mask = np.empty((len(merged), frames), dtype=np.bool_)
    hosts, doubted = np.empty(len(merged), dtype=np.int64), np.empty(len(merged))
    while True:
        lowest, views, first, last = END, 0, -1, -1
        for frame in range(frames):
            head = heads[frame]
            if head < ends[frame] and ids[head] <= lowest:
                if ids[head] < lowest:
                    lowest, views, first = ids[head], 0, frame
                views, last = views + 1, frame
        if views == 0:
            return merged[:count], seen[:count], mask[:count], hosts[:count], doubted[:count]
        wanted = views >= 2 and last >= first_moving
        if wanted:
            merged[count], hosts[count], doubted[count] = lowest, first, doubts[heads[last]]
        for frame in range(frames):
            head = heads[frame]
            sees = head < ends[frame] and ids[head] == lowest
            heads[frame] += sees
            if wanted:
                mask[count, frame] = sees
                seen[count, frame, 0] = points[head, 0] if sees else 0.0
                seen[count, frame, 1] = points[head, 1] if sees else 0.0
        count += wanted


@compiled
def _rotate(R, v0, v1, v2):
    return (R[0, 0] * v0 + R[0, 1] * v1 + R[0, 2] * v2,
            R[1, 0] * v0 + R[1, 1] * v1 + R[1, 2] * v2,
            R[2, 0] * v0 + R[2, 1] * v1 + R[2, 2] * v2)


@compiled
def _rotate_back(R, v0, v1, v2):
    return (R[0, 0] * v0 + R[1, 0] * v1 + R[2, 0] * v2,
            R[0, 1] * v0 + R[1, 1] * v1 + R[2, 1] * v2,
            R[0, 2] * v0 + R[1, 2] * v1 + R[2, 2] * v2)


@compiled
def triangulate(rotations, translations, hosts, rays, seen, mask):
    """Return closed-form inverse depths (P,) and their parallax weights (P,).

    Minimises the algebraic error over all observations outside the host; the weight is the sum
    of squared shifts of the image point per unit of inverse depth, zero where nothing is learnt.
    """
    points, frames = mask.shape
    inverse_depths, weights = np.zeros(points), np.zeros(points)
    for k in range(points):
        h = hosts[k]
        ray = _rotate(rotations[h], rays[k, 0], rays[k, 1], rays[k, 2])
        numerator = 0.0
        for j in range(frames):
            if not mask[k, j] or j == h:
                continue
            a = _rotate_back(rotations[j], ray[0], ray[1], ray[2])
            c = _rotate_back(rotations[j], translations[h, 0] - translations[j, 0],
                             translations[h, 1] - translations[j, 1],
                             translations[h, 2] - translations[j, 2])
            for axis in range(2):
                slope = c[axis] - seen[k, j, axis] * c[2]
                numerator += slope * (seen[k, j, axis] * a[2] - a[axis])
                weights[k] += slope * slope
        if weights[k] > 0.0:
            inverse_depths[k] = numerator / weights[k]
    return inverse_depths, weights


@compiled
def place(rotations, translations, hosts, rays, inverse_depths):
    """Return positions (P, 3) of points in the frame that the hosts' poses are in."""
    positions = np.empty((len(hosts), 3))
    for k in range(len(hosts)):
        x, y, z = _rotate(rotations[hosts[k]], rays[k, 0], rays[k, 1], rays[k, 2])
        positions[k, 0] = x / inverse_depths[k] + translations[hosts[k], 0]
        positions[k, 1] = y / inverse_depths[k] + translations[hosts[k], 1]
        positions[k, 2] = z / inverse_depths[k] + translations[hosts[k], 2]
    return positions


@compiled
def count_shared(a, b):
    """Return how many numbers are both in `a` and in `b`, both increasing."""
    i, j, count = 0, 0, 0
    while i < len(a) and j < len(b):
        count += a[i] == b[j]
        i, j = i + (a[i] <= b[j]), j + (a[i] >= b[j])
    return count


@compiled
def _unit_ray(seen):
    length = math.sqrt(seen[0] * seen[0] + seen[1] * seen[1] + 1.0)
    return seen[0] / length, seen[1] / length, 1.0 / length


@compiled
def correlate(seen, mask, first):
    """Return sums (F - 1 - first, 3, 3) of ray_newest ray_frame^T of common tracks, unit rays.

    One for each frame from `first` on but the newest.
    """
    points, frames = mask.shape
    sums = np.zeros((frames - 1 - first, 3, 3))
    for k in range(points):
        if mask[k, -1]:
            newest = _unit_ray(seen[k, -1])
            for frame in range(first, frames - 1):
                if mask[k, frame]:
                    ray = _unit_ray(seen[k, frame])
                    for a in range(3):
                        for b in range(3):
                            sums[frame - first, a, b] += newest[a] * ray[b]
    return sums


@compiled
def median_shifts(seen, mask, first, rotations):
    """Return medians (F - 1 - first,) of |ray_newest - rotation ray_frame| of common tracks.

    One for each frame from `first` on but the newest; 0 without common tracks.
    """
    points, frames = mask.shape
    medians, shifts = np.zeros(frames - 1 - first), np.zeros(points)
    for frame in range(first, frames - 1):
        count = 0
        for k in range(points):
            if mask[k, -1] and mask[k, frame]:
                newest, ray = _unit_ray(seen[k, -1]), _unit_ray(seen[k, frame])
                x, y, z = _rotate(rotations[frame - first], ray[0], ray[1], ray[2])
                shifts[count] = math.sqrt((newest[0] - x) ** 2 + (newest[1] - y) ** 2
                                          + (newest[2] - z) ** 2)
                count += 1
        if count > 0:
            medians[frame - first] = median(shifts[:count])
    return medians


@compiled
def medians_of_nearest(places, known_places, known_values, neighbours):
    """Return medians (N,) of the values of the known points nearest to each place (N, 2)."""
    medians = np.zeros(len(places))
    distances, nearest = np.zeros(neighbours), np.zeros(neighbours)
    for n in range(len(places)):
        distances[:] = np.inf
        for k in range(len(known_values)):
            x, y = known_places[k, 0] - places[n, 0], known_places[k, 1] - places[n, 1]
            distance, value = x * x + y * y, known_values[k]
            if distance >= distances[-1]:
                continue
            for rank in range(neighbours):
                if distance < distances[rank]:
                    distance, distances[rank] = distances[rank], distance
                    value, nearest[rank] = nearest[rank], value
        medians[n] = median(nearest)
    return medians


def load() -> None:
    """Compile everything, or load it from the cache, before a frame would wait for it."""
    rotations, translations, ones = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.ones(1)
    points = straighten(np.zeros((2, 2)), np.zeros(ba.LENS))
    ids, seen, mask, hosts, _ = merge(np.zeros(2, dtype=np.int64), points, np.zeros(2),
                                      np.array([1, 2]), 1)
    rays = np.ones((1, 3))
    triangulate(rotations, translations, hosts, rays, seen, mask)
    place(rotations, translations, hosts, rays, ones)
    median_shifts(seen, mask, 0, correlate(seen, mask, 0))
    medians_of_nearest(seen[:, 0].copy(), seen[:, 1].copy(), ones, 1)
    median(ones)
    median_where(np.ones((1, 1)), mask[:, :1])
    count_shared(ids, ids)
    problem = Problem(hosts, np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 2, 1)),
                      np.ones((2, 1), dtype=np.bool_), 1.0, 1, ones, ones, ones, 1.0)
    state = ba.adjust(problem, State(rotations, translations, np.ones((3, 1))), 1)
    reprojection.errors(problem, state)
    reprojection.cost(problem, state)
    schur.reduce(ba.linearise(problem, state, True, np.float64))
    schur.depth_information(ba.linearise(problem, state, False, np.float64))

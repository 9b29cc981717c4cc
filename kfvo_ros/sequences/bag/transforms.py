# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform tree of a bag: fixed transforms and moving edges."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from kfvo_ros import geometry
from kfvo_ros.sequences.bag.reader import TRANSFORMS, Bag
from kfvo_ros.sequences.base import FixedTransform

Edge = tuple[str, str]
"""(parent, child)."""
STILL = 1e-9
"""Largest change of a fixed transform's numbers, on any topic."""


class TransformTree:
    """Fixed transforms between frames, and the edges that move.

    Frame names have no leading slash, which ROS 1 allowed. A transform that is published
    repeatedly without a change is fixed too, which was the practice before /tf_static. The open
    bag is read at the first query.
    """

    def __init__(self, bag: Bag) -> None:
        self._bag = bag

    @property
    def moving(self) -> list[Edge]:
        """Edges that move, sorted."""
        return sorted(self._edges[1])

    def lookup(self, target: str, source: str) -> np.ndarray | None:
        """Return the fixed T_target_source (4, 4), None where no chain connects the frames."""
        T_x_target, T_x_source = self._ancestors(target), self._ancestors(source)
        for common in T_x_target:
            if common in T_x_source:
                return geometry.relative(T_x_target[common], T_x_source[common])
        return None

    def parents(self, frame: str) -> list[FixedTransform]:
        """Return the chain of fixed transforms from a frame up to its root, nearest first."""
        chain: list[FixedTransform] = []
        seen = {frame}
        while frame in self._parents:
            parent, T_parent_child = self._parents[frame]
            if parent in seen:  # a loop, only in a broken recording
                break
            chain.append(FixedTransform(parent, frame, T_parent_child))
            seen.add(parent)
            frame = parent
        return chain

    @cached_property
    def _edges(self) -> tuple[dict[Edge, np.ndarray], set[Edge]]:
        """Return the first value of every edge, and the edges whose values change."""
        first: dict[Edge, np.ndarray] = {}
        moving: set[Edge] = set()
        for topic in self._bag.topics_of_type(*TRANSFORMS):
            for _, message in self._bag.messages(topic):
                for transform in message.transforms:
                    edge, values = transform_edge(transform), _values(transform.transform)
                    if not (np.isfinite(values).all() and values[3:].any()):
                        continue
                    if np.abs(first.setdefault(edge, values) - values).max() > STILL:
                        moving.add(edge)
        return first, moving

    @cached_property
    def _parents(self) -> dict[str, tuple[str, np.ndarray]]:
        """Return child -> (parent, T_parent_child) of the fixed edges."""
        first, moving = self._edges
        return {child: (parent, geometry.transform_from_xyz_quat(values))
                for (parent, child), values in first.items() if (parent, child) not in moving}

    def _ancestors(self, frame: str) -> dict[str, np.ndarray]:
        """Return T_ancestor_frame by ancestor, nearest first, starting with the frame itself."""
        T_ancestor_frame = {frame: np.eye(4)}
        for fixed in self.parents(frame):
            T_ancestor_frame[fixed.parent] = fixed.T_parent_child @ T_ancestor_frame[fixed.child]
        return T_ancestor_frame


def transform_edge(transform: Any) -> Edge:
    """Return the edge of a geometry_msgs/TransformStamped."""
    return transform.header.frame_id.lstrip('/'), transform.child_frame_id.lstrip('/')


def _values(transform: Any) -> np.ndarray:
    """Return (tx, ty, tz, qx, qy, qz, qw) of a geometry_msgs/Transform."""
    t, q = transform.translation, transform.rotation
    return np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])

# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counters, rates and latencies of the node, and their message on /diagnostics."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from kfvo_ros.backbones.base import Status
from kfvo_ros.utils.process import rss_mb

IMAGE_TIMEOUT_S = 5.0
"""Time without an image after which the level is WARN."""
RATE_FRAMES, LATENCY_FRAMES = 100, 1000
"""Number of latest frames behind a rate and behind a latency percentile."""


class Diagnostics:
    """Counters of one node; every method may be called from any thread.

    ``lost_in_transit`` counts images lost before the node received them, ``frames_lost`` frames
    of status LOST. ``problem`` says why images are refused at present, or is empty; the next
    frame that gets a pose clears it.
    """

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.received = self.processed = self.keyframes = self.dropped = self.refused = 0
        self.lost_in_transit = self.frames_lost = self.resets = 0
        self.paused = False
        self.status: Status | None = None
        self.problem = ''
        self._intrinsics: np.ndarray | None = None
        self._arrivals: deque[float] = deque(maxlen=RATE_FRAMES)
        self._departures: deque[float] = deque(maxlen=RATE_FRAMES)
        self._latencies: deque[float] = deque(maxlen=LATENCY_FRAMES)

    def record_image(self) -> float:
        """Count an image and return its time of arrival [s, monotonic]."""
        now = time.monotonic()
        self.received += 1
        self._arrivals.append(now)
        return now

    def record_pose(self, arrival: float, status: Status, is_keyframe: bool,
                    intrinsics: np.ndarray | None = None) -> None:
        """Count a frame at the publication of its pose.

        `arrival` is the image's [s, monotonic]; `intrinsics` are K (3, 3) [px] where the backbone
        estimates them.
        """
        now = time.monotonic()
        self.processed += 1
        self.keyframes += is_keyframe
        self.frames_lost += status is Status.LOST
        self.status, self.problem = status, ''
        self._intrinsics = intrinsics
        self._departures.append(now)
        self._latencies.append(now - arrival)

    @property
    def seconds_without_image(self) -> float:
        """Seconds since the last image, or since the start."""
        return time.monotonic() - (self._arrivals[-1] if self._arrivals else self.started)

    def latency_ms(self, percentile: float) -> float:
        """Return a percentile of the times from an image's arrival to its pose [ms]."""
        latencies = list(self._latencies)
        return 1e3 * float(np.percentile(latencies, percentile)) if latencies else 0.0

    def message(self, header: Header, name: str, hardware_id: str,
                constants: dict[str, str]) -> DiagnosticArray:
        """Return the present state; `constants` are further values to show."""
        level, summary = self._summary(hardware_id)
        values = {
            'state': 'paused' if self.paused else self.status.value if self.status else 'waiting',
            'input rate [Hz]': f'{_rate(self._arrivals):.1f}',
            'output rate [Hz]': f'{_rate(self._departures):.1f}',
            'latency median [ms]': f'{self.latency_ms(50):.1f}',
            'latency 95 % [ms]': f'{self.latency_ms(95):.1f}',
            'images lost in transit': self.lost_in_transit,
            'images received': self.received, 'images processed': self.processed,
            'images dropped': self.dropped, 'images refused': self.refused,
            'keyframes': self.keyframes,
            'keyframe ratio': f'{self.keyframes / max(self.processed, 1):.3f}',
            'frames lost': self.frames_lost, 'resets': self.resets,
            'memory [MiB]': f'{rss_mb():.0f}', **constants}
        if self._intrinsics is not None:
            values['focal lengths as estimated [px]'] = \
                f'{self._intrinsics[0, 0]:.1f} {self._intrinsics[1, 1]:.1f}'
        status = DiagnosticStatus(
            level=level, name=name, message=summary, hardware_id=hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        return DiagnosticArray(header=header, status=[status])

    def _summary(self, topic: str) -> tuple[bytes, str]:
        """Return level and message."""
        if self.paused:
            return DiagnosticStatus.OK, 'paused'
        if self.seconds_without_image > IMAGE_TIMEOUT_S:
            return (DiagnosticStatus.WARN,
                    f'no image on {topic} for {self.seconds_without_image:.0f} s')
        if self.problem:
            return DiagnosticStatus.WARN, self.problem
        if self.status is Status.LOST:
            return DiagnosticStatus.WARN, 'lost'
        return DiagnosticStatus.OK, 'tracking' if self.status else 'waiting for the first image'


def _rate(times: deque[float]) -> float:
    """Return the events per second of `times` [s]; zero once no event has come for a while."""
    recent = list(times)
    if len(recent) < 2 or time.monotonic() - recent[-1] > IMAGE_TIMEOUT_S:
        return 0.0
    return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)

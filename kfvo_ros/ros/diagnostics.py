# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the node counts and times, and its message on /diagnostics."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from kfvo_ros.backbones.base import Status
from kfvo_ros.utils.process import rss_mb

SILENCE_S = 5.0
"""Without an image for so long, something is wrong."""
RECENT, RECENT_LATENCIES = 100, 1000
"""Rates and latencies are those of so many frames."""


class Diagnostics:
    """Counters of one node; every method may be called from any thread.

    ``missed`` images were lost before the node got them. ``problem`` is what keeps the node from
    working now, in words, or empty; it is cleared by the next frame that gets a pose.
    """

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.received = self.processed = self.keyframes = self.dropped = self.refused = 0
        self.missed = self.lost = self.resets = 0
        self.paused = False
        self.status: Status | None = None
        self.problem = ''
        self._intrinsics: np.ndarray | None = None
        self._arrivals: deque[float] = deque(maxlen=RECENT)
        self._departures: deque[float] = deque(maxlen=RECENT)
        self._latencies: deque[float] = deque(maxlen=RECENT_LATENCIES)

    def image(self) -> float:
        """Count an image and return its time of arrival [s, monotonic]."""
        now = time.monotonic()
        self.received += 1
        self._arrivals.append(now)
        return now

    def posed(self, arrival: float, status: Status, is_keyframe: bool,
              intrinsics: np.ndarray | None = None) -> None:
        """Count a frame whose pose has just been published, with K (3, 3) [px] if it was seen."""
        now = time.monotonic()
        self.processed += 1
        self.keyframes += is_keyframe
        self.lost += status is Status.LOST
        self.status, self.problem = status, ''
        self._intrinsics = intrinsics
        self._departures.append(now)
        self._latencies.append(now - arrival)

    @property
    def silence(self) -> float:
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
            'images lost in transit': self.missed,
            'images received': self.received, 'images processed': self.processed,
            'images dropped': self.dropped, 'images refused': self.refused,
            'keyframes': self.keyframes,
            'keyframe ratio': f'{self.keyframes / max(self.processed, 1):.3f}',
            'frames lost': self.lost, 'resets': self.resets,
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
        if self.silence > SILENCE_S:
            return DiagnosticStatus.WARN, f'no image on {topic} for {self.silence:.0f} s'
        if self.problem:
            return DiagnosticStatus.WARN, self.problem
        if self.status is Status.LOST:
            return DiagnosticStatus.WARN, 'lost'
        return DiagnosticStatus.OK, 'tracking' if self.status else 'waiting for the first image'


def _rate(times: deque[float]) -> float:
    """Return events per second over the last ones; zero once they have stopped."""
    recent = list(times)
    if len(recent) < 2 or time.monotonic() - recent[-1] > SILENCE_S:
        return 0.0
    return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)

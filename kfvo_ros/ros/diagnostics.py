# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counters, rates and latencies of the node, and their message on /diagnostics."""

from __future__ import annotations

import time
from collections import Counter, deque

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from kfvo_ros.backbones.base import Status
from kfvo_ros.errors import printable
from kfvo_ros.utils.process import rss_mb

IMAGE_TIMEOUT_S, SILENCE_S = 5.0, 30.0
"""Times without an image after which the level is WARN, and ERROR."""
REPEATED_RESETS, RESET_PERIOD_S = 3, 60.0
"""Number of resets within a period from which the level is WARN; requested ones do not count."""
RATE_FRAMES, LATENCY_FRAMES = 100, 1000
"""Number of latest frames behind a rate and behind a latency percentile."""


class Diagnostics:
    """Counters of one node; every method may be called from any thread.

    Of the ``received`` images ``processed`` count those whose pose was published, ``withheld``
    those whose pose was not, ``left_out`` those without a credible stamp, by kind; ``waiting``
    are not processed yet. ``lost_in_transit`` counts images lost before the node received them,
    ``frames_lost`` frames of status LOST.
    """

    def __init__(self) -> None:
        self.started = time.monotonic()
        self.received = self.processed = self.keyframes = self.dropped = self.refused = 0
        self.lost_in_transit = self.frames_lost = self.resets = self.withheld = 0
        self.left_out: Counter[str] = Counter()
        self.waiting = 0
        self.paused = False
        self.status: Status | None = None
        self._problems: dict[str, str] = {}
        self._reset_times: deque[float] = deque(maxlen=REPEATED_RESETS)
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
        """Count a frame at the publication of its pose: images and frames are as they should be.

        `arrival` is the image's [s, monotonic]; `intrinsics` are K (3, 3) [px] where the backbone
        estimates them.
        """
        now = time.monotonic()
        self.processed += 1
        self.keyframes += is_keyframe
        self.frames_lost += status is Status.LOST
        self.status = status
        self._problems |= {'images': '', 'frames': ''}
        self._intrinsics = intrinsics
        self._departures.append(now)
        self._latencies.append(now - arrival)

    def record_withheld(self, status: Status, reason: str) -> None:
        """Count a frame whose pose could not be published."""
        self.withheld += 1
        self.frames_lost += status is Status.LOST
        self._problems |= {'images': '', 'frames': reason}

    def record_refusal(self, reason: str) -> None:
        """Count an image that is no image, or without calibration."""
        self.refused += 1
        self.set_problem('images', reason)

    def record_reset(self, requested: bool) -> None:
        """Count the end of a segment."""
        self.resets += 1
        if not requested:
            self._reset_times.append(time.monotonic())

    def set_problem(self, kind: str, text: str) -> None:
        """Set the problem of a kind that makes the level WARN; an empty text ends it."""
        self._problems[kind] = text

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
            'images waiting': self.waiting, 'images dropped': self.dropped,
            'images refused': self.refused,
            'images late': self.left_out['late'],
            'images with an odd stamp': self.left_out['odd_stamp'],
            'poses withheld': self.withheld,
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
        silence_s = self.seconds_without_image
        problems = [f'no image on {topic} for {silence_s:.0f} s'] \
            if silence_s > IMAGE_TIMEOUT_S else []
        problems += filter(None, list(self._problems.values()))
        if self.status is Status.LOST:
            problems.append('lost')
        if self.resets_repeat:
            problems.append(f'{REPEATED_RESETS} resets within {RESET_PERIOD_S:.0f} s')
        if problems:
            return (DiagnosticStatus.ERROR if silence_s > SILENCE_S else DiagnosticStatus.WARN,
                    printable('; '.join(problems)))
        return DiagnosticStatus.OK, 'tracking' if self.status else 'waiting for the first image'

    @property
    def resets_repeat(self) -> bool:
        """Whether there were several resets within a short time."""
        return (len(self._reset_times) == REPEATED_RESETS
                and time.monotonic() - self._reset_times[0] < RESET_PERIOD_S)


def _rate(times: deque[float]) -> float:
    """Return the events per second of `times` [s]; zero once no event has come for a while."""
    recent = list(times)
    if len(recent) < 2 or time.monotonic() - recent[-1] > IMAGE_TIMEOUT_S:
        return 0.0
    return (len(recent) - 1) / max(recent[-1] - recent[0], 1e-9)

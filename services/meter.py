"""Counts the frames of a process: rate and latency, lately and over the whole run."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.messages import Latency
from suturetrack.types import Float64, Stamp

_SHORTEST_MS, _LONGEST_MS = 0.01, 1e7
_BINS_A_DECADE = 230
"""Latencies of a whole run are told within half a percent."""


@dataclass(frozen=True)
class Figures:
    """Of some frames."""

    frames: int
    rate_hz: float
    latency: Latency


class Meter:
    """Rate and latency of the frames that a process finishes; safe to read from another thread."""

    def __init__(self) -> None:
        self.last: Stamp | None = None
        """Of the last frame."""
        self.skipped = 0
        """Frames that the process itself left out."""
        self._lock = threading.Lock()
        self._counts = np.zeros(_bin(_LONGEST_MS) + 1, np.int64)
        self._longest_ms = 0.0
        self._recent_ms: list[float] = []
        self._frames = 0
        self._first_ns = self._last_ns = 0
        self._since_ns = time.time_ns()

    def count(self, stamp: Stamp, now_ns: int) -> None:
        """A frame was finished."""
        latency_ms = (now_ns - stamp.released_ns) / 1e6
        with self._lock:
            self._first_ns = self._first_ns or now_ns
            self._last_ns = now_ns
            self.last = stamp
            self._frames += 1
            self._counts[_bin(latency_ms)] += 1
            self._longest_ms = max(self._longest_ms, latency_ms)
            self._recent_ms.append(latency_ms)

    def whole(self) -> Figures:
        """Of all frames so far; percentiles within half a percent."""
        with self._lock:
            rate_hz = _rate(self._frames - 1, self._last_ns - self._first_ns)
            if not self._frames:
                return Figures(0, rate_hz, Latency())
            ranks = np.ceil(np.array([0.5, 0.99]) * self._frames)
            bins = np.searchsorted(np.cumsum(self._counts), ranks)
            p50, p99 = np.minimum(_middle_ms(bins), self._longest_ms)
            return Figures(self._frames, rate_hz, Latency(float(p50), float(p99), self._longest_ms))

    def window(self) -> Figures:
        """Of the frames since the last call."""
        with self._lock:
            recent, now = self._recent_ms, time.time_ns()
            rate_hz = _rate(len(recent), now - self._since_ns)
            self._recent_ms, self._since_ns = [], now
        if not recent:
            return Figures(0, rate_hz, Latency())
        p50, p99 = np.percentile(recent, (50, 99))
        return Figures(len(recent), rate_hz, Latency(float(p50), float(p99), max(recent)))


def _bin(latency_ms: float) -> int:
    """Bins grow with the latency; clocks that disagree can make it negative."""
    within = min(max(latency_ms, _SHORTEST_MS), _LONGEST_MS)
    return int(_BINS_A_DECADE * math.log10(within / _SHORTEST_MS))


def _middle_ms(bins: NDArray[np.int64]) -> Float64:
    return _SHORTEST_MS * 10 ** ((bins + 0.5) / _BINS_A_DECADE)


def _rate(count: int, duration_ns: int) -> float:
    return count * 1e9 / duration_ns if duration_ns > 0 else 0.0

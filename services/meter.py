"""Counts the frames of a process: rate and latency, lately and over the whole run."""

from __future__ import annotations

import threading
import time
from array import array
from dataclasses import dataclass

import numpy as np

from services.messages import Latency
from suturetrack.types import Stamp

_LONGEST = 1 << 20
"""Latencies kept: ten hours at 30 Hz."""


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
        self._ms = array("f")
        self._frames = 0
        self._first_ns = self._last_ns = 0
        self._window = (0, time.time_ns())

    def count(self, stamp: Stamp, now_ns: int) -> None:
        """A frame was finished."""
        with self._lock:
            self._first_ns = self._first_ns or now_ns
            self._last_ns = now_ns
            self.last = stamp
            self._frames += 1
            if len(self._ms) >= _LONGEST:
                del self._ms[: _LONGEST // 2]
            self._ms.append((now_ns - stamp.released_ns) / 1e6)

    def whole(self) -> Figures:
        """Of all frames so far."""
        with self._lock:
            rate_hz = _rate(self._frames - 1, self._last_ns - self._first_ns)
            return Figures(self._frames, rate_hz, _latency(self._ms))

    def window(self) -> Figures:
        """Of the frames since the last call."""
        with self._lock:
            counted, since = self._window
            frames, now = self._frames - counted, time.time_ns()
            self._window = (self._frames, now)
            recent = self._ms[len(self._ms) - frames :]
            return Figures(frames, _rate(frames, now - since), _latency(recent))


def _rate(count: int, duration_ns: int) -> float:
    return count * 1e9 / duration_ns if duration_ns > 0 else 0.0


def _latency(ms: array[float]) -> Latency:
    if not ms:
        return Latency()
    values = np.frombuffer(ms, np.float32)
    p50, p99 = np.percentile(values, (50, 99))
    return Latency(float(p50), float(p99), float(values.max()))

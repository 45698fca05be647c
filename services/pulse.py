"""Which processes hang, by their heartbeats: a process that hangs neither ends nor loses its token."""

from __future__ import annotations

import time
from dataclasses import dataclass

from services.messages import Health

_SILENT_S = 5.0
"""Without a heartbeat until a process counts as hung."""
_SILENT_AT_FIRST_S = 10.0
"""The same before its first heartbeat."""
_STILL = 10
"""Heartbeats, thus seconds, without a frame until a process counts as hung, while there are frames."""
_BEGINNING = 180
"""The same until a process is ready, unless it waits for another: kernels may have to be compiled."""
_PAUSE_S = 1.0
"""Between two looks until it was the one who looks that stood still."""
_FEEDS = {"segmenter": "source", "tracker": "segmenter"}
"""From which process each one's input comes."""


@dataclass
class _Beat:
    """What was heard of a process last."""

    health: Health
    at: float
    still: int = 0
    """Heartbeats since its last frame at which there would have been frames; at first, of beginning."""


class Pulse:
    """Judges the heartbeats of a run; to be looked at several times a second."""

    def __init__(self) -> None:
        self._beats: dict[str, _Beat] = {}
        self._awaited: dict[tuple[str, int], float] = {}
        """By process and number of starts: since when its first heartbeat is waited for."""
        self._looked = 0.0

    def hear(self, health: Health, now: float | None = None) -> None:
        """Takes in a heartbeat."""
        now = time.monotonic() if now is None else now
        name, last = health.process, self._beats.get(health.process)
        if last is None or (last.health.restarts, last.health.ready) != (
            health.restarts,
            health.ready,
        ):
            self._beats[name] = _Beat(health, now)
            return
        if not health.ready:
            self._beats[name] = _Beat(health, now, 0 if health.awaits else last.still + 1)
            return
        moved = _progress(health) != _progress(last.health)
        for other, feed in _FEEDS.items():
            if moved and feed == name and other in self._beats and self._beats[other].health.ready:
                self._beats[other].still += 1
        waits = name in _FEEDS or health.awaits or not health.stamp or not health.stamp.period_ns
        still = 0 if moved else last.still + (not waits)
        self._beats[name] = _Beat(health, now, still)

    def is_ready(self, process: str, starts: int) -> bool:
        """Whether a process that was started again so many times has been ready since."""
        beat = self._beats.get(process)
        return beat is not None and beat.health.restarts == starts and beat.health.ready

    def look(self, now: float | None = None) -> None:
        """Forgives everyone where the one who looks stood still itself."""
        now = time.monotonic() if now is None else now
        if now - self._looked > _PAUSE_S:
            self._awaited.clear()
            for beat in self._beats.values():
                beat.at, beat.still = now, 0
        self._looked = now

    def trouble(self, process: str, starts: int) -> str:
        """Why a process that was started again so many times counts as hung; empty when it does not."""
        beat = self._beats.get(process)
        if beat is None or beat.health.restarts != starts:
            silent_s = self._looked - self._awaited.setdefault((process, starts), self._looked)
            return _silence(silent_s) if silent_s > _SILENT_AT_FIRST_S else ""
        silent_s = self._looked - beat.at
        if silent_s > _SILENT_S:
            return _silence(silent_s)
        if beat.still <= longest_still(beat.health):
            return ""
        failing = "finished no frame for" if beat.health.ready else "was not ready after"
        return f"it {failing} {beat.still} s"


def longest_still(health: Health) -> float:
    """Heartbeats without a frame from which on a process counts as hung."""
    if not health.ready:
        return _BEGINNING
    period_s = health.stamp.period_ns / 1e9 if health.stamp else 0.0
    return max(_STILL, _STILL * period_s)


def _silence(seconds: float) -> str:
    return f"nothing was heard of it for {seconds:.0f} s"


def _progress(health: Health) -> tuple[int, int]:
    return health.frames, health.refused

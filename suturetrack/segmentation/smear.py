"""Threads that move fast: the exposure smears them until the filter's scale does not see them.

Where a held thread moves fast, and the field shows nothing along it, it is looked for at wider scales.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.polylines import unit
from suturetrack.segmentation.shutter import SLOWEST_PX, Shutter
from suturetrack.types import Bool, Float32, Float64, Image

# Curves count once they are so old, lest a field depend on how fast they came, and until they are so old;
# where the last of them is older, nobody knows where the thread is by now.
_YOUNGEST_NS, _OLDEST_NS, _LATEST_NS = 50_000_000, 450_000_000, 250_000_000
_MOST = 64
# How far from where it is going a thread is looked for: so many times its step and so many px more.
_STEPS, _BESIDE_PX, _FURTHEST_PX = 2.0, 6.0, 40.0
# And how many of its steps beyond its ends, where it may be held by something dark.
_BEYOND = 1.5
_PLACES_ACROSS = np.linspace(-1, 1, 61)
# So much darker than a smear something surely is none.
_DARKER = 1.3
# Vectors shorter than this along the thread show nothing.
_FAINT = 0.2


@dataclass(frozen=True)
class Scale:
    """A scale that is wider than the thread's own."""

    times: int
    """How much wider."""
    share: float
    """Of what it shows of the thread at rest, what it shows of a smear that its own scale does not, at most:
    of bands of 1.5 to 3.5 sigmas, smeared evenly."""

    def bounds(self, wider: float) -> tuple[float, float]:
        """Lengths from which a vector is too long for a smear, and at which it is none for sure.

        Args:
            wider: what of the thread at rest, whose S is 2c at its own scale, this one shows.
        """
        smeared = 2 * wider * self.share * np.array([1.0, _DARKER])
        longest, gone = 1 - np.exp(-(smeared**2) / 2)
        return float(longest), float(gone)


SCALES = Scale(4, 0.9), Scale(2, 0.67)
"""The widest first: what is too dark there for a smear is none on the others either."""


class Course:
    """Where a thread is going, by its last curves, and how fast it may go and still be seen."""

    def __init__(self) -> None:
        self._curves: deque[tuple[int, Float64]] = deque(maxlen=_MOST)
        self._bands: dict[int, tuple[Band, Band]] = {}
        """By the time of the frame, until its own curve and the next one have come."""
        self._shutter = Shutter()

    def learn(self, capture_ns: int, points: Float64) -> None:
        """Where the thread was: (k, 3) points spread evenly along it, always as many."""
        if self._curves and capture_ns <= self._curves[-1][0]:
            self._curves.clear()
            self._bands.clear()
        self._curves.append((capture_ns, points))

    def bands(self, now_ns: int, rig: StereoRig) -> tuple[Band, Band] | None:
        """Where both views should show it; None where it is not known to move.

        Learns on the way, from bands that were looked at before, what the exposure smears.
        """
        known = [c for c in self._curves if _YOUNGEST_NS <= now_ns - c[0] <= _OLDEST_NS]
        if len(known) < 2 or now_ns - known[-1][0] > _LATEST_NS:
            return None
        times = 1e-9 * np.array([t for t, _ in known])
        points = np.array([p for _, p in known])
        gaps = np.diff(times)
        frame = gaps.min()
        self._look_back(known, frame, rig)
        velocities = np.diff(points, axis=0) / gaps[:, None, None]
        now = points[-1] + velocities[-1] * (1e-9 * now_ns - times[-1])
        before = rig.project(now - velocities * frame)
        clear = self._shutter.fastest_clear
        left, right = (Band.of(p, b, clear) for p, b in zip(rig.project(now), before, strict=True))
        self._bands[now_ns] = left, right
        return left, right

    def _look_back(self, known: list[tuple[int, Float64]], frame: float, rig: StereoRig) -> None:
        """Learns what was shown of the thread at the steps that it really made."""
        for (before, start), (at, points), (after, end) in zip(
            known[:-2], known[1:-1], known[2:], strict=True
        ):
            if (looked := self._bands.pop(at, None)) is None:
                continue
            step = (end - start) / (1e-9 * (after - before)) * frame
            views = looked, rig.project(points), rig.project(points - step)
            for band, *pixels in zip(*views, strict=True):
                if band.empty is not None:
                    self._shutter.learn(_steps_across(*pixels), ~band.empty)
        self._bands = {t: bands for t, bands in self._bands.items() if t > known[0][0]}


@dataclass(eq=False)
class Band:
    """Where one view should show a thread, and how fast it moves there."""

    pixels: Float64
    """(k, 2) rectified px."""
    tangents: Float64
    """(k, 2) unit tangents."""
    steps: Float64
    """(k,) px by which it has moved across itself between two frames, at most, of late."""
    clear: float
    """How many px it may do so and still be seen."""
    empty: Bool | None = None
    """(k,) whether the field that was looked at shows nothing along it; None where nothing is fast."""

    @classmethod
    def of(cls, pixels: Float64, before: Float64, clear: float) -> Band:
        """From (k, 2) pixels and (n, k, 2) where they were a frame before, at each of n velocities."""
        steps = _steps_across(pixels, before).max(axis=0)
        return cls(pixels, _tangents(pixels), steps, clear)

    def look_at(self, field: Float32) -> Bool:
        """(k,) where the thread is too fast to be seen, and an (H, W, 2) field does not show it."""
        if self.steps.max() < SLOWEST_PX:
            return np.zeros(len(self.steps), bool)
        self.empty = self._is_empty(field)
        return self.empty & (self.steps > self.clear)

    def _is_empty(self, field: Float32) -> Bool:
        """(k,) whether an (H, W, 2) field shows nothing along the thread within reach."""
        height, width = field.shape[:2]
        across = _turned(self.tangents)[:, None, :] * self._reach[:, None, None]
        places = self.pixels[:, None, :] + across * _PLACES_ACROSS[:, None]
        u, v = np.rint(places.clip(-1, (width, height))).astype(int).transpose(2, 0, 1)
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        vectors = field[v * inside, u * inside]
        along = np.abs(np.sum(vectors * self.tangents[:, None, :], axis=2))
        return np.asarray((along * inside).max(axis=1) < _FAINT)

    def paint(self, which: Bool, mask: Image) -> None:
        """Sets (H, W) `mask` within reach of the places that are meant, and elsewhere to 0."""
        mask[:] = 0
        middle, bound = self.pixels.copy(), 4 * max(mask.shape)
        middle[0] -= _BEYOND * self.steps[0] * self.tangents[0]
        middle[-1] += _BEYOND * self.steps[-1] * self.tangents[-1]
        across = self._reach[:, None] * _turned(self.tangents)
        one, other = (
            np.rint((middle + x).clip(-bound, bound)).astype(int) for x in (across, -across)
        )
        for i in np.flatnonzero(which[:-1] | which[1:]):
            cv2.fillConvexPoly(mask, np.array([one[i], one[i + 1], other[i + 1], other[i]]), 1)

    @property
    def _reach(self) -> Float64:
        return np.minimum(_STEPS * self.steps + _BESIDE_PX, _FURTHEST_PX)


def _steps_across(pixels: Float64, before: Float64) -> Float64:
    """(..., k) px by which (k, 2) pixels of a thread moved across it from (..., k, 2) before."""
    return np.abs(np.sum((pixels - before) * _turned(_tangents(pixels)), axis=-1))


def _tangents(pixels: Float64) -> Float64:
    return unit(np.gradient(pixels, axis=0))


def _turned(vectors: Float64) -> Float64:
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)

"""What is not seen of a curve: how far it may have moved, and for how long its ends have been hidden."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.polylines import arc_lengths
from suturetrack.tracking.reliability import ASTRAY, EVENLY, RELIABILITY_SAMPLES
from suturetrack.tracking.sampling import views_at
from suturetrack.types import Bool, Float64, Nurbs

# What is not seen may leave the curve by this part of its own motion in a field, and by so much at rest.
_DRIFT, _DRIFT_AT_REST_PX = 0.35, 0.2
# How much of its drift is left to what moves as most of the thread does.
_TOGETHER = 0.2
# Drift from which a stretch may be anywhere, is surely elsewhere, and is gone where it is outside; and that
# of what may have moved as a whole.
_ANYWHERE_PX, _HOPELESS_PX, _GONE_PX, _MOVED_PX = 5.0, 15.0, 8.0, 2.0
# How far a hidden stretch bulges, of the way along it to what is seen, and what share of the curve has to be
# seen on both of its sides to hold it.
_BULGE, _HOLD = 0.15, 0.12
# What is as near to the border as this is outside the images.
_BORDER_PX = 10.0


class Drift:
    """How far what is not seen may have moved away, px, at evenly spaced parameters.

    It grows with the curve's own motion there: a hidden stretch of a thread at rest stays where it
    was, and one that moves as the rest does goes on with it; one that was moving fast by itself may be
    anywhere, but for what a stretch that is held on both sides can bulge. What comes into the images is
    looked for anew.
    """

    def __init__(self) -> None:
        self.px: Float64 = np.zeros(RELIABILITY_SAMPLES)
        self.outside: Bool = np.zeros(RELIABILITY_SAMPLES, bool)
        """(k,) what is outside the images."""

    @classmethod
    def everywhere(cls) -> Drift:
        """All may have moved, though not far: what is not seen at once is doubtful soon."""
        drift = cls()
        drift.px[:] = _MOVED_PX
        return drift

    def grow(
        self, before: Nurbs, predicted: Nurbs, after: Nurbs, seen: Bool, rig: StereoRig
    ) -> None:
        """One field later, in which the curve moved from `before` to `after`."""
        left, right = views_at(rig, after, EVENLY)
        size, was_outside = rig.image_size, self.outside
        self.outside = ~(left.inside(size, _BORDER_PX) & right.inside(size, _BORDER_PX))
        if seen.all():
            self.px = np.zeros(len(seen))
            return
        last, expected = (views_at(rig, curve, EVENLY)[0] for curve in (before, predicted))
        moved, surprise = (
            _own_lengths(left.pixels - view.pixels, seen) for view in (last, expected)
        )
        if seen.any():
            surprise = np.interp(EVENLY, EVENLY[seen], surprise[seen])
        step = _DRIFT * moved + surprise + _DRIFT_AT_REST_PX
        farthest = np.minimum(np.hypot(self.px, step), _BULGE * _from_held(seen, left.pixels))
        self.px = np.where(seen | (was_outside & ~self.outside), 0.0, farthest)

    def cut(self, start: int, stop: int) -> None:
        """So many samples were cut off at the ends."""
        places = np.linspace(start, len(self.px) - 1 - stop, len(self.px))
        self.px = np.interp(places, np.arange(len(self.px)), self.px)
        self.outside = self.outside[np.rint(places).astype(int)]

    @property
    def anywhere(self) -> Bool:
        """(k,) what may be anywhere in the images."""
        return (self.px > _ANYWHERE_PX) & ~self.outside

    @property
    def hopeless(self) -> Bool:
        """(k,) what is surely elsewhere in the images."""
        return (self.px > _HOPELESS_PX) & ~self.outside

    @property
    def gone(self) -> Bool:
        """(k,) what has moved far outside the images, where it cannot be looked for."""
        return (self.px > _GONE_PX) & self.outside


def _own_lengths(steps: Float64, seen: Bool) -> Float64:
    """(k,) lengths of (k, 2) steps, without most of what is common to those that are seen."""
    lengths = np.linalg.norm(steps, axis=1)
    if not seen.any():
        return lengths
    apart = np.linalg.norm(steps - np.median(steps[seen], axis=0), axis=1)
    return np.minimum(lengths, apart + _TOGETHER * lengths)


def _from_held(seen: Bool, places: Float64) -> Float64:
    """(k,) way along (k, 2) places to the nearer of the long seen stretches around, px; infinite where
    there is none on one side."""
    held = search.solid(seen, np.ones(len(seen)), round(_HOLD * len(seen)))
    along = arc_lengths(places)
    before = np.maximum.accumulate(np.where(held, along, -np.inf))
    after = np.minimum.accumulate(np.where(held, along, np.inf)[::-1])[::-1]
    is_between = np.isfinite(before) & np.isfinite(after)
    return np.where(is_between, np.minimum(along - before, after - along), np.inf)


class HiddenEnds:
    """For how long what is next to the ends has been hidden, within the images.

    A stretch in the middle is held from both sides, one at an end from one side only: where its tip is
    nobody knows for long, and in the end it is gone, drawn away or cut off.
    """

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._shown_ns = [now_ns, now_ns]
        self._counts = 0, 0

    def step(self, hidden: Bool, now_ns: int) -> None:
        """Evenly spaced samples that are `hidden` now."""
        self._now_ns, self._counts = now_ns, (_run(hidden), _run(hidden[::-1]))
        for end, count in enumerate(self._counts):
            if count <= ASTRAY * len(hidden):
                self._shown_ns[end] = now_ns

    def for_longer_than(self, seconds: float) -> tuple[int, int]:
        """How many samples at the start and at the stop have been hidden for so long."""
        hidden_s = [(self._now_ns - shown_ns) * 1e-9 for shown_ns in self._shown_ns]
        start, stop = (
            count if time > seconds else 0
            for count, time in zip(self._counts, hidden_s, strict=True)
        )
        return start, stop


def _run(hidden: Bool) -> int:
    """How many are hidden before the first two that are not."""
    shown = np.flatnonzero(~hidden[:-1] & ~hidden[1:])
    return int(shown[0]) if len(shown) else len(hidden)

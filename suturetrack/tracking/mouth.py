"""Where a thread comes out of something: an end that keeps its place while the thread grows longer."""

from __future__ import annotations

import math

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.tracking.ends import EndStep
from suturetrack.tracking.sampling import derivatives_at, length_of, views
from suturetrack.types import Float64, Nurbs

# An end is at a mouth when it has stayed within this for so long while the thread became longer by so many
# px and such a part, more than errors in depth make of a length, and has been so long for a moment. A knot
# that is drawn tight makes it shorter.
_STAYS_PX, _STAYS_NS = 8.0, 500_000_000
_DRAWN_PX, _DRAWN, _DRAWN_NS = 10.0, 0.04, 150_000_000
# It has left one when it was further away, or not to be seen, for so long.
_LEAVES_PX, _LEAVES_NS = 12.0, 400_000_000
# An end that jumps has not been drawn out; a mouth draws an end by no more at a time.
_CALM_PX = 4.0
# Weight of the newest place in the mean, at least.
_NEWEST = 0.01


class Mouth:
    """The mean place of one end for as long as it stays.

    A mouth looks like a piece of the thread, another one with every direction in which the thread leaves
    it; its own place is steadier than what one field shows of it.
    """

    def __init__(self) -> None:
        self.is_open = False
        """Whether the end is at a mouth."""
        self.since_ns = 0
        """When the end came to its place."""
        self._place: Float64 | None = None
        self._near_ns = self._short_ns = 0
        self._count = 0
        self._length = 0.0
        self._pixel = 0.0

    def steady(
        self,
        step: EndStep | None,
        curve: Nurbs,
        end: int,
        other: Mouth,
        rig: StereoRig,
        now_ns: int,
    ) -> EndStep | None:
        """The step to the mouth, where the end `end` (0 or 1) of the curve is at one; else the step.

        The `other` end must have moved meanwhile: where one of two lies still, that is the mouth.
        """
        length, at = length_of(curve), np.array([float(end)])
        tip, outward, _ = derivatives_at(curve, at)
        outward *= (1 if end else -1) / np.linalg.norm(outward)
        if step is not None:
            self._pixel = step.pixel * length
            self._look(step, tip + step.offset * length * outward, length, other, rig, now_ns)
        elif not self.is_open or now_ns - self._near_ns > _LEAVES_NS:
            self.is_open, self._place = False, None
        if not self.is_open or self._place is None:
            return step
        offset_px = _ahead(self._place, tip, outward, rig)
        offset_px = min(max(offset_px, -_CALM_PX), _CALM_PX)
        return EndStep(offset_px, self._pixel / length, at_border=False)

    def _look(
        self,
        step: EndStep,
        shown: Float64,
        length: float,
        other: Mouth,
        rig: StereoRig,
        now_ns: int,
    ) -> None:
        """Learns from where the end is seen."""
        away = self._away(shown, rig)
        if self._place is None or step.at_border or self._has_left(away, now_ns):
            self._place, self._length, self.is_open = shown, length, False
            self._count, self.since_ns, away = 0, now_ns, 0.0
        if away <= _LEAVES_PX:
            self._near_ns = now_ns
            self._count += 1
            self._place = self._place + (shown - self._place) * max(1 / self._count, _NEWEST)
        has_stayed = now_ns - self.since_ns > _STAYS_NS and abs(step.offset_px) < _CALM_PX
        if length - self._length <= max(_DRAWN_PX * self._pixel, _DRAWN * self._length):
            self._short_ns = now_ns
        if has_stayed and other.since_ns > self.since_ns:
            self.is_open |= now_ns - self._short_ns > _DRAWN_NS

    def _away(self, shown: Float64, rig: StereoRig) -> float:
        """How far from the mean place the end shows, px: the images tell little of its depth."""
        if self._place is None:
            return np.inf
        left, right = rig.project(np.concatenate([shown, self._place]))
        return max(math.dist(*left), math.dist(*right))

    def _has_left(self, away: float, now_ns: int) -> bool:
        if self.is_open:
            return away > _LEAVES_PX and now_ns - self._near_ns > _LEAVES_NS
        return away > _STAYS_PX


def _ahead(place: Float64, tip: Float64, outward: Float64, rig: StereoRig) -> float:
    """How far a place lies ahead of the tip in the images, px: the depth of both is unsure."""
    both = zip(views(rig, tip, outward), rig.project(place), strict=True)
    return float(np.mean([np.sum((there - v.pixels) * v.tangents) for v, there in both]))

"""Ends of a curve that lie on another part of it: folds, and tips that cross their own thread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.tracking.sampling import Samples, View, leading, views_at
from suturetrack.types import Bool, Float64, Int64, Nurbs

# A curve lies on a part of itself that is so near and so parallel, and so far away along it; so many
# samples in a row may lie elsewhere. What comes back at once has folded.
_ON_PX, _PARALLEL, _TURN_PX, _STRAY = 2.0, 0.9, 25.0, 2
_FOLD_PX = 40.0
# Samples at both ends of which one does so.
_TIPS = np.r_[: _STRAY + 1, -_STRAY - 1 : 0]
# What is shorter than this may be noise.
_SHORTEST_PX = 8.0
# A tip that has just begun to fold runs back over so many of its pixels, at this cosine to its way there.
_TIP, _OPPOSED = 6, -0.7


@dataclass(frozen=True)
class Tail:
    """An end of the curve that lies on another part of it."""

    part: float
    """Its part of the curve."""
    is_fold: bool
    """Whether the curve turns back on the spot: no thread bends so tightly."""


def doubled_ends(curve: Nurbs, rig: StereoRig) -> tuple[Tail, Tail]:
    """What at the start and at the stop of the curve lies on another part of it.

    Strands that cross are not parallel, and strands side by side are further apart.
    """
    samples = Samples.of(curve.knots, 4)
    both = samples.views(rig, curve.control_points)
    along = np.cumsum(samples.share * both[0].speed)
    inward = np.arange(0.0, min(_FOLD_PX, along[-1] / 2))
    start = _fold(curve, rig, 0, np.interp(inward, along, samples.s))
    stop = _fold(curve, rig, 1, np.interp(along[-1] - inward, along, samples.s))
    tails = _long_tails(samples, both, along)
    return Tail(start, True) if start else tails[0], Tail(stop, True) if stop else tails[1]


def _fold(curve: Nurbs, rig: StereoRig, end: int, inward: Float64) -> float:
    """The part of the curve from the end `end` (0 or 1) to where the tip turns back; 0 if it does not.

    `inward` are parameters a pixel apart that begin at that end.
    """
    both = views_at(rig, curve, inward)
    rows = np.arange(min(_TIP, len(inward)))
    left, right = (view.tangents[rows] @ view.tangents.T for view in both)
    opposed = np.maximum(left, right) < _OPPOSED
    if not opposed.any():
        return 0.0
    tip, there = np.nonzero(opposed & _near(both, rows))
    if not len(tip):
        return 0.0
    return abs(end - float(inward[(tip + there).max() // 2]))


def _long_tails(samples: Samples, both: tuple[View, View], along: Float64) -> tuple[Tail, Tail]:
    """The ends that lie on the curve further on, `along` px from its start."""

    def back_at(rows: Int64) -> Float64:
        """(r,) px along the curve from samples to the nearest one that they lie on; inf for none."""
        gap = np.abs(along - along[rows, None])
        lies_on = _near(both, rows) & (gap >= _TURN_PX)
        if lies_on.any():
            for view in both:
                lies_on &= np.abs(view.tangents[rows] @ view.tangents.T) > _PARALLEL
        return np.where(lies_on, gap, np.inf).min(axis=1)

    if not np.isfinite(back_at(_TIPS)).any():
        return Tail(0.0, False), Tail(0.0, False)
    back = back_at(np.arange(len(along)))
    start, is_fold = _doubled(back, along)
    stop, is_folded_stop = _doubled(back[::-1], along[-1] - along[::-1])
    s = samples.s
    return (
        Tail(float(s[start]) if start else 0.0, is_fold),
        Tail(1.0 - float(s[-1 - stop]) if stop else 0.0, is_folded_stop),
    )


def _near(both: tuple[View, View], rows: Int64) -> Bool:
    """(r, k) whether the samples `rows` lie where others do, in both images."""
    near = np.ones((len(rows), len(both[0].pixels)), bool)
    for places in (column for view in both for column in view.pixels.T):
        near &= np.abs(places[rows, None] - places) <= _ON_PX
    return near


def _doubled(back: Float64, along: Float64) -> tuple[int, bool]:
    """How many of the first samples lie on later ones, `back` px further on, and whether by a fold."""
    count = leading(np.isfinite(back), _STRAY + 1)
    if count == 0 or count >= len(along) // 2 or along[count] <= _SHORTEST_PX:
        return 0, False
    return count, bool(back[count - 1] < _FOLD_PX)

"""The corresponding points in the other view: disparities by continuity along the thread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.initialization.segments import chain_tangents
from suturetrack.kernels import matching as kernel
from suturetrack.kernels import search
from suturetrack.types import Bool, Float32, Float64, read_only

_STATE_PX = 1.0
_PENALTY = 1.6
"""Cost of a change by one state, the largest from sample to sample, against 1 for one without any ridge."""
_LEAST_LEVEL = 0.1
_MOST_ROWS = 4
_CLEARLY = 0.005
"""By how much more of the thread has to be seen on other rows before they are believed."""


@dataclass(frozen=True, eq=False)
class Match:
    """The counterpart of a chain in the other view."""

    pixels: Float64
    """(k, 2) pixels."""
    response: Float64
    """(k,) how much the other view looks like thread there: 1 as much as the chain's own."""
    inside: Bool
    """(k,) whether the other image reaches there."""


def match(pixels: Float64, own: Float32, other: Float32, at_infinity: float, side: int) -> Match:
    """Finds the thread of a chain in the other view along the epipolar lines.

    Args:
        pixels: (k, 2) along the thread in one view, about 1 px apart.
        own: (H, W, 2) field of that view.
        other: (H, W, 2) field of the other view.
        at_infinity: disparity u_own - u_other of points at infinity, px.
        side: 1 where the other view's pixels lie left of that, as the right camera's do; else -1.
    """
    count = int(other.shape[1] / _STATE_PX)
    first = at_infinity if side > 0 else at_infinity - _STATE_PX * (count - 1)
    disparity, response = disparities(pixels, own, other, first, _STATE_PX, count, _PENALTY)
    there = pixels - np.c_[disparity, np.zeros(len(disparity))]
    inside = (there[:, 0] >= 0) & (there[:, 0] <= other.shape[1] - 1)
    return Match(there, np.where(inside, response, 0.0), inside)


def disparities(
    pixels: Float64,
    own: Float32,
    other: Float32,
    first: float,
    step_px: float,
    count: int,
    penalty: float,
) -> tuple[Float64, Float64]:
    """(k,) disparities u_own - u_other, each one of `count` from `first` on, that change little along the
    (k, 2) pixels of a chain, and (k,) how much the other view looks like thread there: 1 as much as the
    chain's own."""
    tangents = chain_tangents(pixels)
    level = max(float(np.median(search.responses(own, pixels, tangents))), _LEAST_LEVEL)
    costs = kernel.matching_costs(other, pixels, tangents, first, step_px, count, level)
    states = kernel.cheapest_path(costs, 1, penalty)
    return first + step_px * states, 1.0 - costs[np.arange(len(states)), states].astype(float)


def row_offset(pixels: Float64, left: Float32, right: Float32, at_infinity: float) -> int:
    """How many rows lower than the calibration says the right view shows the thread of (k, 2) left pixels;
    0 in doubt.

    One row can be enough to spoil the depth wherever the thread runs along the epipolar lines, and
    the curve fits both views none the worse for it.
    """
    seen: dict[int, float] = {}

    def share(rows: int) -> float:
        if rows not in seen:
            moved = raised(right, rows)
            seen[rows] = float(np.mean(match(pixels, left, moved, at_infinity, 1).response))
        return seen[rows]

    best = 0
    for step in (-1, 1):
        while abs(best) < _MOST_ROWS and share(best + step) > share(best) + _CLEARLY:
            best += step
        if best:
            break
    return best


def raised(view: Float32, rows: int) -> Float32:
    """An (H, W, 2) field moved up by so many rows, read-only; what comes in is background."""
    moved = np.zeros_like(view)
    height = len(view)
    moved[max(-rows, 0) : height - max(rows, 0)] = view[max(rows, 0) : height + min(rows, 0)]
    return read_only(moved)

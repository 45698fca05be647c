"""Rims of tools, which second derivatives take for ridges, out of a ridge field."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from suturetrack.kernels import FAST
from suturetrack.types import Float32

_zero, _half, _one, _two = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)

# Vectors as short as this are not looked at; rows that are asked at once whether any is longer.
_FAINT, _ROWS = 0.1, 16
# Difference in brightness of the two sides of a ridge, as a share of how much brighter both are in
# all, from which it fades and at which it is gone. On rendered scenes 99 % of the places on threads
# have less than 0.5, beside crossings too, and 99 % of those on the rims of tools more than 0.77.
_RIM_FROM, _RIM_TO = 0.55, 0.85


@njit(cache=True, **FAST)
def fade_rims(plane: Float32, reach: float, field: Float32) -> None:
    """Shortens the vectors of dark ridges that are rims: only one side of them is brighter.

    The second derivative of a step is that of a ridge on the darker side of it. A thread has brighter
    ground on both sides; what lies close beside it is looked past.

    Args:
        plane: (H, W), in which threads are dark.
        reach: px from the middle of a thread to ground; looked at there and up to twice as far.
        field: (H, W, 2), overwritten. What is near the border of the image is left alone.
    """
    height, width = plane.shape
    margin = math.ceil(2 * reach) + 1
    steps = np.array([1.0, 1.5, 2.0], np.float32) * np.float32(reach)
    faint = np.float32(_FAINT**2)
    longest = np.empty(width, np.float32)
    for top in range(margin, height - margin, _ROWS):
        rows = range(top, min(top + _ROWS, height - margin))
        longest[:] = _zero
        for y in rows:
            row = field[y]
            for x in range(width):
                longest[x] = max(longest[x], row[x, 0] * row[x, 0] + row[x, 1] * row[x, 1])
        for x in range(margin, width - margin):
            if longest[x] < faint:
                continue
            for y in rows:
                u, v = field[y, x, 0], field[y, x, 1]
                square = u * u + v * v
                if square >= faint:
                    scale = _one / np.sqrt(square)
                    kept = _kept(plane, x, y, scale * u, scale * v, steps)
                    field[y, x, 0], field[y, x, 1] = kept * u, kept * v


@njit(inline="always", **FAST)
def _kept(plane: Any, x: Any, y: Any, u: Any, v: Any, steps: Any) -> Any:
    """The share that is left of a ridge of direction (u, v)."""
    inside = _half * steps[0]
    middle = min(_across(plane, x, y, u, v, inside), _across(plane, x, y, u, v, -inside))
    middle = min(middle, plane[y, x])
    one = other = middle
    for step in steps:
        one = max(one, _across(plane, x, y, u, v, step))
        other = max(other, _across(plane, x, y, u, v, -step))
    depth = one + other - _two * middle
    uneven = abs(one - other) - np.float32(_RIM_FROM) * depth
    if uneven <= _zero:
        return _one
    return max(_one - uneven / (np.float32(_RIM_TO - _RIM_FROM) * depth), _zero)


@njit(inline="always", **FAST)
def _across(plane: Any, x: Any, y: Any, u: Any, v: Any, distance: Any) -> Any:
    """The pixel that is so far from (x, y) across the direction (u, v)."""
    return plane[int(np.rint(y + distance * u)), int(np.rint(x - distance * v))]

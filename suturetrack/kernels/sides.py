"""Ridges have two sides: what eq. (1) sees beside an edge has one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from suturetrack.types import Float32

# Vectors so short are left alone, as noise is.
_SHORT = np.float32(0.05)
# Where the crest may be, and its sides, in sigmas across the ridge: so far that the whole flank of a
# ridge keeps its length, and a band where strands run together has sides, too.
_CRESTS = tuple(np.float32(x) for x in (0, -1, 1, -2, 2, -3, 3))
_SIDES = tuple(np.float32(x) for x in (1.5, 3, 4.5))
# Lopsidedness up to which a ridge counts in full, and that from which it does not at all: 1 where one
# side is just as dark as the crest.
_EVEN, _LOPSIDED = np.float32(0.75), np.float32(1.0)
# A crest beside the pixel is as deep as so much of what is seen at the pixel: noise is not.
_DEEP = np.float32(0.5)


@njit(cache=True, error_model="numpy")
def fade_edges(plane: Float32, sigmas: Float32, signs: tuple[float, float], field: Float32) -> None:
    """Shortens the vectors where no crest is near that stands out from both of its sides.

    With I_0 at the crest and I_-, I_+ on its sides, a ridge is lopsided by
    |I_+ - I_-| / |I_+ + I_- - 2 I_0|: below 1 on any background that slopes less than the thread is
    deep, above 1 wherever one side is darker than the crest (brighter, for bright threads), as beside
    the edge of a tool and around a highlight, where eq. (1) sees a ridge too.

    Args:
        plane: (H, W), smoothed a little.
        sigmas: (k,) of the filter, px; a ridge of any of these scales counts.
        signs: as of `ridge.ridge_field`.
        field: (H, W, 2), V_o; changed in place.
    """
    height, width = field.shape[:2]
    for y in range(height):
        vectors = field[y]
        for x in range(width):
            u, v = vectors[x]
            square = u * u + v * v
            if square <= _SHORT * _SHORT:
                continue
            length, worth = np.sqrt(square), np.float32(0)
            for sigma in sigmas:
                across = -v * sigma / length, u * sigma / length
                worth = max(worth, _worth(plane, np.float32(x), np.float32(y), across, signs))
            if worth < 1:
                vectors[x, 0] = worth * u
                vectors[x, 1] = worth * v


@njit(cache=True, error_model="numpy")
def _worth(plane: Float32, u: Any, v: Any, across: Any, signs: tuple[float, float]) -> Any:
    """1 for a ridge, 0 for an edge; `across` is sigma long."""
    worth = shallow = np.float32(0)
    for crest in _CRESTS:
        middle = _at(plane, u + crest * across[0], v + crest * across[1])
        for side in _SIDES:
            a, b = crest - side, crest + side
            before = _at(plane, u + a * across[0], v + a * across[1])
            behind = _at(plane, u + b * across[0], v + b * across[1])
            depth = before + behind - 2 * middle
            if crest == 0 and side == _SIDES[0]:
                shallow = _DEEP * abs(depth)
            if signs[0] <= np.sign(depth) <= signs[1] and abs(depth) > shallow:
                lopsided = abs(behind - before) / abs(depth)
                worth = max(worth, (_LOPSIDED - lopsided) / (_LOPSIDED - _EVEN))
            if worth >= 1:
                return worth
    return worth


@njit(inline="always", error_model="numpy")
def _at(plane: Float32, u: Any, v: Any) -> Any:
    """Between four pixels; the edges replicated."""
    u = min(max(u, np.float32(0)), np.float32(plane.shape[1] - 1))
    v = min(max(v, np.float32(0)), np.float32(plane.shape[0] - 1))
    x, y = min(int(u), plane.shape[1] - 2), min(int(v), plane.shape[0] - 2)
    right, down = u - x, v - y
    above = plane[y, x] + right * (plane[y, x + 1] - plane[y, x])
    below = plane[y + 1, x] + right * (plane[y + 1, x + 1] - plane[y + 1, x])
    return above + down * (below - above)

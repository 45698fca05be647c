"""Crest lines of a ridge vector field, one pixel wide, as chains of pixels."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.types import Bool, Float32, Int64


@numba.njit(cache=True, nogil=True)
def crest_pixels(field: Float32, magnitude: Float32, low: float) -> Bool:
    """(H, W): where ||V|| is at least `low` and falls off to both sides of the direction of V."""
    height, width = magnitude.shape
    crest = np.zeros((height, width), np.bool_)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            m = magnitude[y, x]
            if m < low:
                continue
            nu, nv = -field[y, x, 1] / m, field[y, x, 0] / m
            beside = max(_bilinear(magnitude, x + nu, y + nv), _bilinear(magnitude, x - nu, y - nv))
            crest[y, x] = m >= beside
    return crest


@numba.njit(cache=True, nogil=True)
def _bilinear(image: Float32, u: float, v: float) -> float:
    x, y = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - x, v - y
    x1, y1 = min(x + 1, image.shape[1] - 1), min(y + 1, image.shape[0] - 1)
    above = (1 - fu) * image[y, x] + fu * image[y, x1]
    below = (1 - fu) * image[y1, x] + fu * image[y1, x1]
    return (1 - fv) * above + fv * below


@numba.njit(cache=True, nogil=True)
def thin(mask: Bool, magnitude: Float32) -> None:
    """Takes away, weakest first, the pixels of `mask` that neither end nor hold a line together.

    The border of the image is cleared.
    """
    mask[0] = mask[-1] = mask[:, 0] = mask[:, -1] = False
    ys, xs = np.nonzero(mask)
    values = np.empty(len(ys), np.float32)
    for k in range(len(ys)):
        values[k] = magnitude[ys[k], xs[k]]
    order = np.argsort(values)
    changed = True
    while changed:
        changed = False
        for k in order:
            y, x = ys[k], xs[k]
            if mask[y, x] and _removable(mask, y, x):
                mask[y, x] = False
                changed = True


@numba.njit(cache=True, nogil=True)
def _removable(mask: Bool, y: int, x: int) -> bool:
    """Whether the pixel has two neighbours or more that stay 8-connected without it."""
    n = (
        mask[y, x + 1],
        mask[y - 1, x + 1],
        mask[y - 1, x],
        mask[y - 1, x - 1],
        mask[y, x - 1],
        mask[y + 1, x - 1],
        mask[y + 1, x],
        mask[y + 1, x + 1],
    )
    count = 0
    for k in range(8):
        count += n[k]
    if count < 2:
        return False
    # Yokoi's connectivity number for 8-connected foreground.
    number = 0
    for k in range(0, 8, 2):
        if not n[k] and (n[(k + 1) % 8] or n[(k + 2) % 8]):
            number += 1
    return number == 1


@numba.njit(cache=True, nogil=True)
def trace_chains(mask: Bool) -> tuple[Int64, Int64]:
    """Splits a thinned mask at its junctions into chains of pixels.

    Returns:
        (n, 2) pixels (x, y) of all chains one after another, and (m + 1,) where each chain begins.
    """
    left = mask.copy()
    ys, xs = np.nonzero(mask)
    for k in range(len(ys)):
        if _neighbours(mask, ys[k], xs[k]) > 2:
            left[ys[k], xs[k]] = False
    pixels = np.empty((len(ys), 2), np.int64)
    starts = [0]
    filled = 0
    for wanted in (1, 2):  # Open chains from their ends, then closed ones from anywhere.
        for k in range(len(ys)):
            y, x = ys[k], xs[k]
            if not left[y, x] or _neighbours(left, y, x) > wanted:
                continue
            while y >= 0:
                left[y, x] = False
                pixels[filled, 0], pixels[filled, 1] = x, y
                filled += 1
                y, x = _next(left, y, x)
            starts.append(filled)
    return pixels[:filled], np.array(starts)


@numba.njit(cache=True, nogil=True)
def _neighbours(mask: Bool, y: int, x: int) -> int:
    count = 0
    for j in range(max(y - 1, 0), min(y + 2, mask.shape[0])):
        for i in range(max(x - 1, 0), min(x + 2, mask.shape[1])):
            count += mask[j, i]
    return count - mask[y, x]


@numba.njit(cache=True, nogil=True)
def _next(mask: Bool, y: int, x: int) -> tuple[int, int]:
    for straight in (True, False):
        for j in range(max(y - 1, 0), min(y + 2, mask.shape[0])):
            for i in range(max(x - 1, 0), min(x + 2, mask.shape[1])):
                if mask[j, i] and (j == y or i == x) == straight:
                    return j, i
    return -1, -1

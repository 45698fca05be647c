"""Smeared threads, out of a field of half the size, into the field."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from suturetrack.kernels import FAST
from suturetrack.types import Float32, Image

_zero, _half, _one = np.float32(0), np.float32(0.5), np.float32(1)


@njit(cache=True, **FAST)
def find_longer_than(longest: float, vectors: Float32, found: Image) -> None:
    """Sets (H, W) `found` to 1 where (H, W, 2) vectors are longer than that, elsewhere to 0."""
    least = np.float32(longest * longest)
    for y in range(len(vectors)):
        for x in range(vectors.shape[1]):
            u, v = vectors[y, x, 0], vectors[y, x, 1]
            found[y, x] = u * u + v * v > least


@njit(cache=True, **FAST)
def keep_longer_of_half(
    half: Float32, dark: Image, bounds: tuple[float, float], mask: Image, out: Float32
) -> None:
    """Within the mask, the longer of both fields' vectors into `out`.

    Args:
        half: (ceil(H / 2), ceil(W / 2), 2), read linearly between the vectors' places; their signs mean
            nothing.
        dark: (ceil(H / 2), ceil(W / 2)), not 0 where something is too dark for a smear.
        bounds: lengths from which vectors in `half` fade and at which they are gone: of a smear there are
            hardly any so long.
        mask: (H, W), 0 where `out` stays as it is; set to 0 where something is too dark.
        out: (H, W, 2), overwritten.
    """
    height, width = out.shape[:2]
    rows, columns = half.shape[:2]
    gone, fading = np.float32(bounds[1]), np.float32(bounds[1] - bounds[0])
    for y in range(height):
        v = (np.float32(y) + _half) * np.float32(rows / height) - _half
        top = math.floor(v)
        down = v - np.float32(top)
        above, below = max(top, 0), min(top + 1, rows - 1)
        for x in range(width):
            if mask[y, x] == 0:
                continue
            u = (np.float32(x) + _half) * np.float32(columns / width) - _half
            before = math.floor(u)
            right = u - np.float32(before)
            left, after = max(before, 0), min(before + 1, columns - 1)
            row, column = above if down < _half else below, left if right < _half else after
            if dark[row, column]:
                mask[y, x] = 0
                continue
            nearest = half[row, column]
            p = q = _zero
            for row, by_row in ((above, _one - down), (below, down)):
                for column, by_column in ((left, _one - right), (after, right)):
                    vector, share = half[row, column], by_row * by_column
                    if vector[0] * nearest[0] + vector[1] * nearest[1] < _zero:
                        share = -share
                    p, q = p + share * vector[0], q + share * vector[1]
            length = np.sqrt(p * p + q * q)
            kept = min(max((gone - length) / fading, _zero), _one)
            p, q = kept * p, kept * q
            if p * p + q * q > out[y, x, 0] * out[y, x, 0] + out[y, x, 1] * out[y, x, 1]:
                out[y, x, 0], out[y, x, 1] = p, q

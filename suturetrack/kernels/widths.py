"""How wide the ridge of a thread is: the moments of its profile."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.kernels.search import normal_profiles
from suturetrack.types import Bool, Float32, Float64

# Squared width of a ridge, against the usual one, from which another strand is in it, and the power of
# the width beyond that by which it counts less.
_WIDE, _WIDENED = 1.15, 12


@numba.njit(cache=True, nogil=True)
def moments(profiles: Float64, offsets: Float64) -> tuple[Float64, Float64]:
    """(k,) middle and squared width of ridges, px, from (k, m) responses across them at (k, m) offsets."""
    middle, spread = np.empty(len(profiles)), np.empty(len(profiles))
    for j in range(len(profiles)):
        middle[j], spread[j] = _moments(profiles[j], offsets[j])
    return middle, spread


@numba.njit(cache=True, nogil=True)
def _moments(profile: Float64, offsets: Float64) -> tuple[float, float]:
    least, total, first, second = profile.min(), 0.0, 0.0, 0.0
    for i in range(len(profile)):
        weight = (profile[i] - least) ** 2
        total += weight
        first += weight * offsets[i]
    total = max(total, 1e-12)
    middle = first / total
    for i in range(len(profile)):
        second += (profile[i] - least) ** 2 * (offsets[i] - middle) ** 2
    return middle, second / total


@numba.njit(cache=True, nogil=True)
def single(spread: Float64, usual: float) -> Float64:
    """(k,) in [0, 1]: low where a ridge of this squared width is more than one strand."""
    return np.maximum(spread / max(_WIDE * usual, 1e-12), 1.0) ** -_WIDENED


@numba.njit(cache=True, nogil=True)
def narrowness(
    field: Float32, pixels: Float64, tangents: Float64, across: Float64, alone: Bool
) -> Float64:
    """(k,) in [0, 1]: low where the ridge is wider than that of the thread.

    Args:
        field: (H, W, 2).
        pixels: (k, 2) along the thread and its extension.
        tangents: (k, 2), unit.
        across: (m,) px along the normals at which the ridge is looked at.
        alone: (k,) where it is as wide as the thread; without any, nothing is wide.
    """
    if not alone.any():
        return np.ones(len(pixels))
    profiles, spread = normal_profiles(field, pixels, tangents, across, 0.0), np.empty(len(pixels))
    for j in range(len(pixels)):
        spread[j] = _moments(profiles[j], across)[1]
    return single(spread, np.median(spread[alone]))

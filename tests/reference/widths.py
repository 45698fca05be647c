"""Literal twins of the kernels that tell how wide a ridge is."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Bool, Float32, Float64
from tests.reference.curve_fit import normal_profiles


def moments(profiles: Float64, offsets: Float64) -> tuple[Float64, Float64]:
    """See `suturetrack.kernels.widths.moments`."""
    weights = (profiles - profiles.min(1, keepdims=True)) ** 2
    total = np.maximum(weights.sum(1), 1e-12)
    middle = (weights * offsets).sum(1) / total
    return middle, (weights * (offsets - middle[:, None]) ** 2).sum(1) / total


def narrowness(
    field: Float32, pixels: Float64, tangents: Float64, across: Float64, alone: Bool
) -> Float64:
    """See `suturetrack.kernels.widths.narrowness`."""
    profiles = normal_profiles(field, pixels, tangents, across, 0.0)
    _, spread = moments(profiles, np.tile(across, (len(pixels), 1)))
    usual = max(1.15 * float(np.median(spread[alone])), 1e-12)
    return np.asarray((np.maximum(spread / usual, 1.0)) ** -12)

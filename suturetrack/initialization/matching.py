"""The corresponding points in the right view: disparities by continuity along the thread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization.growth import Chain
from suturetrack.kernels import matching as kernel
from suturetrack.kernels import search
from suturetrack.types import Float32, Float64

_STATE_PX = 1.0
_LARGEST_CHANGE = 1
"""States a sample may differ from the one before."""
_PENALTY = 1.6
"""Cost of a state's change, against 1 for a sample without any ridge."""


_LEAST_LEVEL = 0.1


@dataclass(frozen=True, eq=False)
class Match:
    """A chain with its counterpart in the right view."""

    right: Float64
    """(k, 2) pixels."""
    response: Float64
    """(k,) how much the right view looks like thread there: 1 as much as the left one."""


def match(
    chain: Chain, left: Float32, right: Float32, rig: StereoRig, swapped: bool = False
) -> Match:
    """Finds the thread of the left chain in the right view along the epipolar lines.

    Args:
        chain: the thread in the left view.
        left: (H, W, 2) left field.
        right: (H, W, 2) right field.
        rig: the cameras.
        swapped: look where the thread would be if the views had been taken for each other.
    """
    offset = rig.left.projection[0, 2] - rig.right.projection[0, 2]
    first = offset
    count = int((right.shape[1] - first) / _STATE_PX)
    if swapped:
        first = offset - _STATE_PX * count
    tangents = chain_tangents(chain.pixels)
    level = float(np.median(search.responses(left, chain.pixels, tangents)))
    costs = kernel.matching_costs(
        right, chain.pixels, tangents, first, _STATE_PX, count, max(level, _LEAST_LEVEL)
    )
    states, _ = kernel.cheapest_path(costs, _LARGEST_CHANGE, _PENALTY)
    disparity = first + _STATE_PX * states
    pixels = chain.pixels - np.c_[disparity, np.zeros(len(disparity))]
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] <= right.shape[1] - 1)
    response = 1.0 - costs[np.arange(len(states)), states].astype(float)
    return Match(pixels, np.where(inside, response, 0.0))


def chain_tangents(pixels: Float64, reach: int = 3) -> Float64:
    """(k, 2) unit tangents of a chain with points one pixel apart."""
    ahead = pixels[np.minimum(np.arange(len(pixels)) + reach, len(pixels) - 1)]
    behind = pixels[np.maximum(np.arange(len(pixels)) - reach, 0)]
    t = ahead - behind
    return t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-9)

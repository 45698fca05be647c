"""The corresponding points in the right view: disparities by continuity along the thread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization.growth import Chain
from suturetrack.kernels import matching as kernel
from suturetrack.types import Float32, Float64

_STATE_PX = 0.5
_LARGEST_CHANGE = 2
"""States a sample may differ from the one before."""
_PENALTY = 0.2
"""Cost of a state's change, against 1 for a sample without any ridge."""


@dataclass(frozen=True, eq=False)
class Match:
    """A chain with its counterpart in the right view."""

    right: Float64
    """(k, 2) pixels."""
    response: Float64
    """(k,) how much the right view looks like thread there, in [0, 1]."""


def match(chain: Chain, field: Float32, rig: StereoRig) -> Match:
    """Finds the thread of the left chain in the (H, W, 2) right field along the epipolar lines."""
    offset = rig.left.projection[0, 2] - rig.right.projection[0, 2]
    first = min(offset, 0.0)
    count = int((field.shape[1] - first) / _STATE_PX)
    tangents = chain_tangents(chain.pixels)
    costs = kernel.matching_costs(field, chain.pixels, tangents, first, _STATE_PX, count)
    states, _ = kernel.cheapest_path(costs, _LARGEST_CHANGE, _PENALTY)
    disparity = first + _STATE_PX * states
    right = chain.pixels - np.c_[disparity, np.zeros(len(disparity))]
    return Match(right, 1.0 - costs[np.arange(len(states)), states].astype(float))


def chain_tangents(pixels: Float64, reach: int = 3) -> Float64:
    """(k, 2) unit tangents of a chain with points one pixel apart."""
    ahead = pixels[np.minimum(np.arange(len(pixels)) + reach, len(pixels) - 1)]
    behind = pixels[np.maximum(np.arange(len(pixels)) - reach, 0)]
    t = ahead - behind
    return t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-9)

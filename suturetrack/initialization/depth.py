"""How far away an arm of ridge is: its disparities, looked for in the other view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.initialization.matching import disparities
from suturetrack.initialization.segments import chain_tangents
from suturetrack.kernels import search
from suturetrack.kernels.widths import moments
from suturetrack.types import Float32, Float64

_STATE_PX = 0.5
_PENALTY = 0.8
"""Cost of a state's change, against 1 for a sample without any ridge."""
_BEYOND_PX = 25.0
"""How far disparities may lie from those of the thread, px."""
_LEAST_RESPONSE = 0.45
"""Response of the other view, against the own one, from which a point has a disparity."""
_LEAST_SLOPE = 0.2
"""Sine of the angle to the epipolar lines from which a point has a disparity."""
_SKIPPED = 4
"""Points at the end of an arm that the other ridges of a junction may have drawn aside."""
_EVERY = 2
_LEAST_POINTS = 5
_NOISE_PX = 0.25
_ROW_NOISE_PX = 0.5
"""By how much the rows of two views may be off, px."""
_FINE = np.arange(-2.5, 2.51, 0.5)


@dataclass(frozen=True, eq=False)
class Disparities:
    """What is known of the depth of an arm, from its end inwards."""

    pixels: Float64
    """(k, 2)."""
    value: Float64
    """(k,) px."""
    variance: Float64
    """(k,) px^2."""


@dataclass(frozen=True, eq=False)
class Depth:
    """Finds arms of one view in the other, at disparities about those of the thread."""

    own: Float32
    """(H, W, 2) field of the arms' view."""
    other: Float32
    """(H, W, 2) field of the other view."""
    lowest: float
    """The least disparity u_own - u_other that is looked at, px."""
    states: int
    """How many of them, `_STATE_PX` apart."""

    @classmethod
    def around(cls, disparities: Float64, own: Float32, other: Float32) -> Depth:
        """Looks about (k,) disparities u_own - u_other, in px, of fields (H, W, 2)."""
        low, high = np.quantile(disparities, (0.02, 0.98))
        states = int((high - low + 2 * _BEYOND_PX) / _STATE_PX) + 1
        return cls(own, other, float(low) - _BEYOND_PX, states)

    def along(self, arm: Float64) -> Disparities | None:
        """The disparities of an arm, (k, 2) about 1 px apart; None where they cannot be told."""
        if len(arm) < 2 * _LEAST_POINTS:
            return None
        tangents = chain_tangents(arm)
        coarse, response = disparities(
            arm, self.own, self.other, self.lowest, _STATE_PX, self.states, _PENALTY
        )
        slope = abs(tangents[:, 1])
        told = (response > _LEAST_RESPONSE) & (slope > _LEAST_SLOPE)
        told[: min(_SKIPPED, len(arm) // 4)] = False
        chosen = np.flatnonzero(told)[::_EVERY]
        if len(chosen) < _LEAST_POINTS:
            return None
        value = self._refined(arm[chosen], tangents[chosen], coarse[chosen])
        squared = slope[chosen] ** 2
        variance = (_NOISE_PX**2 + _ROW_NOISE_PX**2 * (1 - squared)) / squared
        return Disparities(arm[chosen], value, variance)

    def _refined(self, pixels: Float64, tangents: Float64, coarse: Float64) -> Float64:
        """The centroids of the ridge about coarse disparities."""
        places = pixels[:, None] - (coarse[:, None] + _FINE)[..., None] * np.array([1.0, 0.0])
        repeated = np.repeat(tangents, len(_FINE), axis=0)
        profiles = search.responses(self.other, places.reshape(-1, 2), repeated)
        fine = np.tile(_FINE, (len(coarse), 1))
        return coarse + moments(profiles.reshape(fine.shape), fine)[0]

"""What it would cost to join two ends of segments: one smooth curve over ridge, at one strength."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from suturetrack.initialization.model import InitializationConfig
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.kernels import search
from suturetrack.types import Bool, Float64

Int64 = NDArray[np.int64]

_CLEAR = 2
"""Points at the very end of a segment that the other ridges of a junction have drawn aside."""
_HOOKED = 7
"""Points at the end of a segment that a highlight beside it may have drawn aside."""
_SHORT = 0.25
"""Price of a merge with a segment too short to have a direction."""
_SWING = 0.01
"""Price of a bridge that bends one way and then the other."""
_BRIDGE_SAMPLES = 12
TOUCHING_PX = 6.0
"""Ends this near over ridge belong together at any angle: a sharp bend."""
FREE_END = 0.5
"""Price of an end without a partner: two of them make the highest price of a merge."""


@dataclass(frozen=True, eq=False)
class Merge:
    """What joining pairs of ends would cost; end 2i is the start of segment i, 2i + 1 its end."""

    pairs: Int64
    """(m, 2)."""
    cost: Float64
    """(m,) 1 is the highest price that is paid."""
    touching: Bool
    """(m,) whether ridge joins the two ends, whatever their angle."""


@lru_cache(maxsize=4)  # Each view is asked about several times.
def price_merges(ridges: Ridges, config: InitializationConfig) -> Merge:
    """Prices every pair of ends within reach: whether one smooth curve runs through both segments,
    over ridge, at one strength."""
    looks = [
        [a for s in ridges.segments for a in (_arm(s, clear), _arm(s[::-1], clear))]
        for clear in (_CLEAR, _HOOKED)
    ]
    positions = np.array([a[0] for a in looks[0]])
    near = np.array([ridges.sample(a).mean() for a in looks[0]])
    # A highlight at a junction fades one arm of a segment, and not the segment.
    whole = np.repeat([np.median(ridges.sample(s)) for s in ridges.segments], 2)
    short = np.repeat([max(1 - len(s) / ARM, 0.0) for s in ridges.segments], 2)
    pairs = cKDTree(positions).query_pairs(2 * config.gap_px, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    cost, touching = np.empty(len(pairs)), np.zeros(len(pairs), bool)
    for k, (i, j) in enumerate(pairs):
        distance = float(np.linalg.norm(positions[j] - positions[i]))
        shape, weakest = _bridge_price(looks[0][i], looks[0][j], ridges, config)
        if shape > FREE_END and distance < 2 * TOUCHING_PX:
            shape = min(shape, _bridge_price(looks[1][i], looks[1][j], ridges, config)[0])
        ratio = min(abs(float(np.log(s[i] / s[j]))) for s in (near, whole))
        cost[k] = shape + 0.25 * ratio**2 + _SHORT * max(short[i], short[j])
        touching[k] = distance < TOUCHING_PX and weakest >= config.low
    return Merge(pairs, cost, touching)


def _arm(segment: Float64, clear: int) -> Float64:
    first = min(clear, len(segment) // 4)
    return segment[first : first + ARM - _CLEAR]


def _bridge_price(
    one: Float64, other: Float64, ridges: Ridges, config: InitializationConfig
) -> tuple[float, float]:
    """What a smooth curve through two arms costs by its shape and the ridge below it, and the least
    ||V|| between them."""
    misfit, swing, bridge = _common_curve(one, other)
    distance = float(np.linalg.norm(other[0] - one[0]))
    seen, weakest = _evidence(ridges, bridge, config)
    missing = (1 - seen) * distance / config.gap_px
    return misfit + _SWING * swing**2 + missing + 0.1 * distance / config.gap_px, weakest


def _common_curve(one: Float64, other: Float64) -> tuple[float, float, Float64]:
    """A cubic through both arms: its mean squared misfit, px^2, by how many radians per length its
    curvature changes over it, and the cubic between the arms."""
    distance = float(np.linalg.norm(other[0] - one[0]))
    t = np.r_[-np.arange(len(one), dtype=float), distance + np.arange(len(other))]
    scale = max(abs(t).max(), 1.0)
    design = np.vander(t / scale, 4)
    points = np.r_[one, other]
    coefficients, *_ = np.linalg.lstsq(design, points, rcond=None)
    misfit = float((((design @ coefficients - points) ** 2).sum(1)).mean())
    swing = 6 * float(np.linalg.norm(coefficients[0])) / scale**3 * float(np.ptp(t)) ** 2
    between = np.linspace(0, distance, _BRIDGE_SAMPLES) / scale
    return misfit, swing, np.vander(between, 4) @ coefficients


def _evidence(ridges: Ridges, bridge: Float64, config: InitializationConfig) -> tuple[float, float]:
    """Share of the bridge that is on ridge of its direction, and the least ||V|| on it."""
    tangents = np.gradient(bridge, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    along = search.responses(ridges.field, bridge, tangents)
    share = float(np.clip(along / config.high, 0, 1).mean())
    return share, float(ridges.sample(bridge).min())

"""What it would cost to join two ends of segments: one smooth curve over ridge, at one strength."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.kernels import search
from suturetrack.polylines import unit
from suturetrack.types import Bool, Float64, Int64

_CLEAR = 2
"""Points at the very end of a segment that the other ridges of a junction have drawn aside."""
_HOOKED = 7
"""Points at the end of a segment that a highlight beside it may have drawn aside."""
_SHORT = 0.25
"""Price of a merge with a segment too short to have a direction."""
_CLOSED = 0.4
"""Distance between the ends of a segment, against its length, below which it is a loop: a small one heads
another way after a few points."""
_SWING = 0.01
"""Price of a bridge that bends one way and then the other."""
_BRIDGE_SAMPLES = 12
_AT_ONCE = 4096
"""Pairs priced in one go, so that much clutter takes no more memory."""
STRAND, _STRAND_STRENGTH = 20, 0.5
"""Points, and strength against the average, from which a segment may be a part of a thread, and no speck
or rim."""
_TOGETHER_PX = 12.0
"""Distance up to which two ends may belong together at any angle: a sharp bend."""
FREE_END = 0.5
"""Price of an end without a partner."""
DEAR_END = 2.0
"""And where it may be no end: all that a view shows may be one thread, and that has but two."""
FEW_ENDS = 6
"""Ends without a partner, at most, of a view that shows hardly anything but a thread."""
HIGHEST = 2 * FREE_END
"""The highest price that is paid for a merge: that of the two ends without it."""


@dataclass(frozen=True, eq=False)
class Merges:
    """What joining pairs of ends would cost; end 2i is the start of segment i, 2i + 1 its end."""

    pairs: Int64
    """(m, 2)."""
    cost: Float64
    """(m,)."""
    alike: Bool
    """(m,) whether both are near and of strands as strong as any: a thread may turn round there."""

    @property
    def may_be_one_thread(self) -> Bool:
        """(m,) which are no dearer than two ends, or of ends that are alike."""
        return (self.cost < HIGHEST) | self.alike

    def where(self, kept: Bool) -> Merges:
        """Some of them, (m,)."""
        return Merges(self.pairs[kept], self.cost[kept], self.alike[kept])


@dataclass(frozen=True, eq=False)
class _Tips:
    """The last stretches of segments, one an end, from the end inwards."""

    points: Float64
    """(n, k, 2); what is shorter is filled up with its last point."""
    count: Int64
    """(n,) how many of the points count."""

    @classmethod
    def of(cls, segments: tuple[Float64, ...], clear: int) -> _Tips:
        """Two tips a segment, without the `clear` points at the very end."""
        tips = [a for s in segments for a in (_tip(s, clear), _tip(s[::-1], clear))]
        length = ARM - _CLEAR
        points = np.array([a[np.minimum(np.arange(length), len(a) - 1)] for a in tips])
        return cls(points, np.array([len(a) for a in tips]))

    def __getitem__(self, ends: Int64) -> _Tips:
        return _Tips(self.points[ends], self.count[ends])

    @property
    def counts(self) -> Bool:
        """(n, k) which points count."""
        return np.arange(self.points.shape[1]) < self.count[:, None]

    def strength(self, ridges: Ridges) -> Float64:
        """(n,) the mean ||V|| of each."""
        values = ridges.sample(self.points.reshape(-1, 2)).reshape(self.counts.shape)
        return (values * self.counts).sum(1) / self.count


@lru_cache(maxsize=4)  # Each view is asked about several times.
def price_merges(ridges: Ridges, config: InitializationConfig) -> Merges:
    """Prices every pair of ends within reach: whether one smooth curve runs through both segments,
    over ridge, at one strength."""
    tips = _Tips.of(ridges.segments, _CLEAR)
    near = tips.strength(ridges)
    # A highlight at a junction fades one arm of a segment, and not the segment.
    whole = np.repeat(ridges.strengths, 2)
    size = np.repeat([len(s) for s in ridges.segments], 2)
    short = np.maximum(1 - size / ARM, 0.0)
    positions = tips.points[:, 0]
    pairs = cKDTree(positions).query_pairs(2 * config.gap_px, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    i, j = pairs.T
    distance = np.linalg.norm(positions[j] - positions[i], axis=1)
    shape = _bridge_prices(tips, pairs, ridges, config)
    hooked = np.flatnonzero((shape > FREE_END) & (distance < _TOGETHER_PX))
    others = _bridge_prices(_Tips.of(ridges.segments, _HOOKED), pairs[hooked], ridges, config)
    shape[hooked] = np.minimum(shape[hooked], others)
    ratio = np.minimum(*(abs(np.log(s[i] / s[j])) for s in (near, whole)))
    cost = shape + 0.25 * ratio**2 + _SHORT * np.maximum(short[i], short[j])
    is_strand = (size >= STRAND) & (whole > _STRAND_STRENGTH * np.average(whole, weights=size))
    alike = (distance < _TOGETHER_PX) & is_strand[i] & is_strand[j]
    return Merges(pairs, cost, alike)


def _tip(segment: Float64, clear: int) -> Float64:
    first = min(clear, len(segment) // 4)
    tip = segment[first : first + ARM - _CLEAR]
    is_loop = np.linalg.norm(segment[-1] - segment[0]) < _CLOSED * len(segment)
    return tip[: max(len(segment) // 4, 3)] if is_loop else tip


def _bridge_prices(
    tips: _Tips, pairs: Int64, ridges: Ridges, config: InitializationConfig
) -> Float64:
    """(m,) what smooth curves through (m, 2) pairs of tips cost by their shape and the ridge below them."""
    parts = np.array_split(pairs, len(pairs) // _AT_ONCE + 1)
    return np.concatenate(
        [_bridge_price(tips[p[:, 0]], tips[p[:, 1]], ridges, config) for p in parts]
    )


def _bridge_price(
    one: _Tips, other: _Tips, ridges: Ridges, config: InitializationConfig
) -> Float64:
    misfit, swing, bridge = _common_curves(one, other)
    distance = np.linalg.norm(other.points[:, 0] - one.points[:, 0], axis=1)
    missing = (1 - _evidence(ridges, bridge, config)) * distance / config.gap_px
    return misfit + _SWING * swing**2 + missing + 0.1 * distance / config.gap_px


def _common_curves(one: _Tips, other: _Tips) -> tuple[Float64, Float64, Float64]:
    """Cubics through both of m pairs of tips: their mean squared misfits, px^2, by how many radians
    per length their curvatures change over them, and (m, k, 2) the cubics between the tips."""
    distance = np.linalg.norm(other.points[:, 0] - one.points[:, 0], axis=1)
    steps = np.arange(one.points.shape[1], dtype=float)
    t = np.c_[np.tile(-steps, (len(distance), 1)), distance[:, None] + steps]
    first, last = 1.0 - one.count, distance + other.count - 1
    scale = np.maximum(np.maximum(-first, last), 1.0)
    counts = np.c_[one.counts, other.counts].astype(float)
    design = _powers(t / scale[:, None])
    points = np.concatenate([one.points, other.points], axis=1)
    weighted = (design * counts[..., None]).swapaxes(1, 2)
    coefficients = np.linalg.solve(weighted @ design, weighted @ points)
    squared = ((design @ coefficients - points) ** 2).sum(2)
    misfit = (squared * counts).sum(1) / counts.sum(1)
    third = np.linalg.norm(coefficients[:, 0], axis=1)
    swing = 6 * third / scale**3 * (last - first) ** 2
    between = np.linspace(0, 1, _BRIDGE_SAMPLES) * (distance / scale)[:, None]
    return misfit, swing, _powers(between) @ coefficients


def _powers(t: Float64) -> Float64:
    return np.stack([t**3, t**2, t, np.ones_like(t)], axis=-1)


def _evidence(ridges: Ridges, bridges: Float64, config: InitializationConfig) -> Float64:
    """(m,) share of each of (m, k, 2) bridges that is on ridge of its direction."""
    tangents = unit(np.gradient(bridges, axis=1))
    flat = bridges.reshape(-1, 2)
    along = search.responses(ridges.field, flat, tangents.reshape(-1, 2))
    return np.asarray(np.clip(along.reshape(bridges.shape[:2]) / config.high, 0, 1).mean(1))

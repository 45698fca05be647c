"""Merging segments into threads by the distance and the angle of their ends (Fig. 3b)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from suturetrack.initialization.model import InitializationConfig
from suturetrack.initialization.segments import Ends, Ridges, find_ends
from suturetrack.types import Bool, Float64

_TOUCHING_PX = 6.0
"""Ends this near over ridge belong together at any angle: a sharp bend."""


def merge_ends(ridges: Ridges, config: InitializationConfig) -> dict[int, int]:
    """Pairs up the ends that match best; end 2i is the start of segment i, 2i + 1 its end."""
    if not ridges.segments:
        return {}
    ends = find_ends(ridges)
    pairs = cKDTree(ends.positions).query_pairs(config.gap_px, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    if len(pairs) == 0:
        return {}
    cost, touching = _merge_costs(ridges, ends, pairs, config)
    partner: dict[int, int] = {}
    for wanted in (cost < 1, touching):
        for k in np.argsort(cost):
            i, j = (int(e) for e in pairs[k])
            if wanted[k] and i not in partner and j not in partner:
                partner[i], partner[j] = j, i
    return partner


def follow(start: int, partner: dict[int, int]) -> list[int]:
    """The ends at which the segments of a thread are entered, in order, from one of its ends to the
    other; `start` is a segment on it."""
    entry = 2 * start
    seen = {start}
    while entry in partner and partner[entry] // 2 not in seen:
        entry = partner[entry] ^ 1
        seen.add(entry // 2)
    entries, seen = [entry], {entry // 2}
    while (leave := entries[-1] ^ 1) in partner and partner[leave] // 2 not in seen:
        entries.append(partner[leave])
        seen.add(entries[-1] // 2)
    return entries


def _merge_costs(
    ridges: Ridges, ends: Ends, pairs: NDArray[np.int64], config: InitializationConfig
) -> tuple[Float64, Bool]:
    """What each joint costs, 1 being the most that is accepted, and whether the ends touch."""
    i, j = pairs.T
    positions, outward = ends.positions, ends.outward
    across = positions[j] - positions[i]
    distance = np.linalg.norm(across, axis=1)
    direction = across / np.maximum(distance, 1e-9)[:, None]
    turn = _angle(outward[i], -outward[j])
    aside = np.maximum(_angle(outward[i], direction), _angle(-outward[j], direction))
    # Where the ends are close the way across has no direction of its own.
    sure = np.clip((distance - 1.5) / 4, 0, 1)
    share = np.linspace(0, 1, 9)[None, :, None]
    bridge = positions[i][:, None] + share * across[:, None]
    seen = np.clip(ridges.sample(bridge.reshape(-1, 2)).reshape(-1, 9) / config.high, 0, 1)
    missing = (1 - seen.mean(1)) * distance
    limit = np.radians(config.merge_angle_deg) / (1 + missing / config.gap_px)
    cost = (turn / limit) ** 2 + sure * (aside / limit) ** 2 + missing / config.gap_px
    cost += 0.3 * distance / config.gap_px
    cost += 0.5 * np.log(ends.strengths[i] / ends.strengths[j]) ** 2
    touching = (distance < _TOUCHING_PX) & (seen.min(1) * config.high >= config.low)
    return cost, touching


def _angle(a: Float64, b: Float64) -> Float64:
    return np.arccos(np.clip((a * b).sum(1), -1, 1))

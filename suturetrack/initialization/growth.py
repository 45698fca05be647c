"""The growth of eq. (3): from the seed over the ridges of the thread in one view."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.result import ViewGrowth
from suturetrack.initialization.segments import Ridges
from suturetrack.initialization.threads import Thread
from suturetrack.kernels import growth as kernel
from suturetrack.polylines import nearest_index
from suturetrack.types import Float32, Float64


def grow_thread(thread: Thread, seed: Float64, config: InitializationConfig) -> ViewGrowth:
    """Grows by eq. (3) from the seed (2,) over the ridges of the thread."""
    ridges, pieces = thread.ridges, thread.pieces
    on_thread = [e // 2 for e in thread.entries]
    merges = np.array([(a[-1], b[0]) for a, b in pairwise(pieces)])
    cost = _grow(ridges, pieces, on_thread.index(thread.origin), seed, config)
    reached = [k for k, s in enumerate(ridges.segments) if _is_reached(s, cost)]
    rejected = tuple(
        (ridges.segments[k], "branches off without a matching end")
        for k in reached
        if k not in on_thread
    )
    segments = tuple(ridges.segments[k] for k in reached)
    return ViewGrowth(cost, segments, merges.reshape(-1, 2, 2), rejected)


def _grow(
    ridges: Ridges, pieces: list[Float64], first: int, seed: Float64, config: InitializationConfig
) -> Float32:
    """Cost image; where a merge bridges a gap the growth starts anew on the other side."""
    cost = np.full(ridges.magnitude.shape, np.inf, np.float32)

    def start(point: Float64, at: float) -> None:
        u, v = np.rint(point).astype(int)
        kernel.grow(ridges.magnitude, u, v, at, config.rho, ridges.low, cost)

    def value(point: Float64) -> float:
        u, v = np.rint(point).astype(int)
        return float(cost[v, u])

    origin = pieces[first]
    start(origin[nearest_index(origin, seed)], 0.0)
    ahead = list(pairwise(pieces[first:]))
    behind = [(b[::-1], a[::-1]) for a, b in pairwise(pieces[: first + 1])][::-1]
    for one, other in ahead + behind:
        bridge = float(np.linalg.norm(other[0] - one[-1])) / ridges.low**config.rho
        start(other[0], value(one[-1]) + bridge)
    return cost


def _is_reached(segment: Float64, cost: Float32) -> bool:
    u, v = np.rint(segment).astype(int).T
    return bool(np.isfinite(cost[v, u]).mean() > 0.5)

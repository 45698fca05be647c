"""The growth of eq. (3)."""

from __future__ import annotations

import heapq

import numba
import numpy as np

from suturetrack.types import Float32


@numba.njit(cache=True, nogil=True)
def grow(
    magnitude: Float32, u: int, v: int, start: float, rho: float, low: float, cost: Float32
) -> None:
    """Lowers `cost` to that of eq. (3) wherever a path from the pixel over ||V|| >= low is cheaper.

    Args:
        magnitude: (H, W) ||V_o||.
        u: column of the origin; it is taken in whatever its magnitude.
        v: row of the origin.
        start: cost of the origin: 0 for the seed.
        rho: exponent of eq. (3).
        low: pixels below are not entered.
        cost: (H, W), infinite where nothing has grown yet; changed in place.
    """
    height, width = magnitude.shape
    if start >= cost[v, u]:
        return
    cost[v, u] = start
    front = [(np.float32(start), v, u)]
    while front:
        here, y, x = heapq.heappop(front)
        if here > cost[y, x]:
            continue
        for j in range(max(y - 1, 0), min(y + 2, height)):
            for i in range(max(x - 1, 0), min(x + 2, width)):
                m = magnitude[j, i]
                if m < low:
                    continue
                step = np.sqrt(np.float32((j - y) ** 2 + (i - x) ** 2))
                there = np.float32(here + step / m**rho)
                if there < cost[j, i]:
                    cost[j, i] = there
                    heapq.heappush(front, (there, j, i))

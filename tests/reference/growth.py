"""Eq. (3), the costs of disparities and those of a path through them, word for word."""

from __future__ import annotations

import itertools

import numpy as np

from suturetrack.types import Float32, Float64
from tests.reference.curve_fit import response


def grow(magnitude: Float32, u: int, v: int, rho: float, low: float) -> Float64:
    """L of eq. (3) from pixel (u, v): every pixel again, until nothing changes."""
    height, width = magnitude.shape
    cost = np.full((height, width), np.inf)
    cost[v, u] = 0.0
    changed = True
    while changed:
        changed = False
        for j, i in itertools.product(range(height), range(width)):
            for iy, ix in itertools.product((-1, 0, 1), repeat=2):
                y, x = j + iy, i + ix
                if not (0 <= y < height and 0 <= x < width) or magnitude[y, x] < low:
                    continue
                there = cost[j, i] + np.hypot(ix, iy) / float(magnitude[y, x]) ** rho
                if there < cost[y, x] - 1e-9:
                    cost[y, x] = there
                    changed = True
    return cost


def matching_costs(
    field: Float32,
    pixels: Float64,
    tangents: Float64,
    first: float,
    step: float,
    count: int,
    level: float,
) -> Float64:
    """See `suturetrack.kernels.matching.matching_costs`."""
    costs = np.full((len(pixels), count), 0.5)
    for k, state in np.ndindex(costs.shape):
        u, v = pixels[k, 0] - first - step * state, pixels[k, 1]
        if 0 <= u <= field.shape[1] - 1:
            costs[k, state] = max(1 - response(field, u, v, tangents[k]) / level, 0)
    return costs


def path_cost(costs: Float32, states: tuple[int, ...], penalty: float) -> float:
    """What the path through `states` costs."""
    own = sum(float(costs[k, s]) for k, s in enumerate(states))
    return own + penalty * sum(abs(a - b) for a, b in itertools.pairwise(states))

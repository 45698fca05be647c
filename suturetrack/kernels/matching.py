"""Disparities along a thread by dynamic programming."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from suturetrack.types import Float32, Float64

Int64 = NDArray[np.int64]


@numba.njit(cache=True, nogil=True)
def matching_costs(
    field: Float32, pixels: Float64, tangents: Float64, first: float, step: float, count: int
) -> Float32:
    """(k, count) 1 - ||V|| weighed by direction at the place in the right view of each disparity.

    Args:
        field: (H, W, 2) right view.
        pixels: (k, 2) along the thread in the left view.
        tangents: (k, 2) unit tangents there.
        first: the disparity u_left - u_right of state 0, px.
        step: px from state to state.
        count: number of states.
    """
    height, width, _ = field.shape
    costs = np.ones((len(pixels), count), np.float32)
    for k in range(len(pixels)):
        row = int(np.floor(pixels[k, 1]))
        if row < 0 or row >= height - 1:
            continue
        fv = pixels[k, 1] - row
        for state in range(count):
            u = pixels[k, 0] - first - step * state
            column = int(np.floor(u))
            if column < 0 or column >= width - 1:
                continue
            fu = u - column
            total = 0.0
            for j in range(2):
                for i in range(2):
                    x, y = field[row + j, column + i, 0], field[row + j, column + i, 1]
                    length = np.sqrt(x * x + y * y)
                    if length > 0:
                        along = tangents[k, 0] * x + tangents[k, 1] * y
                        share = (fv if j else 1 - fv) * (fu if i else 1 - fu)
                        total += share * 0.5 * (length + along * along / length)
            costs[k, state] = max(1 - total, 0.0)
    return costs


@numba.njit(cache=True, nogil=True)
def cheapest_path(costs: Float32, reach: int, penalty: float) -> tuple[Int64, float]:
    """(k,) states of the cheapest path through (k, m) costs, and its total cost.

    A change of the state by i costs i * penalty; it may be `reach` at most.
    """
    samples, count = costs.shape
    total = costs[0].copy()
    came = np.zeros((samples, count), np.int16)
    for k in range(1, samples):
        before = total.copy()
        for state in range(count):
            best, step = np.float32(np.inf), 0
            for i in range(max(-reach, -state), min(reach, count - 1 - state) + 1):
                candidate = before[state + i] + np.float32(penalty * abs(i))
                if candidate < best or (candidate == best and abs(i) < abs(step)):
                    best, step = candidate, i
            total[state] = best + costs[k, state]
            came[k, state] = step
    states = np.empty(samples, np.int64)
    states[-1] = np.argmin(total)
    for k in range(samples - 1, 0, -1):
        states[k - 1] = states[k] + came[k, states[k]]
    return states, float(total.min())

"""Disparities along a thread by dynamic programming."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.types import Float32, Float64, Int64

UNSEEN = 0.5
"""Cost of a place that lies outside the other image."""


@numba.njit(cache=True, nogil=True)
def matching_costs(
    field: Float32,
    pixels: Float64,
    tangents: Float64,
    first: float,
    step: float,
    count: int,
    level: float,
) -> Float32:
    """(k, count) 1 where the other view shows no thread at a disparity, 0 where it surely does.

    Args:
        field: (H, W, 2) other view.
        pixels: (k, 2) along the thread in its own view.
        tangents: (k, 2) unit tangents there.
        first: the disparity u_own - u_other of state 0, px.
        step: px from state to state.
        count: number of states.
        level: response of eq. (4) that a thread is known to give.
    """
    width = field.shape[1]
    costs = np.empty((len(pixels), count), np.float32)
    line = np.zeros(width)
    for k in range(len(pixels)):
        u, v = pixels[k]
        # All states of a pixel lie in one row: its columns are looked at once.
        least = min(max(int(u - first - step * (count - 1)), 0), width - 2)
        most = min(int(u - first) + 1, width - 1)
        _respond(field, v, tangents[k, 0], tangents[k, 1], least, most, line)
        for state in range(count):
            across = u - first - step * state
            if 0 <= across <= width - 1:
                column = min(int(across), width - 2)
                share = across - column
                response = (1 - share) * line[column] + share * line[column + 1]
                costs[k, state] = max(1 - response / level, 0.0)
            else:
                costs[k, state] = UNSEEN
    return costs


@numba.njit(cache=True, nogil=True)
def _respond(
    field: Float32, v: float, tu: float, tv: float, least: int, most: int, line: Float64
) -> None:
    """Fills `line`, (W,), from column `least` to `most` with the responses in row `v`."""
    height = field.shape[0]
    row = min(max(int(v), 0), height - 2)
    lower = v - row
    for column in range(least, most + 1):
        line[column] = 0.0
        if 0 <= v <= height - 1:
            for i in range(2):
                x, y = field[row + i, column, 0], field[row + i, column, 1]
                squared = x * x + y * y
                if squared > 0:
                    along = tu * x + tv * y
                    share = lower if i else 1 - lower
                    line[column] += share * along * along / np.sqrt(squared)


@numba.njit(cache=True, nogil=True)
def cheapest_path(costs: Float32, reach: int, penalty: float) -> Int64:
    """(k,) states of the cheapest path through (k, m) costs.

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
    return states

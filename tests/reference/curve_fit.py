"""Literal twins of the kernels that track: dense matrices, one pixel at a time."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import BSpline


def design(s: np.ndarray, knots: np.ndarray, times: int = 0) -> np.ndarray:
    """(k, n + 1) cubic basis functions or their derivatives."""
    count = len(knots) - 4
    return np.stack([BSpline(knots, np.eye(count)[i], 3)(s, times) for i in range(count)], axis=1)


def normal_equations(
    a: np.ndarray, information: np.ndarray, pull: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Dense normal equations of the step of the control points, coordinates together."""
    count = a.shape[1]
    matrix, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for row, block, goal in zip(a, information, pull, strict=True):
        spread = np.kron(row[:, None], np.eye(3))
        matrix += spread @ block @ spread.T
        right += spread @ goal
    return matrix, right


def response(field: np.ndarray, u: float, v: float, tangent: np.ndarray) -> float:
    """(t.V)^2 / |V| at one place, from its four pixels."""
    height, width, _ = field.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0
    total = 0.0
    for row, column in itertools.product(range(height), range(width)):
        share = max(0.0, 1 - abs(u - column)) * max(0.0, 1 - abs(v - row))
        vector = field[row, column].astype(float)
        if share > 0 and np.any(vector):
            total += share * (vector @ tangent) ** 2 / np.linalg.norm(vector)
    return total


def best_path(gain: np.ndarray, stiffness: float, reach: int) -> float:
    """What the best path is worth, by trying all."""
    count, width = gain.shape
    best = -np.inf
    for path in itertools.product(range(width), repeat=count):
        steps = np.diff(path)
        if np.all(np.abs(steps) <= reach):
            value = gain[np.arange(count), list(path)].sum() - stiffness * (steps**2).sum()
            best = max(best, float(value))
    return best

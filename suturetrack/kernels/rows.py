"""Rows of a Gauss-Newton step: what is asked of each sample's own offset in space.

A row is weighed by what it counts, and rows of a sample are summed as `information`, (k, 3, 3) outer
products of the rows, and `pull`, (k, 3) rows times what they should become.
"""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.types import Float64


@numba.njit(cache=True, nogil=True)
def held_rows(
    jacobians: tuple[Float64, Float64], goal: Float64, by_pixels: Float64, in_space: Float64
) -> tuple[Float64, Float64]:
    """Rows that ask for an offset: by its pixels in both images, and by its length in space.

    Args:
        jacobians: (k, 2, 3) derivatives of the pixel, left and right.
        goal: (k, 3) the offset.
        by_pixels: (k,) weights of the offset in the images, 1 / px^2.
        in_space: (k,) weights of the offset itself, 1 / unit^2.

    Returns:
        information and pull.
    """
    left, right = jacobians
    information, pull = np.zeros((len(goal), 3, 3)), np.zeros((len(goal), 3))
    for j in range(len(goal)):
        for a in range(3):
            for b in range(3):
                total = 0.0
                for i in range(2):
                    total += left[j, i, a] * left[j, i, b] + right[j, i, a] * right[j, i, b]
                information[j, a, b] = by_pixels[j] * total
            information[j, a, a] += in_space[j]
            for b in range(3):
                pull[j, a] += information[j, a, b] * goal[j, b]
    return information, pull


@numba.njit(cache=True, nogil=True)
def add_measured_rows(
    tangents: Float64,
    jacobian: Float64,
    weight: Float64,
    offset: Float64,
    information: Float64,
    pull: Float64,
) -> None:
    """Adds the rows n . J d = offset of one image, n the normal (-tv, tu).

    Args:
        tangents: (k, 2) unit tangents.
        jacobian: (k, 2, 3) derivative of the pixel.
        weight: (k,) 1 / px^2.
        offset: (k,) px along the normal.
        information, pull: added to.
    """
    row = np.empty(3)
    for j in range(len(weight)):
        if weight[j] == 0:
            continue
        for a in range(3):
            row[a] = tangents[j, 0] * jacobian[j, 1, a] - tangents[j, 1] * jacobian[j, 0, a]
        for a in range(3):
            weighted = weight[j] * row[a]
            pull[j, a] += weighted * offset[j]
            for b in range(3):
                information[j, a, b] += weighted * row[b]


@numba.njit(cache=True, nogil=True)
def shape_rows(
    first: Float64, goal: Float64, bending: Float64, stretch: Float64
) -> tuple[Float64, Float64]:
    """Rows that ask for a change of the second derivative: in all directions, and along the curve.

    Args:
        first: (k, 3) derivative of the curve, of which only the direction counts.
        goal: (k, 3) the change.
        bending, stretch: (k,) weights of the change, and of its part along the curve.

    Returns:
        information and pull.
    """
    information, pull = np.zeros((len(goal), 3, 3)), np.zeros((len(goal), 3))
    for j in range(len(goal)):
        x, y, z = first[j, 0], first[j, 1], first[j, 2]
        along = stretch[j] / max(x * x + y * y + z * z, np.finfo(np.float64).tiny)
        for a in range(3):
            for b in range(3):
                information[j, a, b] = along * first[j, a] * first[j, b]
            information[j, a, a] += bending[j]
            for b in range(3):
                pull[j, a] += information[j, a, b] * goal[j, b]
    return information, pull

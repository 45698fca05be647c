"""What the field answers along a curve: the energies of the paper, and the level of a clear view."""

from __future__ import annotations

import math

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.tracking.sampling import Samples, View, views, views_at
from suturetrack.types import Energies, Float32, Float64, Nurbs, RidgeField

# About so many pixels of an image tell the mean of all.
_TELLING = 1200


def energies(
    curve: Nurbs, field: RidgeField, rig: StereoRig, levels: tuple[float, float]
) -> Energies:
    """Eqs. (4) and (7) of the curve in the field, and its bending.

    Args:
        levels: response of a clear view of the thread, left and right.
    """
    samples = Samples.of(curve.knots, 5)
    points, first, second = (samples.values(curve.control_points, d) for d in range(3))
    images = [
        -float(np.sum(samples.share * view.responses(image)))
        for image, view in zip((field.left, field.right), views(rig, points, first), strict=True)
    ]
    return Energies(
        images[0], images[1], _end(curve, field, rig, levels), _bending(first, second, samples)
    )


def measure_levels(curve: Nurbs, field: RidgeField, rig: StereoRig) -> tuple[float, float]:
    """Median response along a curve that lies on the thread, left and right."""
    return levels_along(Samples.of(curve.knots, 5).views(rig, curve.control_points), field)


def levels_along(both: tuple[View, View], field: RidgeField) -> tuple[float, float]:
    """Median response at samples that lie on the thread, left and right."""
    left, right = (
        float(np.median(view.responses(image)))
        for image, view in zip((field.left, field.right), both, strict=True)
    )
    return max(left, 0.05), max(right, 0.05)


def cutoff(image: Float32, level: float) -> float:
    """|V_c| of eq. (7): midway between the mean magnitudes of the thread and of the background."""
    stride = max(math.isqrt(image.shape[0] * image.shape[1] // _TELLING), 1)
    sparse = image[::stride, ::stride]
    return (level + float(np.hypot(sparse[..., 0], sparse[..., 1]).mean())) / 2


def _end(curve: Nurbs, field: RidgeField, rig: StereoRig, levels: tuple[float, float]) -> float:
    both = views_at(rig, curve, np.array([0.0, 1.0]))
    return sum(
        float(np.sum((view.responses(image) - cutoff(image, level)) ** 2))
        for image, view, level in zip((field.left, field.right), both, levels, strict=True)
    )


def _bending(first: Float64, second: Float64, samples: Samples) -> float:
    squared, along, power = (
        np.einsum("ij,ij->i", a, b) for a, b in ((first, first), (first, second), (second, second))
    )
    squared = np.maximum(squared, np.finfo(float).tiny)
    lengths = np.sqrt(squared) * samples.share
    # |f' x f''|^2 by Lagrange's identity.
    squared_curvature = (squared * power - along**2) / squared**3
    return float(np.sum(lengths)) * float(np.sum(squared_curvature * lengths))

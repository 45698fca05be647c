"""What the field answers along a curve: the energies of the paper, and the level of a clear view."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.tracking.sampling import Samples, views
from suturetrack.types import Energies, Float64, Nurbs, RidgeField


def energies(
    curve: Nurbs, field: RidgeField, rig: StereoRig, cutoffs: tuple[float, float]
) -> Energies:
    """Eqs. (4) and (7) of the curve in the field, and its bending.

    Args:
        cutoffs: |V_c| of eq. (7), left and right.
    """
    samples = Samples.of(curve.knots, 5)
    points, first, second = (samples.values(curve.control_points, d) for d in range(3))
    images = [
        -float(np.sum(samples.share * view.responses(image)))
        for image, view in zip((field.left, field.right), views(rig, points, first), strict=True)
    ]
    return Energies(
        images[0], images[1], _end(curve, field, rig, cutoffs), _bending(first, second, samples)
    )


def measure_levels(curve: Nurbs, field: RidgeField, rig: StereoRig) -> tuple[float, float]:
    """Median response along a curve that lies on the thread, left and right."""
    samples = Samples.of(curve.knots, 5)
    both = samples.views(rig, curve.control_points)
    left, right = (
        float(np.median(view.responses(image)))
        for image, view in zip((field.left, field.right), both, strict=True)
    )
    return max(left, 0.05), max(right, 0.05)


def _end(curve: Nurbs, field: RidgeField, rig: StereoRig, cutoffs: tuple[float, float]) -> float:
    ends = Samples.at(curve.knots, np.array([0.0, 1.0]))
    both = ends.views(rig, curve.control_points)
    return sum(
        float(np.sum((view.responses(image) - cutoff) ** 2))
        for image, view, cutoff in zip((field.left, field.right), both, cutoffs, strict=True)
    )


def _bending(first: Float64, second: Float64, samples: Samples) -> float:
    speed = np.maximum(np.linalg.norm(first, axis=1), np.finfo(float).tiny)
    curvature = np.linalg.norm(np.cross(first, second), axis=1) / speed**3
    length = float(np.sum(speed * samples.share))
    return length * float(np.sum(curvature**2 * speed * samples.share))

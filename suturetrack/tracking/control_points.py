"""Control points by need: more in bends, fewer on straights, the curve unchanged (Section VI-D.1)."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import spline
from suturetrack.nurbs import clamped_knots, curve_from, insert_knot
from suturetrack.tracking.sampling import Samples, View, distinct, values_at, views
from suturetrack.types import Float64, Nurbs

# A span of length h on a circle of radius r is off by about h^4 / (384 r^3).
_TOLERANCE_PX = 0.05
_SPACING_PX = (8.0, 32.0)
_MOST = 120
_CROWDED = 1.0
_SPARSE = 1.5


def rearrange(curve: Nurbs, rig: StereoRig) -> tuple[Nurbs, int, int]:
    """Inserts and removes knots where the shape of a cubic 3-D curve asks for it.

    Returns:
        The curve, and how many control points were inserted and removed.
    """
    width, wanted = _spans(curve, rig)
    crowded = _crowded(width, wanted)
    if crowded:
        curve = refit(curve, np.delete(distinct(curve.knots)[1:-1], crowded))
        width, wanted = _spans(curve, rig)
    edges = distinct(curve.knots)
    sparse = np.flatnonzero(width > _SPARSE * wanted)
    for i in sparse:
        curve = insert_knot(curve, float(edges[i] + edges[i + 1]) / 2)
    return curve, len(sparse), len(crowded)


def refit(curve: Nurbs, interior: Float64) -> Nurbs:
    """The closest cubic curve on other interior knots; exact where they contain the curve's own."""
    knots = clamped_knots(interior, 3)
    every = np.unique(np.r_[knots, curve.knots])
    s = (every[:-1, None] + np.diff(every)[:, None] * np.linspace(0, 1, 6)).ravel()
    s[[0, -1]] = 0.0, 1.0
    return through(knots, s, values_at(curve, s))


def through(knots: Float64, s: Float64, points: Float64) -> Nurbs:
    """The cubic curve closest to (k, 3) points at (k,) parameters, between the first and the last."""
    weight = np.ones(len(s))
    weight[[0, -1]] = 1e6
    information = weight[:, None, None] * np.eye(3)
    return curve_from(spline.DEGREE, knots, spline.closest(knots, s, points, information))


def _spans(curve: Nurbs, rig: StereoRig) -> tuple[Float64, Float64]:
    """Length of each span, and the length that its bend asks for, px."""
    samples = Samples.of(curve.knots, 3)
    points, first, second = (samples.values(curve.control_points, d) for d in range(3))
    both = views(rig, points, first)
    speed = np.maximum(sum(view.speed for view in both) / 2, 1e-9)
    width = (speed * samples.share).reshape(-1, 3).sum(axis=1)
    curvature = np.maximum(_curvature(both[0], second), _curvature(both[1], second))
    sharpest = curvature.reshape(-1, 3).max(axis=1)
    wanted = np.clip((384 * _TOLERANCE_PX / np.maximum(sharpest, 1e-6) ** 3) ** 0.25, *_SPACING_PX)
    return width, np.maximum(wanted, width.sum() / _MOST)


def _curvature(view: View, second: Float64) -> Float64:
    """(k,) of the image curve, 1/px; the depth, which is noisier, has no say in it."""
    across = np.einsum("ki,kij,kj->k", view.normals, view.jacobian, second)
    return np.abs(across) / np.maximum(view.speed, 1e-9) ** 2


def _crowded(width: Float64, wanted: Float64) -> list[int]:
    """Interior knots to remove, never two neighbours at once."""
    merged, needed = width[:-1] + width[1:], np.minimum(wanted[:-1], wanted[1:])
    chosen: list[int] = []
    for i in np.flatnonzero(merged < _CROWDED * needed).tolist():
        if not chosen or chosen[-1] < i - 1:
            chosen.append(i)
    return chosen

"""Control points kept evenly spaced along the curve (Section VI-D.1)."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import spline
from suturetrack.nurbs import clamped_knots, evaluate, evenly_spaced
from suturetrack.polylines import polyline_length
from suturetrack.tracking.control_points import through
from suturetrack.types import Float64, Nurbs

# Clamped knots draw the outermost control points of an even curve together by these factors.
_CLAMPED = (3.0, 1.5)
_SAMPLES_PER_SPAN = 6


def respace(
    curve: Nurbs, rig: StereoRig, spacing_px: tuple[float, float]
) -> tuple[Nurbs, int, int]:
    """Spaces the control points evenly where two neighbours are too close together or too far apart.

    Args:
        curve: cubic.
        rig: the cameras, in whose images the gaps are measured.
        spacing_px: range of the gaps.

    Returns:
        The curve, and how many control points were inserted and removed.
    """
    gaps = _gaps(curve, rig)
    least, most = spacing_px
    if gaps.min() >= least and gaps.max() <= most:
        return curve, 0, 0
    spans = max(round(_length_px(curve, rig) / np.sqrt(least * most)), 1)
    change = spans + spline.DEGREE - len(curve.control_points)
    return evenly(curve, spans), max(change, 0), max(-change, 0)


def evenly(curve: Nurbs, spans: int) -> Nurbs:
    """The closest curve of so many spans that is parametrised like its arc length."""
    count = _SAMPLES_PER_SPAN * spans + 1
    points = evaluate(curve, evenly_spaced(curve, count))
    knots = clamped_knots(np.linspace(0, 1, spans + 1)[1:-1], spline.DEGREE)
    return through(knots, np.linspace(0, 1, count), points)


def _gaps(curve: Nurbs, rig: StereoRig) -> Float64:
    """(n,) px between neighbouring control points, as if the knots were not clamped."""
    left, right = rig.project(curve.control_points)
    gaps: Float64 = np.linalg.norm(np.diff((left + right) / 2, axis=0), axis=1)
    for i, factor in enumerate(_CLAMPED):
        if len(gaps) > 2 * i + 1:
            gaps[[i, -1 - i]] *= factor
    return gaps


def _length_px(curve: Nurbs, rig: StereoRig) -> float:
    left, right = rig.project(evaluate(curve, np.linspace(0, 1, 4 * len(curve.control_points))))
    return polyline_length((left + right) / 2)

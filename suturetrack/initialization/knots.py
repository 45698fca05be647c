"""Splines through places: as many knots as marks ask for, and as few as the images allow."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from suturetrack import nurbs
from suturetrack.initialization.samples import Samples, gram
from suturetrack.kernels import spline
from suturetrack.types import Float64, Nurbs

_LEAST_SAMPLES = 3
_SIGNIFICANT = 25.0
"""Growth of a span's misfit, in units of the noise, that calls for a knot; four more unknowns grow
with it, and neighbouring samples err alike."""
_RIDGE = 1e-9
_STAY_DEEP = 3e-5
"""Weight, against that of a crest, of no weight where the crests tell, which keeps the disparity of
samples where they do not."""


def image_parameters(left: Float64, right: Float64) -> Float64:
    """(k,) parameters from 0 to 1 in proportion to the mean length of the (k, 2) chains."""
    steps = [np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (left, right)]
    travelled = np.r_[0, np.cumsum(steps[0] + steps[1])]
    return travelled / travelled[-1]


def fit_marks(points: Float64, s: Float64, spans: int) -> Nurbs:
    """Least-squares curve through (k, 3) stereo points at parameters `s` (end of Section V)."""
    interior = np.linspace(0, 1, spans + 1)[1:-1]
    return _closest(interior, s, points, np.tile(np.eye(3), (len(s), 1, 1)))


def with_needed_knots(samples: Samples) -> Nurbs:
    """A curve through the samples with as few knots as the crests allow.

    Spans are halved, by misfit, until none fits the crests significantly worse than the samples do.
    An end along an epipolar line has the depth of the samples: the crests say nothing of it.
    """
    deep = _STAY_DEEP * gram(samples.image_axes[:, 2:])
    places = samples.crest_information() + samples.rest_information() + deep
    interior = np.array([0.5])
    while True:
        curve = _closest(interior, samples.s, samples.points, places)
        new = _splits(samples.s, _excess(curve, samples) / samples.variance, interior)
        if not new:
            return curve
        interior = np.sort(np.r_[interior, new])


def _excess(curve: Nurbs, samples: Samples) -> Float64:
    """(k,) by how much more the squared offsets from the crests are than those of the samples, px^2."""
    moved = nurbs.evaluate(curve, samples.s) - samples.points
    excess = np.zeros(len(samples.s))
    for crest, rows in zip(samples.crests, samples.crest_rows(), strict=True):
        shift = np.einsum("ki,ki->k", rows, moved)
        excess += crest.trust * ((crest.offsets - shift) ** 2 - crest.offsets**2)
    return excess


def _splits(s: Float64, excess: Float64, interior: Float64) -> list[float]:
    """Where spans with too much misfit are to be divided."""
    bounds = [0, *np.searchsorted(s, interior).tolist(), len(s)]
    new = []
    for a, b in pairwise(bounds):
        if b - a < 2 * _LEAST_SAMPLES or excess[a:b].sum() < _SIGNIFICANT:
            continue
        grown = np.cumsum(np.maximum(excess[a:b], 0))
        middle = int(np.searchsorted(grown, grown[-1] / 2))
        new.append(float(s[a + min(max(middle, _LEAST_SAMPLES), b - a - _LEAST_SAMPLES)]))
    return new


def _closest(interior: Float64, s: Float64, points: Float64, information: Float64) -> Nurbs:
    """The curve closest to (k, 3) points where (k, 3, 3) `information` says that it matters."""
    knots = nurbs.clamped_knots(interior, spline.DEGREE)
    control_points = spline.closest(knots, s, points, information, _RIDGE)
    return nurbs.curve_from(spline.DEGREE, knots, control_points)

"""Splines through places: as many knots as marks ask for, and as few as the images allow."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from suturetrack import nurbs
from suturetrack.initialization.samples import Samples
from suturetrack.kernels import spline
from suturetrack.types import Float64, Nurbs

_LEAST_SAMPLES = 3
_SIGNIFICANT = 12.0
"""Growth of a span's misfit, in units of the noise, that calls for a knot; four more unknowns grow
with it, and neighbouring samples err alike."""
_RIDGE = 1e-9

Term = tuple[int, Float64, Float64]
"""The order of a derivative, (k, 3, 3) how much it matters at each of k parameters, and (k, 3) its values."""


def image_parameters(left: Float64, right: Float64) -> Float64:
    """(k,) parameters from 0 to 1 in proportion to the mean length of the (k, 2) chains."""
    steps = [np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (left, right)]
    travelled = np.r_[0, np.cumsum(steps[0] + steps[1])]
    return travelled / travelled[-1]


def fit_marks(points: Float64, s: Float64, spans: int) -> Nurbs:
    """Least-squares curve through (k, 3) stereo points at parameters `s` (end of Section V)."""
    knots = nurbs.clamped_knots(np.linspace(0, 1, spans + 1)[1:-1], spline.DEGREE)
    return _closest(knots, s, ((0, np.tile(np.eye(3), (len(s), 1, 1)), points),))


def with_needed_knots(curve: Nurbs, samples: Samples, stiffness: Float64) -> Nurbs:
    """The curve with as few knots as the crests allow.

    Spans are halved, by misfit, until none fits the crests significantly worse than `curve` does.
    Where the crests say nothing, such as of the depth of an end along an epipolar line, its ends and
    its bends are kept.

    Args:
        curve: with knots enough.
        samples: of the curve.
        stiffness: (2,) what holds back its bending across the line of sight, and that in disparity.
    """
    first, table = spline.local_basis(samples.s, curve.knots)
    second = spline.combine(first, table[2], curve.control_points)
    across, deep = samples.bending_information(second)
    places = samples.crest_information() + samples.rest_information()
    places[[0, -1]] += samples.end_equations()[0]
    terms = (
        (0, places / samples.variance, samples.points),
        (2, stiffness[0] * across + stiffness[1] * deep, second),
    )
    interior = np.array([0.5])
    while True:
        few = _closest(nurbs.clamped_knots(interior, spline.DEGREE), samples.s, terms)
        new = _splits(samples.s, _excess(few, samples) / samples.variance, interior)
        if not new:
            return few
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


def _closest(knots: Float64, s: Float64, terms: tuple[Term, ...]) -> Nurbs:
    """The curve whose derivatives are closest to the terms at the (k,) parameters `s`."""
    first, table = spline.local_basis(s, knots)
    count = len(knots) - spline.DEGREE - 1
    band, gradient = np.zeros((3 * count, spline.BANDWIDTH)), np.zeros(3 * count)
    for order, information, values in terms:
        pull = np.einsum("kij,kj->ki", information, values)
        spline.add_rows(first, table[order], information, pull, band, gradient)
    band[:, 0] *= 1 + _RIDGE
    if not spline.factorize(band):
        raise FloatingPointError("the samples do not hold the curve")
    control_points = spline.solve_factorized(band, gradient).reshape(-1, 3)
    return nurbs.curve_from(spline.DEGREE, knots, control_points)

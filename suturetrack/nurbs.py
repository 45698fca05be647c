"""NURBS curves (Section IV): basis, evaluation, knots, parts, least-squares fit.

The basis itself is SciPy's; all curves have clamped knots over [0, 1]. Curves made here have unit
weights, for which a NURBS curve is a B-spline and its projection stays linear in the control points;
`evaluate` and `derivative` take any positive weights.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from suturetrack.types import Float64, Nurbs


def curve_from(degree: int, knots: Float64, control_points: Float64) -> Nurbs:
    """The curve with unit weights."""
    control_points = np.ascontiguousarray(control_points, dtype=np.float64)
    knots = np.ascontiguousarray(knots, dtype=np.float64)
    if len(knots) != len(control_points) + degree + 1:
        raise ValueError(
            f"{len(control_points)} control points of degree {degree} need "
            f"{len(control_points) + degree + 1} knots, not {len(knots)}"
        )
    return Nurbs(degree, knots, control_points, np.ones(len(control_points)))


def clamped_knots(interior: Float64, degree: int) -> Float64:
    """Knots over [0, 1] with the end knots repeated degree + 1 times around the given interior ones."""
    return np.r_[np.zeros(degree + 1), np.asarray(interior, float), np.ones(degree + 1)]


def basis(s: Float64, knots: Float64, degree: int) -> Float64:
    """A(u) of eq. (11): (k + 1, n + 1) values of the basis functions at parameters `s` in [0, 1]."""
    return BSpline.design_matrix(np.asarray(s, float), knots, degree).toarray()


def evaluate(curve: Nurbs, s: Float64) -> Float64:
    """f(s) of eq. (2): (k,) parameters in [0, 1] -> (k, dim) points."""
    weighted = _homogeneous(curve)(np.asarray(s, float))
    return weighted[..., :-1] / weighted[..., -1:]


def derivative(curve: Nurbs, s: Float64, times: int = 1) -> Float64:
    """f'(s) or f''(s): (k,) parameters in [0, 1] -> (k, dim)."""
    if times not in (1, 2):
        raise ValueError(f"times must be 1 or 2, not {times}")
    spline, s = _homogeneous(curve), np.asarray(s, float)
    a, a1 = spline(s), spline(s, 1)
    w, w1 = a[..., -1:], a1[..., -1:]
    first = (a1[..., :-1] - w1 * a[..., :-1] / w) / w
    if times == 1:
        return first
    a2 = spline(s, 2)
    return (a2[..., :-1] - 2 * w1 * first - a2[..., -1:] * a[..., :-1] / w) / w


def tangents(curve: Nurbs, s: Float64) -> Float64:
    """Unit tangents at (k,) parameters, (k, dim), towards growing s."""
    d = derivative(curve, s)
    return d / np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), np.finfo(float).tiny)


def length(curve: Nurbs) -> float:
    """Arc length, by Gauss-Legendre quadrature on each knot span."""
    s, weights, half = _between(np.unique(curve.knots), 8)
    return float(np.sum(_speed(curve, s) * weights * half))


def arc_lengths(curve: Nurbs, s: Float64) -> Float64:
    """Arc length from the start to each of the sorted parameters `s`, by Gauss-Legendre between them."""
    inner, weights, half = _between(np.r_[0.0, np.asarray(s, float)], 4)
    return np.cumsum(np.sum(_speed(curve, inner) * weights * half, axis=1))


def evenly_spaced(curve: Nurbs, count: int) -> Float64:
    """`count` parameters from 0 to 1 whose points are evenly spaced along the curve."""
    fine = np.linspace(0, 1, max(4 * count, 16 * len(curve.control_points)))
    travelled = arc_lengths(curve, fine)
    return np.interp(np.linspace(0, travelled[-1], count), travelled, fine)


def insert_knot(curve: Nurbs, s: float) -> Nurbs:
    """The same shape with one knot, and so one control point, more."""
    return _nurbs(_homogeneous(curve).insert_knot(s))


def fit(points: Float64, s: Float64, knots: Float64, degree: int) -> Nurbs:
    """Least-squares curve through (k, dim) points at (k,) parameters."""
    a = basis(s, knots, degree)
    normal: Float64 = a.T @ a / len(a)
    # Spans without data leave the system singular; the tiny ridge picks the smallest solution.
    normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal) / len(normal)
    return curve_from(
        degree, knots, np.asarray(np.linalg.solve(normal, a.T @ points / len(a)), float)
    )


def bending_matrix(knots: Float64, degree: int) -> Float64:
    """(n + 1, n + 1) matrix B with c.T B c = integral of |f''(s)|^2 ds, exact."""
    s, weights, half = _between(np.unique(knots), max(degree - 1, 1))
    count = len(knots) - degree - 1
    second = np.asarray(BSpline(knots, np.eye(count), degree)(s.ravel(), 2))
    return second.T @ ((weights * half).ravel()[:, None] * second)


def reversed_curve(curve: Nurbs) -> Nurbs:
    """The same curve run from the other end."""
    return Nurbs(
        curve.degree,
        np.ascontiguousarray(1 - curve.knots[::-1]),
        np.ascontiguousarray(curve.control_points[::-1]),
        np.ascontiguousarray(curve.weights[::-1]),
    )


def part(curve: Nurbs, start: float, stop: float) -> Nurbs:
    """The piece of the curve over [start, stop] within [0, 1], reparametrised to [0, 1]."""
    spline, k = _homogeneous(curve), curve.degree
    for s in (start, stop):
        missing = k + 1 - int(np.sum(spline.t == s))
        if 0 < s < 1 and missing > 0:
            spline = spline.insert_knot(s, missing)
    first = int(np.searchsorted(spline.t, start, "left")) if start > 0 else 0
    last = int(np.searchsorted(spline.t, stop, "right"))
    knots = (spline.t[first:last] - start) / (stop - start)
    return _nurbs(BSpline(knots, spline.c[first : last - k - 1], k))


def with_ends(curve: Nurbs, start: float, stop: float) -> Nurbs:
    """The cubic curve over [start, stop], reparametrised to [0, 1], with as many control points.

    `start` may be below 0 and `stop` above 1: the end pieces run on as polynomials. Only the three
    control points at each end change; both ends must stay in their own knot spans.
    """
    c, t = _with_stop(curve.control_points, curve.knots, stop)
    c, t = _with_stop(c[::-1], 1 - t[::-1], 1 - start)
    knots = (1 - t[::-1] - start) / (stop - start)
    knots[:4], knots[-4:] = 0.0, 1.0
    return curve_from(3, knots, c[::-1])


def _with_stop(c: Float64, t: Float64, stop: float) -> tuple[Float64, Float64]:
    """Moves the last knots to `stop`: the polar form of the last piece at its new knots."""
    c = c.copy()
    a, b, g = (stop - t[[-7, -6, -5]]) / (t[-1] - t[[-7, -6, -5]])
    one = c[-3] + b * (c[-2] - c[-3])
    two = c[-2] + g * (c[-1] - c[-2])
    c[-3] = c[-4] + a * (c[-3] - c[-4])
    c[-2] = c[-3] + b * (one - c[-3])
    c[-1] = c[-2] + g * (one + g * (two - one) - c[-2])
    return c, np.r_[t[:-4], np.full(4, stop)]


def _between(edges: Float64, count: int) -> tuple[Float64, Float64, Float64]:
    """Gauss-Legendre's rule between m + 1 edges: (m, count) places, (count,) weights, (m, 1) half widths."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    half = np.diff(edges)[:, None] / 2
    return edges[:-1, None] + half * (nodes + 1), weights, half


def _speed(curve: Nurbs, s: Float64) -> Float64:
    """(m, count) |f'(s)| at (m, count) parameters."""
    return np.linalg.norm(derivative(curve, s.ravel()), axis=-1).reshape(s.shape)


def _homogeneous(curve: Nurbs) -> BSpline:
    w = curve.weights[:, None]
    weighted = np.concatenate([curve.control_points * w, w], axis=1)
    # Without the checks, which take longer than a curve's evaluation.
    return BSpline.construct_fast(curve.knots, weighted, curve.degree)


def _nurbs(spline: BSpline) -> Nurbs:
    w = np.ascontiguousarray(spline.c[:, -1])
    return Nurbs(spline.k, spline.t, spline.c[:, :-1] / w[:, None], w)

"""Cubic curves in compiled loops: local basis, banded normal equations, their solution and inverse."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.types import Float64, Int64

DEGREE = 3
ORDER = DEGREE + 1
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
BANDWIDTH = 3 * ORDER
"""Entries on and below the diagonal of the normal equations of a cubic curve in 3-D."""


@numba.njit(cache=True, nogil=True)
def local_basis(s: Float64, knots: Float64) -> tuple[Int64, Float64]:
    """The four basis functions that are not zero at each parameter, with two derivatives.

    Args:
        s: (k,) parameters in [knots[3], knots[-4]].
        knots: (n + 5,) knots of a cubic curve.

    Returns:
        (k,) index of the first of the four functions, and (3, k, 4) values, first and second
        derivatives.
    """
    count = len(s)
    spans = len(knots) - ORDER
    first = np.empty(count, np.int64)
    table = np.zeros((3, count, ORDER))
    one, two, slope = np.empty(2), np.empty(3), np.empty(3)
    for j in range(count):
        x = s[j]
        span = np.searchsorted(knots, x, side="right") - 1
        span = min(max(span, DEGREE), spans - 1)
        first[j] = span - DEGREE
        width = knots[span + 1] - knots[span]
        one[0] = (knots[span + 1] - x) / width
        one[1] = (x - knots[span]) / width
        two[:] = 0.0
        slope[:] = 0.0
        _raise_degree(one, two, 2, x, span, knots)
        _raise_degree(two, table[0, j], 3, x, span, knots)
        _differences(two, table[1, j], 3, span, knots)
        _differences(one, slope, 2, span, knots)
        _differences(slope, table[2, j], 3, span, knots)
    return first, table


@numba.njit(cache=True, nogil=True)
def _raise_degree(
    low: Float64, high: Float64, degree: int, x: float, span: int, knots: Float64
) -> None:
    for i in range(degree):
        left, right = knots[span - degree + 1 + i], knots[span + 1 + i]
        share = (x - left) / (right - left)
        high[i] += (1 - share) * low[i]
        high[i + 1] += share * low[i]


@numba.njit(cache=True, nogil=True)
def _differences(low: Float64, high: Float64, degree: int, span: int, knots: Float64) -> None:
    for i in range(degree):
        left, right = knots[span - degree + 1 + i], knots[span + 1 + i]
        slope = degree * low[i] / (right - left)
        high[i] -= slope
        high[i + 1] += slope


@numba.njit(cache=True, nogil=True)
def combine(first: Int64, values: Float64, control_points: Float64) -> Float64:
    """(k, dim) points of (n + 1, dim) control points, by the (k, 4) local basis `values`."""
    count, dim = len(first), control_points.shape[1]
    points = np.empty((count, dim))
    for j in range(count):
        for a in range(dim):
            total = 0.0
            for i in range(ORDER):
                total += values[j, i] * control_points[first[j] + i, a]
            points[j, a] = total
    return points


@numba.njit(cache=True, nogil=True)
def evaluate(s: Float64, knots: Float64, control_points: Float64) -> Float64:
    """(3, k, dim) points of a cubic curve at (k,) parameters, with their first and second derivatives."""
    first, table = local_basis(s, knots)
    values = np.empty((len(table), len(s), control_points.shape[1]))
    for times in range(len(table)):
        values[times] = combine(first, table[times], control_points)
    return values


@numba.njit(cache=True, nogil=True)
def even_samples(knots: Float64, count: int) -> tuple[Float64, Float64]:
    """`count` parameters evenly within each knot span, clear of the knots, and their shares of [0, 1]."""
    spans = 0
    for i in range(len(knots) - 1):
        spans += knots[i + 1] > knots[i]
    s, share = np.empty(spans * count), np.empty(spans * count)
    k = 0
    for i in range(len(knots) - 1):
        if knots[i + 1] > knots[i]:
            width = (knots[i + 1] - knots[i]) / count
            for j in range(count):
                s[k], share[k] = knots[i] + width * (j + 0.5), width
                k += 1
    return s, share


@numba.njit(cache=True, nogil=True)
def arc_length(knots: Float64, control_points: Float64) -> float:
    """Length of a cubic curve of (n + 1, 3) control points, by Gauss's rule of four on each span."""
    s, share = even_samples(knots, len(_NODES))
    for k in range(0, len(s), len(_NODES)):
        half = share[k] * len(_NODES) / 2
        start = s[k] - share[k] / 2
        for i in range(len(_NODES)):
            s[k + i], share[k + i] = start + half * (1 + _NODES[i]), half * _WEIGHTS[i]
    first, table = local_basis(s, knots)
    slope = combine(first, table[1], control_points)
    total = 0.0
    for k in range(len(s)):
        total += share[k] * np.sqrt(slope[k, 0] ** 2 + slope[k, 1] ** 2 + slope[k, 2] ** 2)
    return total


@numba.njit(cache=True, nogil=True)
def gather(first: Int64, values: Float64, points: Float64) -> Float64:
    """(n + 1, dim) sums A.T P of the (k, dim) samples: the transpose of `combine`."""
    sums = np.zeros((first[-1] + ORDER, points.shape[1]))
    for j in range(len(first)):
        for i in range(ORDER):
            for a in range(points.shape[1]):
                sums[first[j] + i, a] += values[j, i] * points[j, a]
    return sums


@numba.njit(cache=True, nogil=True)
def add_rows(
    first: Int64,
    values: Float64,
    information: Float64,
    pull: Float64,
    band: Float64,
    gradient: Float64,
) -> None:
    """Adds the rows of the samples to the normal equations of the control points' step.

    Args:
        first, values: local basis (or a derivative of it) at the k samples.
        information: (k, 3, 3) weighted outer products of the rows in the sample's own 3-D offset.
        pull: (k, 3) weighted rows times what they should become.
        band: (3 (n + 1), BANDWIDTH) lower band, `band[r, d]` is entry (r, r - d); added to.
        gradient: (3 (n + 1),) right-hand side; added to.
    """
    for j in range(len(first)):
        for i in range(ORDER):
            row = 3 * (first[j] + i)
            vi = values[j, i]
            for a in range(3):
                gradient[row + a] += vi * pull[j, a]
            for h in range(i + 1):
                v = vi * values[j, h]
                for a in range(3):
                    for b in range(3):
                        d = 3 * (i - h) + a - b
                        if d >= 0:
                            band[row + a, d] += v * information[j, a, b]


def closest(
    knots: Float64, s: Float64, points: Float64, information: Float64, ridge: float = 0.0
) -> Float64:
    """(n + 1, 3) control points of the cubic curve that is closest to (k, 3) points at (k,) parameters.

    Args:
        information: (k, 3, 3) how much each point matters, by direction.
        ridge: share by which the diagonal of the normal equations is raised.

    Raises:
        FloatingPointError: the points do not hold the curve.
    """
    first, table = local_basis(s, knots)
    band, gradient = no_rows(len(knots) - ORDER)
    pull = np.einsum("kij,kj->ki", information, points)
    add_rows(first, table[0], information, pull, band, gradient)
    band[:, 0] *= 1 + ridge
    if not factorize(band):
        raise FloatingPointError("the points do not hold the curve")
    return solve_factorized(band, gradient).reshape(-1, 3)


def no_rows(count: int) -> tuple[Float64, Float64]:
    """The band and the gradient of normal equations of so many control points, for `add_rows`."""
    return np.zeros((3 * count, BANDWIDTH)), np.zeros(3 * count)


@numba.njit(cache=True, nogil=True)
def factorize(band: Float64) -> bool:
    """Cholesky factor of the lower band, in place; False where it is not positive definite."""
    n, width = band.shape
    for r in range(n):
        for d in range(min(r, width - 1), -1, -1):
            c = r - d
            total = band[r, d]
            for m in range(max(0, r - width + 1), c):
                total -= band[r, r - m] * band[c, c - m]
            if d == 0:
                if total <= 0:
                    return False
                band[r, 0] = np.sqrt(total)
            else:
                band[r, d] = total / band[c, 0]
    return True


@numba.njit(cache=True, nogil=True)
def solve_factorized(factor: Float64, right: Float64) -> Float64:
    """x with L L.T x = right for the banded Cholesky factor L."""
    n, width = factor.shape
    x = right.copy()
    for r in range(n):
        for m in range(max(0, r - width + 1), r):
            x[r] -= factor[r, r - m] * x[m]
        x[r] /= factor[r, 0]
    for r in range(n - 1, -1, -1):
        for m in range(r + 1, min(n, r + width)):
            x[r] -= factor[m, m - r] * x[m]
        x[r] /= factor[r, 0]
    return x


@numba.njit(cache=True, nogil=True)
def band_of_inverse(factor: Float64) -> Float64:
    """The lower band of (L L.T)^-1, by the backward recursion over the sparsity of L."""
    n, width = factor.shape
    inverse = np.zeros((n, width))
    for r in range(n - 1, -1, -1):
        reach = min(n - 1, r + width - 1)
        for c in range(reach, r - 1, -1):
            total = 1.0 / factor[r, 0] if c == r else 0.0
            for m in range(r + 1, reach + 1):
                high, low = (m, c) if m >= c else (c, m)
                total -= factor[m, m - r] * inverse[high, high - low]
            inverse[c, c - r] = total / factor[r, 0]
    return inverse


@numba.njit(cache=True, nogil=True)
def sample_covariance(first: Int64, values: Float64, inverse: Float64) -> Float64:
    """(k, 3, 3) covariance of the samples from the band of the control points' covariance."""
    count = len(first)
    covariance = np.zeros((count, 3, 3))
    for j in range(count):
        for i in range(ORDER):
            for h in range(ORDER):
                v = values[j, i] * values[j, h]
                for a in range(3):
                    for b in range(3):
                        r, c = 3 * (first[j] + i) + a, 3 * (first[j] + h) + b
                        covariance[j, a, b] += v * (
                            inverse[r, r - c] if r >= c else inverse[c, c - r]
                        )
    return covariance


@numba.njit(cache=True, nogil=True)
def project_samples(
    projection: Float64, points: Float64, derivatives: Float64
) -> tuple[Float64, Float64, Float64, Float64]:
    """One view of (k, 3) points of a curve with their derivatives by s.

    Returns:
        (k, 2) pixels, (k, 2) unit tangents, (k,) speed in px per unit of s, and (k, 2, 3) derivative
        of the pixel by the point.
    """
    count = len(points)
    pixels, tangents = np.empty((count, 2)), np.empty((count, 2))
    speed, jacobian = np.empty(count), np.empty((count, 2, 3))
    for j in range(count):
        w = projection[2, 3]
        for b in range(3):
            w += projection[2, b] * points[j, b]
        for a in range(2):
            value = projection[a, 3]
            for b in range(3):
                value += projection[a, b] * points[j, b]
            pixels[j, a] = value / w
            along = 0.0
            for b in range(3):
                jacobian[j, a, b] = (projection[a, b] - pixels[j, a] * projection[2, b]) / w
                along += jacobian[j, a, b] * derivatives[j, b]
            tangents[j, a] = along
        speed[j] = np.hypot(tangents[j, 0], tangents[j, 1])
        for a in range(2):
            tangents[j, a] /= max(speed[j], 1e-9)
    return pixels, tangents, speed, jacobian

"""How far a curve is from the truth: distances, length, ends, order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import (
    arc_lengths,
    polyline_distances,
    polyline_length,
    polyline_tangents,
    resample,
)
from suturetrack.types import Float64


@dataclass(frozen=True)
class CurveError:
    """The distance between two curves given as dense points, in the unit of the points."""

    mean: float
    """Mean distance to the nearest point, each way, averaged."""
    rms: float
    """Root of the mean squared distance, both ways."""
    p95: float
    largest: float
    length_percent: float
    """Signed error of the length, in % of the truth."""
    ends: tuple[float, float]
    """Distances of the matching ends, in the order of the truth's ends, for the better direction."""


def curve_error(estimate: Float64, truth: Float64) -> CurveError:
    """Compares (k, dim) ordered points of a curve with (m, dim) ordered points of the true one.

    Distances go from point to polyline segment on the other curve, so their floor does not depend on
    the sampling.
    """
    forth, back = polyline_distances(estimate, truth), polyline_distances(truth, estimate)
    both = np.r_[forth, back]
    return CurveError(
        mean=float((forth.mean() + back.mean()) / 2),
        rms=float(np.sqrt(((forth**2).mean() + (back**2).mean()) / 2)),
        p95=float(np.percentile(both, 95)),
        largest=float(both.max()),
        length_percent=100 * (polyline_length(estimate) / polyline_length(truth) - 1),
        ends=end_distances(estimate, truth),
    )


def end_distances(estimate: Float64, truth: Float64) -> tuple[float, float]:
    """Distances of the two ends in the order of the truth's, run in the direction that fits better."""
    pairs = [
        np.linalg.norm(ends - truth[[0, -1]], axis=1)
        for ends in (estimate[[0, -1]], estimate[[-1, 0]])
    ]
    first, last = min(pairs, key=lambda d: float(d.sum()))
    return float(first), float(last)


def in_order(estimate: Float64, truth: Float64, radius: float, samples: int = 300) -> float:
    """Share of the truth that is within `radius` of the curve when both are walked from end to end.

    The walks are those of dynamic time warping, in the direction that fits better: each goes on or
    waits, and none turns back. Strands in the wrong order are near a curve and yet not in order.

    Args:
        estimate: (k, dim) ordered points of the curve.
        truth: (m, dim) ordered points of the true one.
        radius: unit of the points.
        samples: as many places are compared, evenly spaced along each.
    """
    walked = [resample(points, samples) for points in (estimate, truth)]
    distances = np.linalg.norm(walked[0][:, None] - walked[1], axis=2)
    ways = [_warped(d) for d in (distances, distances[::-1])]
    return float((min(ways, key=lambda way: float(way.sum())) <= radius).mean())


def knot_shift(estimate: Float64, truth: Float64, touching: float, longest: float) -> float:
    """By how much a curve misplaces a tight knot along the thread; nan where the truth has none.

    A curve passes a tight knot as a point. What counts is how much thread it leaves free before and
    behind it: the worse of the two differences, run in the direction that fits better.

    Args:
        estimate: (k, dim) ordered points of the curve, close together.
        truth: (m, dim) ordered points of the true one, close together.
        touching: distance, unit of the points, within which the thread touches itself.
        longest: length of thread within which it does so in a tight knot; what is less than three
            times `touching` apart along the thread does not count.
    """
    travelled = arc_lengths(truth)
    apart = travelled - travelled[:, None]
    one, other = np.nonzero((apart > 3 * touching) & (apart < longest))
    touch = np.linalg.norm(truth[one] - truth[other], axis=1) < touching
    if not touch.any():
        return float("nan")
    knot = [int(one[touch].min()), int(other[touch].max())]
    free = np.array([travelled[knot[0]], travelled[-1] - travelled[knot[1]]])
    places = cKDTree(estimate).query(truth[knot])[1]
    along = arc_lengths(estimate)[places]
    length = polyline_length(estimate)
    ways = np.abs(along - [0, length]), np.abs(along - [length, 0])
    return float(min(np.abs(way - free).max() for way in ways))


def _warped(distances: Float64) -> Float64:
    """(m,) largest distance at which each column is met on the cheapest monotone way, (k, m) given."""
    cost = np.empty_like(distances)
    cost[0] = np.cumsum(distances[0])
    for i in range(1, len(cost)):
        # A row is entered from above or diagonally at one column and walked to another.
        entered = np.minimum(cost[i - 1], np.r_[np.inf, cost[i - 1, :-1]])
        run = np.cumsum(distances[i])
        cost[i] = run + np.minimum.accumulate(entered - np.r_[0.0, run[:-1]])
    i, j = np.array(cost.shape) - 1
    met = np.zeros(distances.shape[1])
    while True:
        met[j] = max(met[j], distances[i, j])
        if i == j == 0:
            return met
        steps = [(a, b) for a, b in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if a >= 0 and b >= 0]
        i, j = min(steps, key=lambda step: float(cost[step]))


def physical_limit(
    rig: StereoRig, points: Float64, noise_px: float = 0.05, knot_spacing_px: float = 16.0
) -> float:
    """RMS distance of the best curve that a centreline measured with that noise allows.

    The posterior covariance of a cubic spline with a knot every `knot_spacing_px` along the left
    image, measured once a pixel along its normal in both views, with a prior that knows how much the
    thread bends and nothing else. Without a prior, stretches along the epipolar lines have no depth.

    Args:
        rig: the cameras.
        points: (N, 3) true centreline, rectified left frame, calibration's unit.
        noise_px: standard deviation of one measurement of the centreline, px.
        knot_spacing_px: what a spline needs to take the thread's shape.

    Returns:
        Root mean square distance across the thread, calibration's unit.
    """
    travelled = arc_lengths(rig.project(points)[0])
    samples = np.linspace(0, travelled[-1], max(int(travelled[-1]), 16))
    points = np.stack([np.interp(samples, travelled, column) for column in points.T], axis=1)
    s = samples / samples[-1]
    count = max(int(samples[-1] / knot_spacing_px), 1) + 3
    knots = nurbs.clamped_knots(np.linspace(0, 1, count - 2)[1:-1], 3)
    a = nurbs.basis(s, knots, 3)
    bending = nurbs.bending_matrix(knots, 3)
    control_points = nurbs.fit(points, s, knots, 3).control_points
    energy = float(np.einsum("id,ij,jd", control_points, bending, control_points))
    information = np.kron(bending, np.eye(3)) * (control_points.size / energy)
    for pixels, jacobian in zip(rig.project(points), rig.projection_jacobian(points), strict=True):
        tangent = polyline_tangents(pixels)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        row = np.einsum("kd,kdi->ki", normal, jacobian) / noise_px
        rows = (a[:, :, None] * row[:, None, :]).reshape(len(a), -1)
        information += rows.T @ rows
    covariance = np.linalg.pinv(information, hermitian=True).reshape(count, 3, count, 3)
    of_points = np.einsum("ki,kj,iajb->kab", a, a, covariance, optimize=True)
    tangent = polyline_tangents(points)
    along = np.einsum("ka,kab,kb->k", tangent, of_points, tangent)
    return float(np.sqrt(np.mean(np.trace(of_points, axis1=1, axis2=2) - along)))

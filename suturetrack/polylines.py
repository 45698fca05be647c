"""Lines through ordered points: lengths, places, directions and distances."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.types import Bool, Float64

Run = tuple[int, int]
"""The first point of a stretch, and that behind the last one."""


def polyline_length(points: Float64) -> float:
    """Length of the polyline through (k, dim) points."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def arc_lengths(points: Float64) -> Float64:
    """(k,) length of the polyline through (k, dim) points up to each of them."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]


def polyline_at(points: Float64, lengths: Float64) -> Float64:
    """(m, dim) places on the polyline through (k, dim) points, so far from its start each."""
    along = arc_lengths(points)
    return np.stack([np.interp(lengths, along, column) for column in points.T], axis=1)


def resample(points: Float64, count: int) -> Float64:
    """(count, dim) points evenly spaced along the polyline through (k, dim) points."""
    return polyline_at(points, np.linspace(0, arc_lengths(points)[-1], count))


def polyline_tangents(points: Float64) -> Float64:
    """(k, dim) unit tangents at evenly spaced points."""
    steps = np.gradient(points, axis=0)
    return steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), np.finfo(float).tiny)


def unit(vectors: Float64) -> Float64:
    """(..., dim) vectors at length 1; those of next to no length stay so."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def runs_of(flags: Bool) -> list[Run]:
    """The stretches of a polyline of which all (k,) points are flagged, in order."""
    bounds = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return [(start, stop) for start, stop in bounds.reshape(-1, 2).tolist()]


def nearest_index(points: Float64, place: Float64) -> int:
    """Which of (k, dim) points is the nearest to a place (dim,)."""
    return int(np.argmin(np.linalg.norm(points - place, axis=1)))


def polyline_distances(points: Float64, polyline: Float64) -> Float64:
    """(k,) distances from (k, dim) points to the polyline through (m, dim) points."""
    return np.asarray(np.linalg.norm(polyline_offsets(points, polyline), axis=1))


def polyline_offsets(points: Float64, polyline: Float64) -> Float64:
    """(k, dim) vectors from the nearest places on the polyline (m, dim) to the points (k, dim).

    Only the segments beside the nearest vertex are looked at, which is exact for polylines sampled
    finer than their distance to other strands.
    """
    _, nearest = cKDTree(polyline).query(points)
    offsets = []
    for step in (-1, 0):
        i = np.clip(nearest + step, 0, len(polyline) - 2)
        start, along = polyline[i], polyline[i + 1] - polyline[i]
        squared = np.maximum((along**2).sum(1), np.finfo(float).tiny)
        t = np.clip(((points - start) * along).sum(1) / squared, 0, 1)
        offsets.append(points - start - t[:, None] * along)
    nearer = np.linalg.norm(offsets[0], axis=1) <= np.linalg.norm(offsets[1], axis=1)
    return np.where(nearer[:, None], *offsets)


def coverage(polyline: Float64, points: Float64, radius: float) -> float:
    """Share of (k, dim) points within `radius` of the polyline through (m, dim) points."""
    return float((polyline_distances(points, polyline) <= radius).mean())

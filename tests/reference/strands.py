"""Literal twins of the kernels that keep strands apart."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Bool, Float64

CLAIM_PX, APART_PX, PARALLEL = 4.0, 2.0, 0.8

Strand = tuple[Float64, Float64, Float64]


def claimed(strand: Strand, others: Strand, offsets: Float64, apart: float) -> Bool:
    """See `suturetrack.kernels.search.claimed`."""
    across, ahead, parallel, along = _relative(strand, others)
    far = np.abs(offsets).max() + CLAIM_PX
    rivals = (
        (np.abs(others[0] - strand[0][:, None]) <= far).all(axis=2)
        & (np.abs(ahead) <= CLAIM_PX)
        & (np.abs(across) >= APART_PX)
        & (parallel >= PARALLEL)
        & (along >= apart)
    )
    away = np.abs(offsets - across[:, :, None])
    nearer = (away < CLAIM_PX) & (away < np.abs(offsets))
    return np.asarray((nearer & rivals[:, :, None]).any(axis=1))


def doubled(strand: Strand, others: Strand, apart: float, near: float = APART_PX) -> Bool:
    """See `suturetrack.kernels.search.doubled`."""
    across, _, parallel, along = _relative(strand, others)
    step = np.abs(others[0] - strand[0][:, None])
    same = (np.abs(across) < near) & (parallel > PARALLEL) & (along >= apart)
    return np.asarray((same & (step <= max(near, CLAIM_PX)).all(axis=2)).any(axis=1))


def covered(
    pixels: Float64, tangents: Float64, offsets: Float64, points: Float64, near: float
) -> Bool:
    """See `suturetrack.kernels.search.covered`."""
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    places = pixels[:, None] + offsets[:, None] * normals[:, None]
    distance = np.linalg.norm(places[:, :, None] - points, axis=3)
    return np.asarray((distance < near).any(axis=2))


def _relative(strand: Strand, others: Strand) -> tuple[Float64, Float64, Float64, Float64]:
    """(k, q) offsets of other samples across and along, |cosine| of their angle, and px between."""
    pixels, tangents, along = strand
    step = others[0] - pixels[:, None]
    across = step[..., 1] * tangents[:, None, 0] - step[..., 0] * tangents[:, None, 1]
    ahead = (step * tangents[:, None]).sum(axis=2)
    parallel = np.abs(tangents @ others[1].T)
    return across, ahead, parallel, np.abs(others[2] - along[:, None])

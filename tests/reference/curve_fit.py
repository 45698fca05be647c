"""Literal twins of the kernels that track: dense matrices, one pixel at a time."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import BSpline

from suturetrack.kernels import search
from tests.reference import strands


def design(s: np.ndarray, knots: np.ndarray, times: int = 0) -> np.ndarray:
    """(k, n + 1) cubic basis functions or their derivatives."""
    count = len(knots) - 4
    return np.stack([BSpline(knots, np.eye(count)[i], 3)(s, times) for i in range(count)], axis=1)


def even_samples(knots: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """See `kernels.spline.even_samples`."""
    spans = list(itertools.pairwise(np.unique(knots)))
    s = [np.linspace(a, b, 2 * count + 1)[1::2] for a, b in spans]
    return np.concatenate(s), np.repeat([(b - a) / count for a, b in spans], count)


def arc_length(knots: np.ndarray, control_points: np.ndarray) -> float:
    """See `kernels.spline.arc_length`."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    total = 0.0
    for a, b in itertools.pairwise(np.unique(knots)):
        slope = design((a + b) / 2 + (b - a) / 2 * nodes, knots, 1) @ control_points
        total += (b - a) / 2 * float(weights @ np.linalg.norm(slope, axis=1))
    return total


def normal_equations(
    a: np.ndarray, information: np.ndarray, pull: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Dense normal equations of the step of the control points, coordinates together."""
    count = a.shape[1]
    matrix, right = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
    for row, block, goal in zip(a, information, pull, strict=True):
        spread = np.kron(row[:, None], np.eye(3))
        matrix += spread @ block @ spread.T
        right += spread @ goal
    return matrix, right


def bilinear(values: np.ndarray, u: float, v: float) -> float:
    """Value of (H, W) at a place, from its four pixels; 0 outside the image."""
    height, width = values.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0
    down = np.maximum(1 - np.abs(v - np.arange(height)), 0)
    right = np.maximum(1 - np.abs(u - np.arange(width)), 0)
    return float(down @ values @ right)


def magnitude(field: np.ndarray, u: float, v: float) -> float:
    """|V| at one place."""
    return bilinear(np.linalg.norm(field.astype(float), axis=2), u, v)


def response(field: np.ndarray, u: float, v: float, tangent: np.ndarray) -> float:
    """(t.V)^2 / |V| at one place."""
    length = np.linalg.norm(field.astype(float), axis=2)
    along = field @ tangent
    return bilinear(np.where(length > 0, along**2 / np.maximum(length, 1e-30), 0), u, v)


def normal_profiles(
    field: np.ndarray,
    pixels: np.ndarray,
    tangents: np.ndarray,
    offsets: np.ndarray,
    leniency: float,
) -> np.ndarray:
    """See `kernels.search.normal_profiles`."""
    profiles = np.empty((len(pixels), len(offsets)))
    for k, (pixel, tangent) in enumerate(zip(pixels, tangents, strict=True)):
        for m, offset in enumerate(offsets):
            u, v = pixel + offset * np.array([-tangent[1], tangent[0]])
            along, any_way = response(field, u, v, tangent), magnitude(field, u, v)
            profiles[k, m] = (1 - leniency) * along + leniency * any_way
    return profiles


def best_path(gain: np.ndarray, stiffness: float, reach: int) -> float:
    """What the best path is worth, by trying all."""
    count, width = gain.shape
    best = -np.inf
    for path in itertools.product(range(width), repeat=count):
        steps = np.diff(path)
        if np.all(np.abs(steps) <= reach):
            value = gain[np.arange(count), list(path)].sum() - stiffness * (steps**2).sum()
            best = max(best, float(value))
    return best


def peaks(profiles: np.ndarray, path: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """See `kernels.search.peaks`; between two summits the way is up the later one."""
    position, height = np.full(len(path), np.nan), np.empty(len(path))
    for k, (profile, i) in enumerate(zip(profiles, path, strict=True)):
        walls = np.r_[-np.inf, profile, -np.inf]
        forth = np.flatnonzero(np.diff(walls[i + 1 :]) <= 0)[0]
        back = np.flatnonzero(np.diff(walls[: i + 2])[::-1] >= 0)[0]
        summit = i + forth if forth else i - back
        height[k] = profile[summit]
        if half <= summit < len(profile) - half and height[k] > 0:
            around = profile[summit - half : summit + half + 1]
            bend, slope, _ = np.polyfit(np.arange(-half, half + 1), around, 2)
            if bend < 0:
                position[k] = summit + np.clip(-slope / (2 * bend), -1, 1)
    return position, height


def best_line(
    field: np.ndarray,
    strand: strands.Strand,
    others: strands.Strand,
    apart: float,
    lengths: np.ndarray,
    level: np.ndarray,
    reach: float,
    step: float,
    leniency: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets, responses, and whether the thread was found; see `kernels.search.best_line`."""
    pixels, tangents, _ = strand
    half = round(reach / step)
    places = np.asarray(step * np.arange(-half, half + 1), np.float64)
    profiles = search.normal_profiles(field, pixels, tangents, places, leniency)
    taken = strands.claimed(strand, others, places, apart)
    clear = np.where(taken, 0.0, np.minimum(profiles / level[:, None], 1.0))
    path = search.best_path(clear - 0.1 * (places / reach) ** 2, 0.2 * step**2, 4)
    position, response = search.peaks(profiles, path, 3)
    height, width, _ = field.shape
    inside = ((pixels >= 1) & (pixels <= (width - 2, height - 2))).all(axis=1)
    found = np.isfinite(position) & (response > 0.2 * level) & inside
    nearest = np.where(found, np.round(position), 0).astype(int)
    found &= ~taken[np.arange(len(taken)), nearest]
    found = search.solid(found, lengths, 10.0)
    return np.where(found, (position - half) * step, 0.0), response, found


def held_rows(
    jacobians: tuple[np.ndarray, np.ndarray],
    goal: np.ndarray,
    by_pixels: np.ndarray,
    in_space: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Information and pull; see `kernels.rows.held_rows`."""
    left, right = (j.transpose(0, 2, 1) @ j for j in jacobians)
    information = by_pixels[:, None, None] * (left + right) + in_space[:, None, None] * np.eye(3)
    return information, (information @ goal[:, :, None])[:, :, 0]


def measured_rows(
    tangents: np.ndarray, jacobian: np.ndarray, weight: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What `kernels.rows.add_measured_rows` adds to information and pull."""
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    row = (normals[:, None, :] @ jacobian)[:, 0, :]
    weighted = weight[:, None] * row
    return weighted[:, :, None] * row[:, None, :], weighted * offset[:, None]


def shape_rows(
    first: np.ndarray, goal: np.ndarray, bending: np.ndarray, stretch: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Information and pull; see `kernels.rows.shape_rows`."""
    tangent = first / np.linalg.norm(first, axis=1, keepdims=True)
    along = tangent[:, :, None] * tangent[:, None, :]
    information = bending[:, None, None] * np.eye(3) + stretch[:, None, None] * along
    return information, (information @ goal[:, :, None])[:, :, 0]

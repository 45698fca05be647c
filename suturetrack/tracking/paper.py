"""The method of the paper, eqs. (4)-(16), with the signs mended.

As printed, eq. (5) climbs the energy for b > 0, and eq. (9) drives the far end the wrong way: the
force along the tangent does not depend on the tangent's sign, so eq. (8) holds at both ends. Eq. (13)
is solved by its normal rows alone: a tangential offset that nobody measured is no zero.
"""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search, spline
from suturetrack.nurbs import curve_from, evenly_spaced
from suturetrack.tracking.config import PaperConfig
from suturetrack.tracking.sampling import Samples, View, views
from suturetrack.types import Float32, Float64, Nurbs, RidgeField

_DIFFERENCE_PX = 1.0
_SEARCH_STEP_PX = 1.0
# An end's tangent is that of the chord over so many samples: the last two control points come close,
# and their direction is then noise, above all in depth.
_CHORD = 6


def fit(
    curve: Nurbs,
    field: RidgeField,
    rig: StereoRig,
    cutoffs: tuple[float, float],
    config: PaperConfig,
) -> Nurbs:
    """Moves the curve by the forces of the field, `config.iterations` times.

    Args:
        cutoffs: |V_c| of eq. (7), left and right.
    """
    count = config.samples_per_control_point * len(curve.control_points)
    samples = Samples.at(curve.knots, evenly_spaced(curve, count))
    sums = spline.gather(samples.first, samples.table[0], np.ones((count, 1)))
    control_points = curve.control_points
    for _ in range(config.iterations):
        step = _point_offsets(samples, control_points, field, rig, cutoffs, config)
        change = spline.gather(samples.first, samples.table[0], step) / np.maximum(sums, 1e-9)
        change[0] = _short_of(step[0], control_points[1] - control_points[0])
        change[-1] = _short_of(step[-1], control_points[-2] - control_points[-1])
        control_points = control_points + change
    return curve_from(curve.degree, curve.knots, control_points)


def cutoff(image: Float32, level: float) -> float:
    """|V_c| of eq. (7): midway between the mean magnitudes of the thread and of the background."""
    sparse = image[::8, ::8]
    return (level + float(np.hypot(sparse[..., 0], sparse[..., 1]).mean())) / 2


def _point_offsets(
    samples: Samples,
    control_points: Float64,
    field: RidgeField,
    rig: StereoRig,
    cutoffs: tuple[float, float],
    config: PaperConfig,
) -> Float64:
    """(k, 3) Delta P: eqs. (5), (6), (8) and (10) in both images, deprojected by eq. (13)."""
    points, first = samples.values(control_points), samples.values(control_points, 1)
    reach = min(_CHORD, len(points) - 1)
    first[0], first[-1] = points[reach] - points[0], points[-1] - points[-1 - reach]
    both = views(rig, points, first)
    images = field.left, field.right
    normal = [_normal_offsets(i, v, config) for i, v in zip(images, both, strict=True)]
    step = _deproject_normals(both, normal, first)
    ends = [_end_offsets(i, v, c, config) for i, v, c in zip(images, both, cutoffs, strict=True)]
    return step + _deproject_ends(both, ends, first)


def _normal_offsets(image: Float32, view: View, config: PaperConfig) -> Float64:
    """(k,) px along the normals: eqs. (5) and (6); where the field is flat, active search."""
    response = search.responses(image, view.pixels, view.tangents)
    magnitude = search.magnitudes(image, view.pixels)
    slope = _slope(image, view.pixels, view.normals)
    force = config.gain * slope * response / np.maximum(magnitude, 1e-6)
    reach = round(config.search_px / _SEARCH_STEP_PX)
    grid = _SEARCH_STEP_PX * np.arange(-reach, reach + 1)
    profiles = search.normal_profiles(image, view.pixels, view.tangents, grid)
    best = np.argmax(profiles - 1e-3 * np.abs(grid), axis=1)
    flat = (np.abs(force) < config.flat_px) & (profiles.max(axis=1) > response + config.flat_px)
    searched = np.clip(grid[best], -config.largest_step_px, config.largest_step_px)
    force = np.clip(force, -config.largest_step_px, config.largest_step_px)
    return np.where(flat, searched, force)


def _end_offsets(
    image: Float32, view: View, cutoff: float, config: PaperConfig
) -> tuple[float, float]:
    """px along the tangents at both ends: eqs. (8) and (10)."""
    ends, tangents = view.pixels[[0, -1]], view.tangents[[0, -1]]
    excess = search.responses(image, ends, tangents) - cutoff
    slope = _slope(image, ends, tangents)
    force = np.clip(
        -2 * config.end_gain * slope * excess, -config.largest_step_px, config.largest_step_px
    )
    return float(force[0]), float(force[1])


def _slope(image: Float32, pixels: Float64, directions: Float64) -> Float64:
    """(k,) derivative of |V| along unit directions, per px."""
    ahead = search.magnitudes(image, pixels + _DIFFERENCE_PX * directions)
    behind = search.magnitudes(image, pixels - _DIFFERENCE_PX * directions)
    return (ahead - behind) / (2 * _DIFFERENCE_PX)


def _deproject_normals(both: tuple[View, View], offsets: list[Float64], first: Float64) -> Float64:
    """(k, 3) beta n + gamma b of eq. (13), from its normal rows."""
    tangent = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    plane = _across(tangent)
    rows = np.stack([((v.normals[:, None, :] @ v.jacobian) @ plane)[:, 0, :] for v in both], axis=1)
    square = rows.transpose(0, 2, 1) @ rows
    scale = np.trace(square, axis1=1, axis2=2)
    square = square + 1e-3 * scale[:, None, None] * np.eye(2)
    right = rows.transpose(0, 2, 1) @ np.stack(offsets, axis=1)[:, :, None]
    return (plane @ np.linalg.solve(square, right))[:, :, 0]


def _deproject_ends(
    both: tuple[View, View], offsets: list[tuple[float, float]], first: Float64
) -> Float64:
    """(k, 3) alpha t of eq. (13) at the two ends, zero elsewhere."""
    step = np.zeros_like(first)
    for column, end in enumerate((0, -1)):
        tangent = first[end] / max(float(np.linalg.norm(first[end])), 1e-12)
        along = np.array([v.tangents[end] @ v.jacobian[end] @ tangent for v in both])
        measured = np.array([offset[column] for offset in offsets])
        # An end that points at the camera would be thrown far for a small offset in the image.
        least = 0.1 * sum(float(np.sum(v.jacobian[end] ** 2)) for v in both)
        step[end] = tangent * (along @ measured) / max(float(along @ along), least)
    return step


def _short_of(step: Float64, neighbour: Float64) -> Float64:
    """The step of an end, kept from passing its neighbour: the tangent there would turn round, and
    the end would run back along the thread.
    """
    gap = max(float(np.linalg.norm(neighbour)), 1e-12)
    toward = neighbour / gap
    return step - max(float(step @ toward) - gap / 3, 0.0) * toward


def _across(tangent: Float64) -> Float64:
    """(k, 3, 2) two unit vectors across each tangent; the Frenet frame fails on straight pieces."""
    helper = np.eye(3)[np.argmin(np.abs(tangent), axis=1)]
    normal = np.cross(tangent, helper)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([normal, np.cross(tangent, normal)], axis=2)

"""The method of the paper, eqs. (4)-(16), mended where it does not work as printed.

- Eq. (5) climbs the energy for b > 0: a step is +b grad |V|.
- Eq. (9) drives the far end the wrong way: the force along the tangent does not depend on the
  tangent's sign, so eq. (8) holds at both ends.
- Eq. (10) mixes the tangents of space and image; both are the image's here. At an end it is that of a
  chord: the last control points come close, and their direction is noise.
- Eq. (8) has dead zones: a thread drawn out faster than its end follows leaves the end on the plateau
  of |V|, where there is no slope. The paper searches actively where the gradient is small; here the
  ends are searched for as well, for the place where the response falls to the cut-off.
- Eq. (13) is solved by its normal rows alone inside the curve: a tangential offset that nobody measured
  is no zero, and would hold the depth back. At an end both offsets are measured in both images, and all
  four rows count; along the tangent alone an end could not mend its depth.
- The ends move alone (Section VI-D), which crowds the last control points or pulls them apart until the
  curve turns round on itself, unseen by evenly spaced parameters. So control points out of the
  paper's range of distances are spaced evenly again, over knots that follow the arc length.
"""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.nurbs import curve_from, evenly_spaced
from suturetrack.polylines import arc_lengths
from suturetrack.tracking.config import PaperConfig
from suturetrack.tracking.sampling import Samples, View, views
from suturetrack.types import Float32, Float64, Nurbs, RidgeField

# Reach of the differences that tell the slope of |V|, and from place to place of active search.
_DIFFERENCE_PX, _SEARCH_STEP_PX = 1.0, 1.0
# Samples between the ends of the chord at an end.
_CHORD = 6
# What active search finds has to respond so much more than the place where the point is.
_CLEARER = 0.1
# How many times as far as outward an end is searched for inward.
_INWARD = 5.0
# Share of the trace on the diagonal of eq. (13): along the epipolar lines its rows tell no depth.
_DAMPING = 1e-3
# The control point next to that of an end.
_BESIDE = {0: 1, -1: -2}


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
    sums = samples.gather(np.ones((count, 1)))
    control_points = curve.control_points
    nearest = [_gap(control_points, end) / 3 for end in (0, -1)]
    for _ in range(config.iterations):
        step = _point_offsets(samples, control_points, field, rig, cutoffs, config)
        change = samples.gather(step) / np.maximum(sums, 1e-9)
        for end, least in zip((0, -1), nearest, strict=True):
            change[end] = _short_of(step[end], control_points, end, least)
        control_points = control_points + change
    return curve_from(curve.degree, curve.knots, control_points)


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
    along = [_end_offsets(i, v, c, config) for i, v, c in zip(images, both, cutoffs, strict=True)]
    for end in (0, -1):
        step[end] = _deproject_end(both, end, normal, along)
    return step


def _normal_offsets(image: Float32, view: View, config: PaperConfig) -> Float64:
    """(k,) px along the normals: eqs. (5) and (6); where the field is flat, active search."""
    response = view.responses(image)
    magnitude = search.magnitudes(image, view.pixels)
    slope = _slope(image, view.pixels, view.normals)
    force = config.gain * slope * response / np.maximum(magnitude, 1e-6)
    reach = round(config.search_px / _SEARCH_STEP_PX)
    grid = _SEARCH_STEP_PX * np.arange(-reach, reach + 1, dtype=np.float64)
    profiles = view.profiles(image, grid)
    best = np.argmax(profiles - 1e-3 * np.abs(grid), axis=1)
    flat = (np.abs(force) < config.flat_px) & (profiles.max(axis=1) > response + _CLEARER)
    searched = np.clip(grid[best], -config.largest_step_px, config.largest_step_px)
    force = np.clip(force, -config.largest_step_px, config.largest_step_px)
    return np.where(flat, searched, force)


def _end_offsets(image: Float32, view: View, cutoff: float, config: PaperConfig) -> Float64:
    """(2,) px along the tangents at both ends: eqs. (8) and (10); where |V| is flat, active search."""
    ends, tangents = view.pixels[[0, -1]], view.tangents[[0, -1]]
    excess = search.responses(image, ends, tangents) - cutoff
    slope = _slope(image, ends, tangents)
    force = -2 * config.end_gain * slope * excess
    for end, outward in ((0, -1.0), (-1, 1.0)):
        if abs(slope[end]) < config.flat_slope * cutoff:
            force[end] = outward * _search_end(image, view, end, cutoff, config.search_px)
    return np.clip(force, -config.largest_step_px, config.largest_step_px)


def _search_end(image: Float32, view: View, end: int, cutoff: float, reach_px: float) -> float:
    """px outward from the end 0 or -1 to where the response falls to the cut-off.

    Inward the curve tells where to look, so the search goes further there. 0 where nothing is seen.
    """
    x = np.arange(-_INWARD * reach_px, reach_px + _SEARCH_STEP_PX / 2, _SEARCH_STEP_PX)
    shown = search.responses(image, *_along_end(view, end, x))
    above = shown > cutoff
    if above[x >= 0].all():
        return reach_px
    falls = np.flatnonzero(above[:-1] & ~above[1:])
    if not len(falls):
        return 0.0
    share = (shown[falls] - cutoff) / (shown[falls] - shown[falls + 1])
    crossings = x[falls] + _SEARCH_STEP_PX * share
    return float(crossings[np.argmin(np.abs(crossings))])


def _along_end(view: View, end: int, x: Float64) -> tuple[Float64, Float64]:
    """(k, 2) pixels and unit tangents x px outward from an end: on the curve, then straight on."""
    order = slice(None) if end == 0 else slice(None, None, -1)
    pixels, tangents = view.pixels[order], view.tangents[order]
    inward = arc_lengths(pixels)
    on_curve = [np.interp(-x, inward, column) for column in np.c_[pixels, tangents].T]
    places, directions = np.stack(on_curve[:2], axis=1), np.stack(on_curve[2:], axis=1)
    outward = tangents[0] if end else -tangents[0]
    places += np.maximum(x, 0.0)[:, None] * outward
    return places, directions / np.linalg.norm(directions, axis=1, keepdims=True)


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
    square = square + _DAMPING * scale[:, None, None] * np.eye(2)
    right = rows.transpose(0, 2, 1) @ np.stack(offsets, axis=1)[:, :, None]
    return (plane @ np.linalg.solve(square, right))[:, :, 0]


def _deproject_end(
    both: tuple[View, View], end: int, normal: list[Float64], along: list[Float64]
) -> Float64:
    """(3,) step of an end: all four rows of eq. (13), for the images measure both directions there."""
    rows = np.concatenate(
        [np.stack([v.normals[end], v.tangents[end]]) @ v.jacobian[end] for v in both]
    )
    right = np.array([o[end] for pair in zip(normal, along, strict=True) for o in pair])
    square = rows.T @ rows
    square += _DAMPING * np.trace(square) * np.eye(3)
    step: Float64 = np.linalg.solve(square, rows.T @ right)
    return step


def _short_of(step: Float64, control_points: Float64, end: int, least: float) -> Float64:
    """The step of an end, cut so that it stays `least` short of its neighbour.

    Were it to pass, the tangent there would turn round, and the end would run back along the thread.
    """
    gap = _gap(control_points, end)
    toward = (control_points[_BESIDE[end]] - control_points[end]) / max(gap, 1e-12)
    nearer, room = float(step @ toward), max(gap - least, 0.0)
    return step * room / nearer if nearer > room else step


def _gap(control_points: Float64, end: int) -> float:
    return float(np.linalg.norm(control_points[_BESIDE[end]] - control_points[end]))


def _across(tangent: Float64) -> Float64:
    """(k, 3, 2) two unit vectors across each tangent; the Frenet frame fails on straight pieces."""
    helper = np.eye(3)[np.argmin(np.abs(tangent), axis=1)]
    normal = np.cross(tangent, helper)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([normal, np.cross(tangent, normal)], axis=2)

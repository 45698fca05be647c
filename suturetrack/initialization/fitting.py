"""From matched pixels to the NURBS curve: least squares, knots where the shape needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.types import Float32, Float64, Nurbs

DEGREE = 3
_OFFSETS = np.arange(-4.0, 4.01, 0.5)
"""Where the crest is looked for across the curve, px."""
_NEAR_PX = 2.0
"""How far the crest is expected from the curve, px (standard deviation)."""
_CENTROID_REACH = 4
"""Offsets on each side of the peak whose centroid is the crest."""
_SPACING_PX = 2.0
"""Distance of the samples that hold the curve, px."""
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Crest:
    """Where one view shows the crest beside the samples of a curve."""

    normals: Float64
    """(k, 2) unit normals of the projected curve."""
    offsets: Float64
    """(k,) signed distance from the curve to the crest along the normal, px."""
    weights: Float64
    """(k,) response there, in [0, 1]."""


def image_parameters(left: Float64, right: Float64) -> Float64:
    """(k,) parameters from 0 to 1 in proportion to the mean length of the (k, 2) chains."""
    steps = [np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (left, right)]
    travelled = np.r_[0, np.cumsum(steps[0] + steps[1])]
    return travelled / travelled[-1]


def fit_marks(points: Float64, s: Float64, spans: int) -> Nurbs:
    """Least-squares curve through (k, 3) stereo points at parameters `s` (end of Section V)."""
    knots = nurbs.clamped_knots(np.linspace(0, 1, spans + 1)[1:-1], DEGREE)
    return nurbs.fit(points, s, knots, DEGREE, smoothing=1e-9)


def find_crest(field: Float32, pixels: Float64) -> Crest:
    """Looks for the crest across (k, 2) evenly spaced pixels of a projected curve."""
    tangents = np.gradient(pixels, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    profiles = search.normal_profiles(field, pixels, tangents, _OFFSETS)
    expected = profiles * np.exp(-0.5 * (_OFFSETS / _NEAR_PX) ** 2)
    peak = np.argmax(expected, axis=1)
    around = np.arange(-_CENTROID_REACH, _CENTROID_REACH + 1)
    index = np.clip(peak[:, None] + around, 0, len(_OFFSETS) - 1)
    window = np.take_along_axis(profiles, index, 1)
    window = np.maximum(window - window.min(1, keepdims=True), 0) ** 2
    total = window.sum(1)
    offsets = (window * _OFFSETS[index]).sum(1) / np.maximum(total, 1e-12)
    inside = (peak > 0) & (peak < len(_OFFSETS) - 1) & (total > 0)
    heights = np.take_along_axis(profiles, peak[:, None], 1)[:, 0]
    normals = np.c_[-tangents[:, 1], tangents[:, 0]]
    return Crest(normals, offsets, np.where(inside, heights, 0.0))


def refine(
    curve: Nurbs, fields: tuple[Float32, Float32], rig: StereoRig, stiffness_px: float
) -> Nurbs:
    """Gauss-Newton on the crests of both views.

    Args:
        curve: within a few pixels of the crests.
        fields: (H, W, 2) left and right.
        rig: the cameras.
        stiffness_px: wavelength in pixels below which bends are smoothed away. Bending is measured
            in pixels of u, v and disparity, because that is how the images inform depth.
    """
    for _ in range(_ROUNDS):
        held = Held.at(curve, fields, rig)
        curve = held.solve(curve.knots, stiffness_px)
    return curve


@dataclass(frozen=True, eq=False)
class Held:
    """A curve's samples and what the images say about them: the linear problem of one step."""

    s: Float64
    points: Float64
    crests: tuple[Crest, Crest]
    jacobians: tuple[Float64, Float64]

    @classmethod
    def at(cls, curve: Nurbs, fields: tuple[Float32, Float32], rig: StereoRig) -> Held:
        """Looks for the crests beside `curve`."""
        s, points = _samples(curve, rig)
        left, right = rig.project(points)
        crests = find_crest(fields[0], left), find_crest(fields[1], right)
        return cls(s, points, crests, rig.projection_jacobian(points))

    def rows(self, view: int) -> Float64:
        """(k, 3) how the offset in a view changes with the point in space."""
        return np.einsum("ki,kij->kj", self.crests[view].normals, self.jacobians[view])

    def solve(self, knots: Float64, stiffness_px: float) -> Nurbs:
        """The curve over `knots` that fits the crests best."""
        a = nurbs.basis(self.s, knots, DEGREE)
        count = a.shape[1]
        normal, right_side = np.zeros((3 * count, 3 * count)), np.zeros(3 * count)
        for view, crest in enumerate(self.crests):
            rows = self.rows(view)
            design = (a[:, :, None] * rows[:, None]).reshape(len(a), -1)
            weights = crest.weights / (1 + crest.offsets**2)
            target = (rows * self.points).sum(1) + crest.offsets
            normal += design.T @ (weights[:, None] * design)
            right_side += design.T @ (weights * target)
        left, right = self.jacobians
        image = np.concatenate([left, (left - right)[:, :1]], axis=1)
        second = np.asarray(BSpline(knots, np.eye(count), DEGREE)(self.s, 2))
        scale = (stiffness_px / (_SPACING_PX * len(a))) ** 2
        bends = np.einsum("km,kij->kimj", scale * second, image).reshape(-1, 3 * count)
        normal += bends.T @ bends
        stay = np.einsum("km,kij->kimj", _STAY * a, image).reshape(-1, 3 * count)
        normal += stay.T @ stay
        here = _STAY * np.einsum("kij,kj->ki", image, self.points).ravel()
        right_side += stay.T @ here
        return nurbs.curve_from(
            DEGREE, knots, np.linalg.solve(normal, right_side).reshape(count, 3)
        )


_STAY = 0.03


def _samples(curve: Nurbs, rig: StereoRig) -> tuple[Float64, Float64]:
    fine = np.linspace(0, 1, 16 * len(curve.control_points))
    left, right = rig.project(nurbs.evaluate(curve, fine))
    steps = sum(np.linalg.norm(np.diff(p, axis=0), axis=1) for p in (left, right)) / 2
    travelled = np.r_[0, np.cumsum(steps)]
    count = max(int(travelled[-1] / _SPACING_PX), 4 * len(curve.control_points))
    s = np.interp(np.linspace(0, travelled[-1], count), travelled, fine)
    return s, nurbs.evaluate(curve, s)

"""A curve's samples: their basis once, their points and image tangents as the curve moves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search, spline
from suturetrack.types import Bool, Float32, Float64, Int64, Nurbs

_QUARTER_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Samples:
    """Where a cubic curve is looked at: parameters and the basis there."""

    s: Float64
    """(k,) sorted parameters."""
    share: Float64
    """(k,) length of the piece of [0, 1] that each stands for."""
    first: Int64
    """(k,) first of the four control points that move the sample."""
    table: Float64
    """(3, k, 4) basis values, first and second derivatives."""

    @classmethod
    def of(cls, knots: Float64, per_span: int) -> Samples:
        """`per_span` samples in each knot span, evenly, clear of the knots."""
        s, share = spline.even_samples(knots, per_span)
        return cls(s, share, *spline.local_basis(s, knots))

    @classmethod
    def at(cls, knots: Float64, s: Float64) -> Samples:
        """The given sorted parameters."""
        return cls(s, np.gradient(s), *spline.local_basis(s, knots))

    def values(self, control_points: Float64, times: int = 0) -> Float64:
        """(k, dim) points, or derivatives, for (n + 1, dim) control points."""
        return spline.combine(self.first, self.table[times], control_points)

    def gather(self, points: Float64, times: int = 0) -> Float64:
        """(n + 1, dim) sums of (k, dim) samples at the control points: the transpose of `values`."""
        return spline.gather(self.first, self.table[times], points)

    def views(self, rig: StereoRig, control_points: Float64) -> tuple[View, View]:
        """The samples in both images, for (n + 1, 3) control points."""
        return views(rig, self.values(control_points), self.values(control_points, 1))


@dataclass(frozen=True, eq=False)
class View:
    """The samples in one image."""

    pixels: Float64
    """(k, 2) rectified px."""
    tangents: Float64
    """(k, 2) unit tangents."""
    speed: Float64
    """(k,) px of the image curve per unit of s."""
    jacobian: Float64
    """(k, 2, 3) derivative of the pixel."""

    def __getitem__(self, which: slice) -> View:
        """A run of the samples."""
        return View(
            self.pixels[which], self.tangents[which], self.speed[which], self.jacobian[which]
        )

    @property
    def normals(self) -> Float64:
        """(k, 2) unit normals, the tangents turned by +90 degrees."""
        return self.tangents @ _QUARTER_TURN

    def responses(self, image: Float32) -> Float64:
        """(k,) responses of an (H, W, 2) field, eq. (4)'s integrand."""
        return search.responses(image, self.pixels, self.tangents)

    def profiles(self, image: Float32, offsets: Float64) -> Float64:
        """(k, m) the same at the m offsets along the normals, px."""
        return search.normal_profiles(image, self.pixels, self.tangents, offsets, 0.0)

    def inside(self, image_size: tuple[int, int], margin: float = 1.0) -> Bool:
        """(k,) whether the samples lie inside the image."""
        u, v = self.pixels.T
        width, height = image_size
        return (
            (u >= margin) & (v >= margin) & (u <= width - 1 - margin) & (v <= height - 1 - margin)
        )


def views(rig: StereoRig, points: Float64, derivatives: Float64) -> tuple[View, View]:
    """Both images of (k, 3) points with their derivatives by s."""
    left = spline.project_samples(rig.left.projection, points, derivatives)
    right = spline.project_samples(rig.right.projection, points, derivatives)
    return View(*left), View(*right)


def views_at(rig: StereoRig, curve: Nurbs, s: Float64) -> tuple[View, View]:
    """A cubic curve in both images at parameters in [0, 1]."""
    points, first, _ = derivatives_at(curve, s)
    return views(rig, points, first)


def values_at(curve: Nurbs, s: Float64) -> Float64:
    """(k, dim) points of a cubic curve at parameters in [0, 1]."""
    return derivatives_at(curve, s)[0]


def derivatives_at(curve: Nurbs, s: Float64) -> Float64:
    """(3, k, dim) the points, and the first and second derivatives, at parameters in [0, 1]."""
    return spline.evaluate(s, curve.knots, curve.control_points)


@lru_cache(maxsize=32)
def length_of(curve: Nurbs) -> float:
    """Arc length of a cubic curve, by quadrature on each knot span."""
    return float(spline.arc_length(curve.knots, curve.control_points))


def resampled(flags: Bool, s: Float64) -> Bool:
    """(k,) at parameters in [0, 1], what is told at evenly spaced ones."""
    return np.interp(s, np.linspace(0, 1, len(flags)), flags) > 0.5


def leading(flags: Bool, stride: int) -> int:
    """How many of the first samples are flagged, gaps between them bridged by steps of up to `stride`."""
    last = -1
    for j in np.flatnonzero(flags):
        if j - last > stride:
            break
        last = int(j)
    return last + 1


def greville(knots: Float64) -> Float64:
    """(n + 1,) Greville's parameters, at which the control points of a cubic curve act."""
    return (knots[1:-3] + knots[2:-2] + knots[3:-1]) / spline.DEGREE


def distinct(knots: Float64) -> Float64:
    """The sorted knots, each once."""
    is_new = np.ones(len(knots), bool)
    np.greater(knots[1:], knots[:-1], out=is_new[1:])
    return knots[is_new]

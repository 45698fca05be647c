"""Places on a curve, and all that the images say about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.crest import Crest, View, find_crest
from suturetrack.initialization.ends import EndReading, read_end
from suturetrack.polylines import unit
from suturetrack.types import Float64, Nurbs

_SPACING_PX = 2.0
"""Distance of the samples that hold the curve, px."""
_FARTHEST_PX = 1e5
"""Length in the images beyond which a curve has come apart."""
_LEAST_NOISE_PX = 0.025
_NOISE = 0.7
"""Share of the mean square of the offsets that is noise; the rest is what the curve does not follow yet."""
_STAY = 0.01
"""Weight, against that of a crest, which keeps samples from sliding along the thread."""
_UNSEEN = 0.02
"""Trust in a crest below which a view does not see the thread."""
_END_NOISE_PX = 0.1
"""By how much a view shows an end elsewhere than the other one does, px (standard deviation); where both err
alike, as by how far the ridge's filter reaches, the depth is none the worse."""
_LARGEST_END_STEP_PX = 2.0
_BEND_SAMPLES = 8.0
"""Samples over which the visible bending is averaged."""
_LEAST_FREEDOM = 0.3
"""What a straight stretch may bend in disparity, against one that bends as the thread on average."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Places on a curve, evenly spaced in the images, and what the images say there."""

    s: Float64
    """(k,) parameters."""
    points: Float64
    """(k, 3)."""
    length_px: float
    """Mean length of the projected curve."""
    jacobians: tuple[Float64, Float64]
    """(k, 2, 3) derivatives of the left and the right pixel."""
    crests: tuple[Crest, Crest]
    """The ridges of both views beside the curve."""
    outward: Float64
    """(2, 2, 2) view, end: unit vectors along the projected curve out of its ends."""
    ends: tuple[tuple[EndReading, EndReading], tuple[EndReading, EndReading]]
    """View, end: where the thread ends."""

    @classmethod
    def of(cls, curve: Nurbs, views: tuple[View, View], rig: StereoRig) -> Samples:
        """Samples `curve` and looks for the crests beside it.

        Raises:
            FloatingPointError: the curve has left the finite world.
        """
        fine = np.linspace(0, 1, 16 * len(curve.control_points))
        steps = [
            np.linalg.norm(np.diff(p, axis=0), axis=1)
            for p in rig.project(nurbs.evaluate(curve, fine))
        ]
        travelled = np.r_[0, np.cumsum((steps[0] + steps[1]) / 2)]
        if not travelled[-1] < _FARTHEST_PX:
            raise FloatingPointError("it runs out of both images")
        count = max(int(travelled[-1] / _SPACING_PX), 2 * len(curve.control_points))
        s = np.interp(np.linspace(0, travelled[-1], count), travelled, fine)
        points = nurbs.evaluate(curve, s)
        pixels = rig.project(points)
        left, right = (find_crest(v, p) for v, p in zip(views, pixels, strict=True))
        outward = unit(np.array([[p[0] - p[1], p[-1] - p[-2]] for p in pixels]))
        ends_left, ends_right = (
            (read_end(v.field, p), read_end(v.field, p[::-1]))
            for v, p in zip(views, pixels, strict=True)
        )
        return cls(
            s,
            points,
            float(travelled[-1]),
            rig.projection_jacobian(points),
            (left, right),
            outward,
            (ends_left, ends_right),
        )

    @property
    def rows_between_ends(self) -> Float64:
        """(2,) on how different rows the two views show each end; 0 where one does not tell, px."""
        offsets = np.array([[reading.offset_px for reading in ends] for ends in self.ends])
        left, right = offsets * self.outward[:, :, 1]
        return np.nan_to_num(left - right)

    @property
    def distance_px(self) -> float:
        """Mean distance from curve to crest, both views, px."""
        weights = np.concatenate([c.trust for c in self.crests])
        offsets = np.concatenate([np.abs(c.offsets) for c in self.crests])
        return float((weights * offsets).sum() / max(weights.sum(), 1e-9))

    @property
    def variance(self) -> float:
        """Of the noise in the offsets from curve to crest, px^2; at least what no crest goes below."""
        squares = sum((c.trust * c.offsets**2).sum() for c in self.crests)
        mean = squares / max(sum(c.trust.sum() for c in self.crests), 1e-9)
        return max(_NOISE * float(mean), _LEAST_NOISE_PX**2)

    @property
    def image_axes(self) -> Float64:
        """(k, 3, 3) derivatives of u and v in the left view and of the disparity."""
        left, right = self.jacobians
        return np.concatenate([left, (left - right)[:, :1]], axis=1)

    def crest_rows(self) -> list[Float64]:
        """(k, 3) derivatives of the offsets from the crest of each view."""
        return [
            np.einsum("ki,kij->kj", crest.normals, jacobian)
            for crest, jacobian in zip(self.crests, self.jacobians, strict=True)
        ]

    def crest_information(self) -> Float64:
        """(k, 3, 3) what the crests say about the places in space."""
        trusts = [crest.trust[:, None, None] for crest in self.crests]
        squares = [rows[:, :, None] * rows[:, None] for rows in self.crest_rows()]
        return trusts[0] * squares[0] + trusts[1] * squares[1]

    def rest_information(self) -> Float64:
        """(k, 3, 3) what keeps the samples from sliding along the thread, and from going anywhere
        where a view does not see them."""
        normals = self.crests[0].normals
        tangents = np.c_[normals[:, 1], -normals[:, 0]]
        rows = np.einsum("ki,kij->kj", tangents, self.jacobians[0])
        unseen = np.minimum(self.crests[0].trust, self.crests[1].trust) < _UNSEEN
        anywhere = unseen[:, None, None] * gram(self.image_axes)
        return _STAY * (rows[:, :, None] * rows[:, None] + anywhere)

    def bending_information(self, second: Float64) -> tuple[Float64, Float64]:
        """(k, 3, 3) weights of the second derivatives, (k, 3): across the line of sight, and in disparity.

        Disparity may bend more where the thread visibly bends more.
        """
        per_px = np.sqrt(self.length_px / len(self.s)) / self.length_px**2
        image = per_px * self.image_axes
        bend = np.einsum("kij,kj->ki", image[:, :2], second)
        squared = gaussian_filter1d((bend**2).sum(1), _BEND_SAMPLES)
        freedom = squared / max(squared.mean(), 1e-12) + _LEAST_FREEDOM
        return gram(image[:, :2]), gram(image[:, 2:]) / freedom[:, None, None]

    def end_equations(self) -> tuple[Float64, Float64]:
        """What the images say about the places of both ends along the thread: (2, 3, 3) and (2, 3).

        Views that show an end on different rows are not to be reconciled by its depth.
        """
        information, pull = np.zeros((2, 3, 3)), np.zeros((2, 3))
        apart = self.rows_between_ends
        for view, jacobian in enumerate(self.jacobians):
            for end in (0, 1):
                offset = self.ends[view][end].offset_px
                if np.isnan(offset):
                    continue
                row = self.outward[view, end] @ jacobian[-end]
                weight = self.variance / (_END_NOISE_PX**2 + apart[end] ** 2 / 4)
                step = np.clip(offset, -_LARGEST_END_STEP_PX, _LARGEST_END_STEP_PX)
                information[end] += weight * np.outer(row, row)
                pull[end] += weight * step * row
        return information, pull


def gram(rows: Float64) -> Float64:
    """(k, 3, 3) sums over the squares of (k, m, 3) rows."""
    return np.einsum("kij,kil->kjl", rows, rows)

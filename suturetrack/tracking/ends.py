"""Where the thread ends: the step of the ridge response along the curve and beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.ends import before_a_hole, narrowness, widens_at
from suturetrack.kernels.boundary import outer_boundary
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View, derivatives_at, distinct, views, views_at
from suturetrack.types import Float64, Nurbs

_STEP_PX = 0.5
_INWARD_PX, _OUTWARD_PX = 40.0, 10.0
# Samples of whose responses the mean is taken.
_SMOOTHED = 5
# Where the curve tells how long a pixel is.
_ALONG = np.linspace(0, 1, 51)
# Where it tells how the thread goes on, from the end inwards.
_BEND = np.linspace(0, 0.04, 5)
# An end that points along the line of sight is taken to be foreshortened to this part of the rest, at most.
_FORESHORTENED = 0.5
# How near the border of an image the filter shows less and less of a thread that it cuts.
_BORDER_PX = 4.0
# An end that a view shows further away than this from the curve's own is another one, or covered.
_SHOWN_PX = 3.0


@dataclass(frozen=True)
class EndStep:
    """What the images show at one end."""

    offset_px: float
    """How far beyond the curve's end the thread ends, px along the curve; negative: before it."""
    pixel: float
    """Length of a pixel there, as a part of the curve's length."""
    at_border: bool
    """Whether the image's border cuts the thread."""
    alone: bool = True
    """Whether no other ridge runs beside the end, which it could run on along."""
    on_another: bool = False
    """Whether another thread is known to lie there: what goes on beyond the end may be that one."""
    widens: bool = False
    """Whether the ridge is wider there than the thread, and no hole: it may be a tool's."""

    @property
    def offset(self) -> float:
        """The offset as a part of the curve's length."""
        return self.offset_px * self.pixel


@dataclass(frozen=True, eq=False)
class _Tip:
    """An end of the curve, what goes on beyond it, and what the images show there."""

    x: Float64
    """(k,) px beyond the end."""
    outward: float
    """Px outwards per unit of s."""
    both: tuple[View, View]
    """The curve at these places, left and right."""
    responses: Float64
    """(2, k) left and right, of a clear view of the thread."""


def find_ends(curve: Nurbs, images: Images) -> tuple[EndStep | None, EndStep | None]:
    """Looks for the step of the response at the start and at the stop, in both images at once.

    None where there is no thread near the end.
    """
    start, stop = (_find_end(tip, images) for tip in _tips(curve, images))
    return start, stop


def _find_end(tip: _Tip, images: Images) -> EndStep | None:
    x, both, (left, right) = tip.x, tip.both, tip.responses
    inside = both[0].inside(images.rig.image_size) & both[1].inside(images.rig.image_size)
    if np.count_nonzero(inside) < _SMOOTHED:
        return None
    narrow_left, narrow_right = (
        response * narrowness(image, view.pixels, view.tangents, x)
        for image, view, response in zip(images.both, both, tip.responses, strict=True)
    )
    profiles = (left + right) / 2, np.minimum(left, right), (narrow_left + narrow_right) / 2
    x, (mean, least, alone) = x[inside], _smooth(np.stack(profiles)[:, inside])
    found, level = outer_boundary(x, mean, np.minimum(least + 0.15, mean))
    if math.isnan(found):
        return None
    widens = widens_at(x, alone, level)
    boundary = before_a_hole(widens, found)
    at_border = not _clear_of_border(tip, boundary, images.rig.image_size)
    return EndStep(boundary, 1 / abs(tip.outward), at_border, widens=widens < boundary)


def _clear_of_border(tip: _Tip, boundary: float, image_size: tuple[int, int]) -> bool:
    """Whether the thread ends so far inside both images that it is the thread that ends there."""
    place = min(int(np.searchsorted(tip.x, boundary)), len(tip.x) - 1)
    return all(bool(view.inside(image_size, _BORDER_PX)[place]) for view in tip.both)


def end_shifts(curve: Nurbs, images: Images) -> list[tuple[float, Float64] | None]:
    """By how much further the right view shows the thread at the start, and at the stop, than the left.

    It tells the depth of an end where the thread runs along an epipolar line.

    Returns:
        For each end the difference in px along the curve, and its (3,) derivative by the place of the
        end; None where the views do not both show the end.
    """
    return [_end_shift(tip, images) for tip in _tips(curve, images)]


def _end_shift(tip: _Tip, images: Images) -> tuple[float, Float64] | None:
    at_end = int(np.searchsorted(tip.x, 0.0))
    shown, rows = [], []
    for view, response in zip(tip.both, _smooth(tip.responses), strict=True):
        found, _ = outer_boundary(tip.x, response, response)
        # Not where it is nan, either.
        if not (view.inside(images.rig.image_size).all() and abs(found) <= _SHOWN_PX):
            return None
        shown.append(found)
        rows.append(view.tangents[at_end] @ view.jacobian[at_end] / view.speed[at_end])
    return shown[1] - shown[0], tip.outward * (rows[1] - rows[0])


def _tips(curve: Nurbs, images: Images) -> list[_Tip]:
    """The start and the stop of the curve."""
    start, stop = _px_per_s(curve, images.rig)
    outward = -start, stop
    x = [
        np.arange(-min(_INWARD_PX, 0.5 * scale), _OUTWARD_PX + 0.1, _STEP_PX)
        for scale in (start, stop)
    ]
    drawn_out = [_extension(curve, end, x[end] / scale) for end, scale in enumerate((start, stop))]
    points, first = (np.concatenate(parts) for parts in zip(*drawn_out, strict=True))
    both = views(images.rig, points, first)
    responses = np.stack(
        [
            np.minimum(view.responses(image) / level, 1.2)
            for image, view, level in zip(images.both, both, images.levels, strict=True)
        ]
    )
    pieces = slice(len(x[0])), slice(len(x[0]), None)
    return [
        _Tip(x[end], outward[end], (both[0][piece], both[1][piece]), responses[:, piece])
        for end, piece in enumerate(pieces)
    ]


def _smooth(profiles: Float64) -> Float64:
    """Means over a few samples of each row."""
    return np.asarray(uniform_filter1d(profiles, _SMOOTHED, mode="nearest"))


def _px_per_s(curve: Nurbs, rig: StereoRig) -> tuple[float, float]:
    """Speed of the curve in the images at its ends, px per unit of s; at least half of that of the rest."""
    left, right = views_at(rig, curve, _ALONG)
    speed = (left.speed + right.speed) / 2
    least = max(_FORESHORTENED * float(speed.mean()), 1e-6)
    return max(float(speed[:2].mean()), least), max(float(speed[-2:].mean()), least)


def _extension(curve: Nurbs, end: int, beyond: Float64) -> tuple[Float64, Float64]:
    """Points and derivatives at `beyond` past the end: the curve itself, then a parabola."""
    sign = 1.0 if end else -1.0
    inner, outer = np.minimum(beyond, 0.0), np.maximum(beyond, 0.0)[:, None]
    points, first, second = derivatives_at(curve, float(end) + sign * np.r_[-_BEND, inner])
    tip, bend = first[0], second[: len(_BEND)].mean(axis=0)
    points, first = points[len(_BEND) :], first[len(_BEND) :]
    points = points + outer * (sign * tip + outer / 2 * bend)
    return points, np.where(outer > 0, tip + sign * outer * bend, first)


def with_ends(curve: Nurbs, start: float, stop: float) -> Nurbs:
    """The curve over [start, stop]; beyond its ends only where it has knots for that."""
    if len(curve.control_points) == 4:
        # A single span could not be drawn out.
        curve = nurbs.insert_knot(curve, 0.5)
    inner = distinct(curve.knots)[[1, -2]]
    if start < inner[0] and stop > inner[1]:
        return nurbs.with_ends(curve, start, stop)
    return nurbs.part(curve, max(start, 0.0), min(stop, 1.0))

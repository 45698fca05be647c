"""Ridges that branch off the curve and move: where the thread runs if the curve follows something else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from suturetrack.polylines import polyline_length
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View, resampled, views_at
from suturetrack.tracking.strands import Neighbours
from suturetrack.types import Bool, Float32, Float64, Image, Nurbs

_PLACES = 96
# What has moved is where no ridge was at some time in the last seconds, looked at so often.
_PAUSE_NS, _REMEMBERED_NS = 200_000_000, 3_000_000_000
# Responses of a ridge and of nothing, as parts of a clear view of the thread.
_RIDGE, _NOTHING = 0.5, 0.25
_WIDEST_PX = 24
# What is nearer than this to the rim of the thread may be its own; a branch begins and goes further
# away than that.
_OWN_PX, _TOUCHES_PX, _LEAVES_PX = 2.0, 5.0, 6.0
# Length of a branch, and its distance from the ends, in distances of what may be the thread's own; and that
# of a knot's loop, which leads half as far away from a curve that passes it as a point.
_LONG, _FROM_ENDS, _KNOT = 5.0, 5.0, 8.0
# How far around the curve is looked, in the same.
_MARGIN = 12.0
# Looks without it after which what was found has passed by.
_PASSED = 3
# Branches that begin within so many such distances of one another are the same one in both views, and
# one that crosses the curve on both sides of it; what lies still has to begin nearer on the other side.
_SAME, _ACROSS = 12.0, 4.0


@dataclass(frozen=True, eq=False)
class Strangers:
    """What of the last seconds' fields shows which ridges have moved.

    A thread that moves past a vein leaves it where it was. A curve that runs along the vein instead
    leaves the thread out: a ridge that begins at the curve, leaves it to one side, and was not there
    before. What goes on at the other side only crosses the curve.
    """

    is_found: bool = False
    """Whether a ridge that has moved branches off the curve, in both views, at two looks in a row."""
    _quiet: int | None = None
    """Looks without a suspicion since something was found; None while nothing was."""
    _suspected: bool = False
    """The same at the last look alone: a curve may be off in a single field that is blurred."""
    _past: tuple[tuple[int, tuple[Image, Image]], ...] = ()
    """Capture times and where there were ridges, left and right, a bit for each pixel."""

    @property
    def are_gone(self) -> bool:
        """Whether nothing has been suspected for so long that what was found only passed by."""
        return self._quiet is not None and self._quiet >= _PASSED

    def of_another(self) -> Strangers:
        """The same past, of which nothing has been said about another curve yet."""
        return replace(self, is_found=False, _quiet=None, _suspected=False)

    def step(self, curve: Nurbs, seen: Bool, images: Images, others: Neighbours) -> Strangers:
        """With the next field; most fields change nothing.

        Args:
            seen: at evenly spaced parameters.
            others: other threads.
        """
        now = images.field.stamp.capture_ns
        if self._past and 0 <= now - self._past[-1][0] < _PAUSE_NS:
            return self
        past = tuple(then for then in self._past if 0 <= now - then[0] < _REMEMBERED_NS)
        s = np.linspace(0, 1, _PLACES)
        views, shown = views_at(images.rig, curve, s), resampled(seen, s)
        powers = [
            np.asarray((image[..., 0] ** 2 + image[..., 1] ** 2) / level**2, np.float32)
            for image, level in zip(images.both, images.levels, strict=True)
        ]
        branches = np.full(_PLACES, bool(past))
        for side, (power, view, known) in enumerate(zip(powers, views, others.both, strict=True)):
            if branches.any():
                always = np.bitwise_and.reduce([ridges[side] for _, ridges in past])
                stayed = np.unpackbits(always, axis=1, count=power.shape[1])
                own_px = _half_width(images.both[side], view, images.levels[side]) + _OWN_PX
                branches &= _branches(power, stayed, view, shown, known.pixels, own_px)
        suspected = bool(branches.any())
        now_ridges = _packed(powers[0]), _packed(powers[1])
        is_found, quiet = suspected and self._suspected, self._quiet
        if is_found:
            quiet = 0
        elif quiet is not None:
            quiet = 0 if suspected else quiet + 1
        return Strangers(is_found, quiet, suspected, (*past, (now, now_ridges)))


def _packed(power: Float32) -> Image:
    ridges = cv2.dilate((power > _NOTHING**2).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.packbits(ridges, axis=1)


def _around(pixels: Float64, shape: tuple[int, ...], margin: float) -> tuple[slice, slice]:
    """Rows and columns of the image that hold the curve and its surroundings."""
    size = np.array(shape[1::-1])
    low = np.clip(pixels.min(axis=0) - margin, 0, size - 1).astype(int)
    high = np.clip(pixels.max(axis=0) + margin, low + 1, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _half_width(image: Float32, view: View, level: float) -> float:
    """How far from its middle the thread's ridge reaches, px."""
    offsets: Float64 = np.arange(_WIDEST_PX + 1.0)
    profile = np.median(view.profiles(image, offsets), axis=0)
    return float(np.argmax(profile < _NOTHING * level))


def _branches(
    power: Float32, stayed: Image, view: View, seen: Bool, others: Float64, own_px: float
) -> Bool:
    """(k,) places of the curve near which ridges that have moved branch off it to one side.

    Args:
        power: (H, W) squared response, against a clear view of the thread.
        stayed: (H, W) where there always was a ridge.
        others: (m, 2) pixels of other threads.
        own_px: what is nearer to the curve is its own ridge.
    """
    crop = _around(view.pixels, power.shape, _MARGIN * own_px)
    corner = np.array([crop[1].start, crop[0].start], float)
    power, stayed, view = power[crop], stayed[crop], replace(view, pixels=view.pixels - corner)
    away = _distances(power.shape, view.pixels, others - corner)
    ridge = (power > _RIDGE**2) & (away > own_px)
    if not (ridge & (stayed == 0)).any():
        return np.zeros(len(view.pixels), bool)
    touched, moved = _sides(ridge, stayed, away, view, own_px)
    spacing = max(polyline_length(view.pixels), 1.0) / (len(seen) - 1)
    same, across = (round(times * own_px / spacing) for times in (_SAME, _ACROSS))
    one_sided = [
        moved[side] & ~_widened(moved[1 - side], same) & ~_widened(touched[1 - side], across)
        for side in (0, 1)
    ]
    ends = np.linalg.norm(view.pixels[:, None] - view.pixels[[0, -1]], axis=2).min(axis=1)
    may_be = seen & (ends > _FROM_ENDS * own_px)
    return _widened((one_sided[0] | one_sided[1]) & may_be, same)


def _sides(
    ridge: Bool, stayed: Image, away: Float32, view: View, own_px: float
) -> tuple[Bool, Bool]:
    """(2, k) on which side of the curve's places ridges begin there, and those of them that have moved."""
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(ridge.astype(np.uint8))
    touched, moved = np.zeros((2, 2, len(view.pixels)), bool)
    for label in range(1, count):
        left, top, width, height, _ = boxes[label]
        if max(width, height) < _LEAVES_PX - _OWN_PX:
            continue
        box = slice(top, top + height), slice(left, left + width)
        piece = labels[box] == label
        if away[box][piece].max() < own_px + _LEAVES_PX - _OWN_PX:
            continue
        begins = np.argwhere(piece & (away[box] < own_px + _TOUCHES_PX - _OWN_PX))
        there = begins[:, None, ::-1] + [left, top] - view.pixels
        gaps = np.linalg.norm(there, axis=2)
        beside = np.flatnonzero(gaps.min(axis=1) < own_px + _TOUCHES_PX)
        places = gaps[beside].argmin(axis=1)
        is_left = np.sum(there[beside, places] * view.normals[places], axis=1) > 0
        touched[is_left.astype(int), places] = True
        new = np.argwhere(piece & (stayed[box] == 0))
        length = np.linalg.norm(np.ptp(new, axis=0)) if len(new) else 0.0
        is_knot = length < _KNOT * own_px and length / 2 < away[box][piece].max()
        if length > _LONG * own_px and not is_knot:
            moved[is_left.astype(int), places] = True
    return touched, moved


def _widened(flags: Bool, reach: int) -> Bool:
    size = min(2 * reach + 1, len(flags))
    return np.asarray(np.convolve(flags, np.ones(size), "same") > 0.5)


def _distances(shape: tuple[int, ...], curve: Float64, others: Float64) -> Float32:
    """(H, W) px to the curve or to another thread, whichever is nearer."""
    free = np.full(shape, 255, np.uint8)
    points = np.round(8 * curve).astype(np.int32)
    cv2.polylines(free, [points], False, 0, 1, cv2.LINE_8, 3)
    inside = np.all((others >= 0) & (others <= np.array(shape[::-1]) - 1), axis=1)
    u, v = np.round(others[inside]).astype(int).T
    free[v, u] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 3), np.float32)

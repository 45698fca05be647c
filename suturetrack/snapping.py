"""From a rough place to the thread that is meant: a click, a box, a laser's spot, the tip of a tool."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig, InitializationError, initialize
from suturetrack.initialization.result import nearest_ridges
from suturetrack.initialization.segments import find_ridges, nearest_segment
from suturetrack.polylines import nearest_index
from suturetrack.types import Float32, Float64, Image, InputError, Nurbs, RidgeField, Seed

_SAMPLES = 400
_ROWS_PX = 1.0
"""How far apart the rows of two ridge points of one place may be."""

_SAME_PX = 3.0
"""How near to a curve a ridge is that belongs to it."""

_WIDEST, _BREAK = 1 / 12, 1 / 80
"""Of a laser's spot, its diameter and the dark thread that may part it, as shares of the image's height."""
_CLIPPED, _LIFT, _CORE = 250, 96, 0.75
"""Grey levels that a laser's spot reaches, those by which it is brighter than its surroundings, and the
share of the largest such lift in the image from which on a pixel belongs to a spot."""
_ROUND, _SMALLEST_PX2 = 0.5, 5
"""Least share of the circle around it that a spot fills, and its least area."""
_ALIKE = 0.5
"""Two spots are alike when the weaker has more than this share of the other's strength."""


@dataclass(frozen=True, eq=False)
class Snap:
    """A place on a ridge of one view, rectified pixels."""

    pixel: Float64
    """(2,)."""
    segment: Float64
    """(k, 2) the unbranched stretch of ridge that it lies on."""


def snap_pixel(
    view: Float32, pixel: Float64, config: InitializationConfig
) -> tuple[Snap | None, Float64]:
    """The ridge that a seed at this pixel means, None without one, and (k, 2) the ridges nearest to it.

    Args:
        view: (H, W, 2) field of one view.
        pixel: (2,) rectified.
        config: of the initialisation that the seed is for.
    """
    ridges = find_ridges(view, config)
    index, candidates = nearest_segment(ridges, pixel, config.snap_px)
    if index is None:
        return None, candidates
    segment = ridges.segments[index]
    return Snap(segment[nearest_index(segment, pixel)], segment), candidates


def snap_area(view: Float32, corners: Float64, config: InitializationConfig) -> Snap | None:
    """The middle of the clearest ridge within a box; None where there is none.

    Args:
        view: (H, W, 2) field of one view.
        corners: (2, 2) rectified pixels of two opposite corners.
        config: of the initialisation that the seed is for.
    """
    ridges = find_ridges(view, config)
    low, high = corners.min(axis=0), corners.max(axis=0)
    best, most = None, 0.0
    for segment in ridges.segments:
        inside = segment[((segment >= low) & (segment <= high)).all(axis=1)]
        clear = float(ridges.sample(inside).sum()) if len(inside) else 0.0
        if clear > most:
            best, most = Snap(inside[len(inside) // 2], segment), clear
    return best


def pixel_in_area(
    field: RidgeField,
    rig: StereoRig,
    area: tuple[float, float, float, float],
    *,
    right: bool = False,
    config: InitializationConfig = InitializationConfig(),
) -> tuple[float, float]:
    """(u, v) of the clearest ridge within a box of a raw image, in that image.

    Args:
        field: both views.
        rig: the cameras.
        area: (u, v, u, v) of two opposite corners, pixels of the raw image.
        right: whether that is the right image.
        config: of the initialisation that the seed is for.

    Raises:
        InputError: there is none, or a number is not within the image.
    """
    width, height = rig.image_size
    for number, side in zip(area, 2 * rig.image_size, strict=True):
        if not 0 <= number <= side:
            given = " ".join(f"{number:g}" for number in area)
            raise InputError(f"area {given}: {number:g} is not within the {width}x{height} image")
    corners = rig.rectify_pixels(np.reshape(area, (2, 2)).astype(float), right=right)
    found = snap_area(field.right if right else field.left, corners, config)
    if found is None:
        raise InputError(
            "nothing in the area looks like thread; draw it around a part of the thread"
        )
    u, v = rig.raw_pixels(found.pixel, right=right).tolist()
    return u, v


def laser_spot(image: Image) -> tuple[float, float]:
    """(u, v) of the middle of the one laser spot in a raw image.

    A spot is small, round, clipped by the sensor in at least one channel, and far brighter than what
    surrounds it. Seen on a dark thread, it may be parted by it.

    Args:
        image: (H, W, 3) BGR or (H, W) gray, uint8.

    Raises:
        InputError: there is no such spot, or another one is about as strong.
    """
    spots = sorted(_spots(image), reverse=True)
    if not spots:
        raise InputError("no laser spot in the image; point it at the thread, or dim the light")
    alike = [spot.pixel for spot in spots if spot.strength > _ALIKE * spots[0].strength]
    if len(alike) > 1:
        places = ", ".join(f"{u:.0f} {v:.0f}" for u, v in alike[:5])
        raise InputError(
            f"{len(alike)} spots in the image may be the laser's: {places}; seed at one of them, or "
            "dim the light"
        )
    return spots[0].pixel


def snap_point(
    field: RidgeField,
    rig: StereoRig,
    point: Float64,
    radius: float,
    config: InitializationConfig = InitializationConfig(),
) -> Float64 | None:
    """(3,) the point on a thread nearest to a point in space; None without one within `radius`.

    Args:
        field: both views.
        rig: the cameras.
        point: (3,) rectified left frame, calibration's unit.
        radius: calibration's unit.
        config: which ridges count.
    """
    if not point[2] > 0:
        return None
    # More than it needs, also away from the axis: the distance in space decides.
    reach_px = 2 * radius * rig.focal / point[2]
    near = []
    for view, pixel in zip((field.left, field.right), rig.project(point), strict=True):
        segments = find_ridges(view, config).segments
        points = np.concatenate(segments) if segments else np.empty((0, 2))
        near.append(points[np.linalg.norm(points - pixel, axis=1) <= reach_px])
    left, right = near
    i, j = np.nonzero(abs(left[:, None, 1] - right[None, :, 1]) <= _ROWS_PX)
    places = rig.triangulate(left[i], right[j])
    distance = np.linalg.norm(places - point, axis=1)
    if len(distance) == 0 or not distance.min() <= radius:
        return None
    return places[np.argmin(distance)]


def point_of_right_pixel(
    field: RidgeField,
    rig: StereoRig,
    pixel: Float64,
    config: InitializationConfig = InitializationConfig(),
) -> Float64:
    """(3,) the point on the thread that a click in the right view means.

    A row of the left view crosses several ridges: each is tried, and the thread counts that passes
    through the click in the right view.

    Args:
        field: both views.
        rig: the cameras.
        pixel: (2,) rectified right view.
        config: of the initialisation that the seed is for.

    Raises:
        InitializationError: there is no ridge at the pixel (its candidates are in the right view), or
            the left view shows no thread that would appear there.
    """
    found, candidates = snap_pixel(field.right, pixel, config)
    if found is None:
        near = nearest_ridges(candidates, rig, right=True)
        raise InitializationError(f"the right view shows no thread there; {near}", candidates)
    best, most = None, -1.0
    curves: list[Nurbs] = []
    for left in _on_row(field, rig, found.pixel, config):
        if any(_distance_px(rig.project(_dense(c))[0], left)[1] < _SAME_PX for c in curves):
            continue
        u, v = (float(x) for x in rig.raw_pixels(left))
        try:
            start = initialize(field, rig, Seed(pixel=(u, v)), config)
        except InitializationError:
            continue
        curves.append(start.curve)
        points = _dense(start.curve)
        index, distance = _distance_px(rig.project(points)[1], found.pixel)
        if distance < _SAME_PX and start.confidence > most:
            best, most = points[index], start.confidence
    if best is None:
        raise InitializationError("the left view shows no thread that matches", np.empty((0, 2)))
    return best


class _Spot(NamedTuple):
    strength: float
    pixel: tuple[float, float]


def _spots(image: Image) -> list[_Spot]:
    """Everything in an image that may be a laser's spot."""
    smooth = cv2.GaussianBlur(image, (0, 0), 0.7)
    lift = _brightest(cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT, _disc(image, _WIDEST)))
    lifted = (lift >= max(_LIFT, _CORE * int(lift.max()))).astype(np.uint8)
    whole = cv2.morphologyEx(lifted, cv2.MORPH_CLOSE, _disc(image, _BREAK))
    _, labels, boxes, centres = cv2.connectedComponentsWithStats(whole)
    spots = []
    for label in range(1, len(boxes)):
        left, top, width, height, area = boxes[label].tolist()
        box = slice(top, top + height), slice(left, left + width)
        own = labels[box] == label
        _, radius = cv2.minEnclosingCircle(np.argwhere(own).astype(np.float32))
        is_round = area >= _ROUND * np.pi * (radius + 0.5) ** 2
        is_clipped = _brightest(image[box])[own].max() >= _CLIPPED
        if area >= _SMALLEST_PX2 and is_round and is_clipped:
            u, v = centres[label].tolist()
            spots.append(_Spot(float(lift[box][own].max()) * area**0.5, (u, v)))
    return spots


def _brightest(image: Image) -> Image:
    """(H, W) the largest of the channels."""
    return image if image.ndim == 2 else image.max(axis=2)


def _disc(image: Image, share: float) -> Image:
    size = 2 * round(share * image.shape[0] / 2) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.uint8)


def _on_row(
    field: RidgeField, rig: StereoRig, right: Float64, config: InitializationConfig
) -> list[Float64]:
    """Where ridges of the left view cross the row of a right pixel, nearest disparity first."""
    farthest = right[0] + rig.disparity_at_infinity
    places = []
    for segment in find_ridges(field.left, config).segments:
        ahead = segment[segment[:, 0] > farthest]
        row = abs(ahead[:, 1] - right[1])
        if len(row) and row.min() <= _ROWS_PX:
            places.append(ahead[np.argmin(row)])
    return sorted(places, key=lambda place: float(place[0]))


def _dense(curve: Nurbs) -> Float64:
    return nurbs.evaluate(curve, np.linspace(0, 1, _SAMPLES))


def _distance_px(line: Float64, pixel: Float64) -> tuple[int, float]:
    """Index of the sample nearest to a pixel, and its distance."""
    distance = np.linalg.norm(line - pixel, axis=1)
    return int(np.argmin(distance)), float(distance.min())

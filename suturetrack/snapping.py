"""From a rough place to the ridge that is meant: a click, a box, the tip of a tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig
from suturetrack.initialization.growth import nearest_segment
from suturetrack.initialization.segments import find_ridges
from suturetrack.types import Float32, Float64, RidgeField

_ROWS_PX = 1.0
"""How far apart the rows of two ridge points of one place may be."""


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
    return Snap(segment[np.argmin(np.linalg.norm(segment - pixel, axis=1))], segment), candidates


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
    reach_px = radius * rig.focal / point[2]
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

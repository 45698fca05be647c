"""Where a jump of the camera or of the whole thread has put the curve in the images."""

from __future__ import annotations

import numpy as np

from suturetrack.kernels import search
from suturetrack.nurbs import curve_from
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View, views_at
from suturetrack.types import Float64, Nurbs

_PLACES = 40
# Reach and step, coarse and then fine.
_GRIDS_PX = ((42.0, 3.0), (2.0, 1.0))
# What a pixel of the shift has to show more of the thread, as a part of all of it.
_PRICE = 0.0012


def shifted(curve: Nurbs, images: Images) -> Nurbs:
    """The predicted curve, moved sidewise as a whole to where the images show most of the thread."""
    s = np.linspace(0, 1, _PLACES)
    both = views_at(images.rig, curve, s)
    best: Float64 = np.zeros(2)
    for reach, step in _GRIDS_PX:
        steps = np.arange(-reach, reach + step / 2, step)
        shifts = best + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        shown = _shown(both, shifts, images)
        best = shifts[np.argmax(shown - _PRICE * np.hypot(*shifts.T))]
    depth = curve.control_points[:, 2:]
    focal = images.rig.left.projection[[0, 1], [0, 1]]
    offset = np.hstack([best * depth / focal, np.zeros_like(depth)])
    return curve_from(curve.degree, curve.knots, curve.control_points + offset)


def shown(curve: Nurbs, images: Images) -> float:
    """How much of the thread the images show where the curve is, in [0, 1]."""
    s = np.linspace(0, 1, _PLACES)
    both = views_at(images.rig, curve, s)
    return float(_shown(both, np.zeros((1, 2)), images)[0])


def _shown(both: tuple[View, View], shifts: Float64, images: Images) -> Float64:
    """(n,) how much of the thread the images show under each of n shifts, in [0, 1]."""
    shown = np.zeros(len(shifts))
    for image, view, level in zip(images.both, both, images.levels, strict=True):
        means = search.shifted_responses(image, view.pixels, view.tangents, shifts, level)
        shown += means / level / 2
    return shown

"""Pictures in which somebody has cut the thread out: of its shades only the outline is to be believed."""

from __future__ import annotations

import cv2
import numpy as np

from suturetrack.types import Image, StereoFrame

_GROUND = 0.8
"""Least share of pixels that are pure white, or pure black, where a thread was cut out."""
_HARD = 0.5
"""How far the rim stands out, against the whole, where it was cut rather than seen through a lens."""
_WEAKEST_RIM = 0.1
"""Share of the rim that may stand out less."""
_SHADE = 115
"""Grey level of a silhouette, on white."""
_WIDE = 0.9
"""Quantile of the widths along a thread that a filter has to suit."""
_OF_WIDTH = 0.6
"""Scale at which a silhouette is one ridge, as a share of its width."""


def is_cut_out(frame: StereoFrame) -> bool:
    """Whether both images show something with hard rims on pure white or pure black."""
    return all(_is_cut_out(image) for image in (frame.left, frame.right))


def silhouettes(frame: StereoFrame) -> StereoFrame:
    """The frame with gray images in which what was cut out is of one shade, on white.

    A highlight on a thread on white has the colour of the ground: its rims would look like two threads.
    """
    left, right = (
        np.where(_strength(image) > 0, np.uint8(_SHADE), np.uint8(255))
        for image in (frame.left, frame.right)
    )
    return StereoFrame(frame.stamp, left, right)


def silhouette_scale(image: Image) -> float:
    """Scale, px, of the filter that sees nearly every part of a silhouette as one ridge."""
    inside = (image < 255).astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5)
    middle = (inside > 0) & (depth >= cv2.dilate(depth, np.ones((3, 3))))
    return float(_OF_WIDTH * np.quantile(2 * depth[middle] - 1, _WIDE))


def _is_cut_out(image: Image) -> bool:
    strength = _strength(image)
    inside = strength > 0
    if not 0 < inside.mean() <= 1 - _GROUND:
        return False
    rim = strength[inside & (cv2.erode(inside.astype(np.uint8), np.ones((3, 3))) == 0)]
    return bool(np.quantile(rim, _WEAKEST_RIM) >= _HARD * np.median(strength[inside]))


def _strength(image: Image) -> Image:
    """(H, W) how far each pixel is from pure white, or black where most is, in its farthest channel."""
    away = 255 - image if image[::4, ::4].mean() > 127 else image
    return np.asarray(away if away.ndim == 2 else away.max(axis=2))

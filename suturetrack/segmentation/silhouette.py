"""Pictures in which somebody has cut the thread out: of its shades only the outline is to be believed."""

from __future__ import annotations

import cv2
import numpy as np

from suturetrack.types import Bool, Float32, Image, StereoFrame

_GROUND = 0.8
"""Least share of the pixels that are ground, where a thread was cut out."""
_PURE = 0.4
"""Least share of the values that are white, or black: noise about it leaves half of them so."""
_PLAIN = 0.2
"""How far the ground beside the thread may stand out, against the thread; shadows do more."""
_BESIDE_PX = 3, 8
"""How far from the thread the ground is beside it."""
_RINGING = 0.8, 1.5
"""A quantile of the ground beside the thread, and how much more than that is still ground."""
_FULL = 0.12
"""How far a pixel stands out, against the thread, from which it is wholly inside."""
_HARD = 0.5
"""How far the rim stands out, against the whole, where it was cut rather than seen through a lens."""
_PATCHY = 0.85
"""How far the middle stands out, against the whole, where it has the colour of the ground in places."""
_WEAKEST = 0.1
"""Share of the rim, or of the middle, that may stand out less."""
_SHADE = 115
"""Grey level of a silhouette, on white."""
_WIDE = 0.9
"""Quantile of the widths along a thread that a filter has to suit."""
_OF_WIDTH = 0.6
"""Scale at which a silhouette is one ridge, as a share of its width."""


def is_cut_out(frame: StereoFrame) -> bool:
    """Whether both images show something on nothing but white or black, with hard rims or in shades
    that come near those of the ground."""
    return all(_is_cut_out(image) for image in (frame.left, frame.right))


def silhouettes(frame: StereoFrame) -> StereoFrame:
    """The frame with gray images in which what was cut out is of one shade, on white.

    A highlight on a thread on white has the colour of the ground: its rims would look like two threads.
    """
    left, right = (_silhouette(image) for image in (frame.left, frame.right))
    return StereoFrame(frame.stamp, left, right)


def silhouette_scale(image: Image) -> float:
    """Scale, px, of the filter that sees nearly every part of a silhouette as one ridge."""
    depth, middle = _middle(image)
    return float(_OF_WIDTH * np.quantile(2 * depth[middle] - 1, _WIDE))


def _middle(image: Image) -> tuple[Float32, Bool]:
    """(H, W) how deep the pixels are inside a silhouette, and which are as deep as any beside them."""
    inside = (image < (255 + _SHADE) // 2).astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(depth), (inside > 0) & (depth >= cv2.dilate(depth, _square(1)))


def _is_cut_out(image: Image) -> bool:
    pure = 255 if _is_on_white(image) else 0
    if (image == pure).mean() < _PURE or (image == pure).all():
        return False
    strength = _strength(image)
    thread, ground = _levels(strength)
    inside = (strength > ground).astype(np.uint8)
    if ground > _PLAIN * thread or inside.mean() > 1 - _GROUND:
        return False
    rim = strength[(inside > 0) & (cv2.erode(inside, _square(1)) == 0)]
    if np.quantile(rim, _WEAKEST) >= _HARD * np.median(strength[inside > 0]):
        return True
    depth, middle = _middle(_silhouette(image))
    shades = strength[middle & (depth > 1)]
    return bool(shades.size and np.quantile(shades, _WEAKEST) < _PATCHY * thread)


def _silhouette(image: Image) -> Image:
    strength = _strength(image)
    thread, ground = _levels(strength)
    inside = (strength - np.float32(ground)) / np.float32(max(_FULL * thread, 1))
    return np.asarray(255 - (255 - _SHADE) * np.clip(inside, 0, 1) + 0.5, np.uint8)


def _levels(strength: Float32) -> tuple[float, float]:
    """How far the thread stands out, and up to where it is the ground beside it."""
    strong = (strength > strength.max() / 2).astype(np.uint8)
    near, far = (cv2.dilate(strong, _square(reach)) for reach in _BESIDE_PX)
    beside = strength[(far > 0) & (near == 0)]
    if not strong.any() or not beside.size:
        return 0.0, 0.0
    quantile, more = _RINGING
    return float(np.median(strength[strong > 0])), more * float(np.quantile(beside, quantile))


def _strength(image: Image) -> Float32:
    """(H, W) how far each pixel is from white, or black where most is, in its farthest channel."""
    away = 255 - image if _is_on_white(image) else image
    return np.asarray(away if away.ndim == 2 else away.max(axis=2), np.float32)


def _square(reach: int) -> Image:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def _is_on_white(image: Image) -> bool:
    return bool(image[::4, ::4].mean() > 127)

"""The ridge vector field in false colour (Fig. 2)."""

from __future__ import annotations

import cv2
import numpy as np

from suturetrack.types import Float32, Image

# Hue by half the angle in degrees: OpenCV's 180 hues for the directions of half a turn.
_HUES = (2 * np.arange(256) % 180).astype(np.uint8)


def direction_image(field_view: Float32) -> Image:
    """The field of one view in false colour (Fig. 2): hue is direction, brightness is length.

    Args:
        field_view: (H, W, 2) float32, a view of a `RidgeField`.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    u, v = cv2.split(field_view)
    length, angle = cv2.cartToPolar(u, v, angleInDegrees=True)
    hue = cv2.LUT(cv2.convertScaleAbs(angle, alpha=0.5), _HUES)
    value = cv2.convertScaleAbs(length, alpha=255)
    return cv2.cvtColor(cv2.merge([hue, np.full_like(hue, 255), value]), cv2.COLOR_HSV2BGR)


def direction_key(size: int = 64) -> Image:
    """The key to `direction_image`: a wheel in which every spoke has the colour of its direction.

    Returns:
        (size, size, 3) uint8 BGR, black outside the wheel.
    """
    axis = np.linspace(-1, 1, size, dtype=np.float32)
    spokes = np.dstack(np.meshgrid(axis, axis))
    radius = np.linalg.norm(spokes, axis=-1, keepdims=True)
    wheel = (radius > 0.25) & (radius <= 1)
    return direction_image(np.where(wheel, spokes / np.maximum(radius, 0.25), 0).astype(np.float32))

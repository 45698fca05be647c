"""The colours of what looks like thread."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import ridge
from suturetrack.types import Colours, Float32, StereoFrame

_LEAST = 0.1
"""Length of a vector from which the colour of its pixel is told."""


class Colouring:
    """Tells the colours of one rig's fields."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._room = np.empty(rig.image_size[0] * rig.image_size[1], np.int32)

    def of(
        self, frame: StereoFrame, left: Float32, right: Float32
    ) -> tuple[Colours, Colours] | None:
        """The colours of both views, fields (H, W, 2) of the frame; None for gray images."""
        if frame.left.ndim == 2:
            return None
        # Both are found in the same room, one after the other.
        pixels = [ridge.longer_than(_LEAST, view, self._room) for view in (left, right)]
        return (
            Colours(pixels[0], self._rig.rectified_at(frame.left, pixels[0])),
            Colours(pixels[1], self._rig.rectified_at(frame.right, pixels[1], right=True)),
        )

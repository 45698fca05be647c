"""Interlaced video: rows of one picture taken at two moments, so that what moves is combed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suturetrack.types import Image

_TEETH = 12
"""Gray levels between neighbouring rows that make a tooth; above the noise of cameras."""
_COMBED = 0.002
"""Share of the pixels that is combed where something moves in interlaced video."""
_EVERY, _LOOKS = 10, 60
"""Frames from one look to the next, and how many there are."""
_STRIDE = 4
"""Of the columns of rows, and of the rows of columns, one in so many is looked at."""


def combing(image: Image) -> float:
    """How much larger the share of pixels is that alternate from row to row than from column to column.

    Args:
        image: (H, W) or (H, W, 3).
    """
    gray = (image if image.ndim == 2 else image[..., 1]).astype(np.int16)
    return _alternating(gray[:, ::_STRIDE]) - _alternating(gray.T[:, ::_STRIDE])


class CombWatch:
    """Looks at some of the first frames until one is combed."""

    def __init__(self) -> None:
        self._frames = 0
        self._done = False

    def sees(self, image: Image) -> bool:
        """Whether this is the first frame seen to be combed."""
        looks, others = divmod(self._frames, _EVERY)
        self._frames += 1
        if self._done or others or looks >= _LOOKS:
            return False
        self._done = combing(image) > _COMBED
        return self._done


def _alternating(gray: NDArray[np.int16]) -> float:
    """Share of the pixels where three steps in a row go up and down by a tooth each."""
    steps = np.diff(gray, axis=0)
    up, down = steps > _TEETH, steps < -_TEETH
    teeth = (up[:-2] & down[1:-1] & up[2:]) | (down[:-2] & up[1:-1] & down[2:])
    return float(teeth.mean()) if teeth.size else 0.0

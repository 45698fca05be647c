"""Interlaced video: rows of one picture taken at two moments, so that what moves is combed."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Image

_TEETH = 12.0
"""Gray levels between neighbouring rows that make a tooth; above the noise of cameras."""
_COMBED = 0.002
"""Share of the pixels that is combed where something moves in interlaced video."""
_EVERY = 10
"""Frames between two looks."""


def combing(image: Image) -> float:
    """How much larger the share of pixels is that alternate from row to row than from column to column.

    Args:
        image: (H, W) or (H, W, 3).
    """
    gray = image.astype(np.float32) if image.ndim == 2 else image.mean(axis=2, dtype=np.float32)
    return _alternating(gray) - _alternating(gray.T)


class CombWatch:
    """Looks at some frames until one is combed."""

    def __init__(self) -> None:
        self._until = 0
        self._told = False

    def sees(self, image: Image) -> bool:
        """Whether this is the first frame seen to be combed."""
        self._until -= 1
        if self._told or self._until > 0:
            return False
        self._until = _EVERY
        self._told = combing(image) > _COMBED
        return self._told


def _alternating(gray: np.ndarray) -> float:
    """Share of the pixels where three steps in a row go up and down by a tooth each."""
    steps = np.diff(gray, axis=0)
    up, down = steps > _TEETH, steps < -_TEETH
    teeth = (up[:-2] & down[1:-1] & up[2:]) | (down[:-2] & up[1:-1] & down[2:])
    return float(teeth.mean()) if teeth.size else 0.0

"""Images that show nothing, or not enough: empty, black, saturated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from suturetrack.types import Image

_CLIPPED = 0.5
"""Share of the values that are 255 in a saturated image."""
_DARK = 100
"""Black on pure white is no saturation: a tenth of what is not clipped is darker than this."""
_BLACK = 12
"""99 % of the values of a black image are below."""
_EVERY, _STRIDE = 10, 4
"""Frames from one look to the next; of the rows and columns, one in so many is looked at."""


def exposure_fault(image: Image) -> str:
    """What is wrong, as in "the image is ..."; empty when nothing is.

    Args:
        image: (H, W) or (H, W, 3).
    """
    counts = np.bincount(image.ravel(), minlength=256)
    levels = np.flatnonzero(counts)
    if len(levels) == 1:
        return f"empty: every pixel is {levels[0]}"
    if _quantile(counts, 0.99) < _BLACK:
        return "black: is the light on, and the lens uncovered?"
    clipped = counts[255] / image.size
    if clipped > _CLIPPED and _quantile(counts[:255], 0.1) > _DARK:
        return (
            f"saturated: {clipped:.0%} of its values are clipped; lower the exposure or the light"
        )
    return ""


def _quantile(counts: NDArray[np.int64], share: float) -> int:
    """The value below which, or at which, a share of all values lies."""
    below = np.cumsum(counts)
    return int(np.searchsorted(below, share * below[-1]))


class ExposureWatch:
    """Looks at some of the frames, and tells what was wrong with the last one of them."""

    def __init__(self) -> None:
        self._frames = 0
        self._fault = ""

    def fault(self, left: Image, right: Image) -> str:
        """What is wrong by now, whole; empty when nothing is."""
        if self._frames % _EVERY == 0:
            faults = {
                name: exposure_fault(image[::_STRIDE, ::_STRIDE])
                for name, image in (("left", left), ("right", right))
            }
            self._fault = "; ".join(
                f"the {n} image is {fault}" for n, fault in faults.items() if fault
            )
        self._frames += 1
        return self._fault

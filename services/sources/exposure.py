"""Images that show nothing, or not enough: empty, black, saturated."""

from __future__ import annotations

import numpy as np

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
    lowest, highest = int(image.min()), int(image.max())
    if lowest == highest:
        return f"empty: every pixel is {lowest}"
    if np.percentile(image, 99) < _BLACK:
        return "black: is the light on, and the lens uncovered?"
    clipped = float((image == 255).mean())
    if clipped > _CLIPPED and np.percentile(image[image < 255], 10) > _DARK:
        return (
            f"saturated: {clipped:.0%} of its values are clipped; lower the exposure or the light"
        )
    return ""


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

"""Parameters of the segmenter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from suturetrack.types import InputError, check_ranges

Channel = Literal["learned", "gray", "blue", "green", "red"]
Polarity = Literal["auto", "dark", "bright", "both"]


@dataclass(frozen=True)
class SegmentationConfig:
    """How the images are turned into the ridge vector field."""

    sigmas: tuple[float, ...] | None = None
    """Standard deviations of the Gaussian whose second derivatives are taken, px: a third to half of
    the thread's width. Of several, the one with the longest vector counts at each pixel. None: 1.2
    until a seed shows how wide the thread is."""
    beta: float = 0.5
    """Beta of eq. (1): how far a ridge may be from straight and endless before it fades."""
    c: float | None = None
    """c of eq. (1), grey levels: the strength S at which a ridge counts by 40 %. None: half the
    99.8th percentile of S until a seed shows the thread's S, then half of that; it follows the
    brightness of the image."""
    blur: float = 1.2
    """Standard deviation of the Gaussian G of Algorithm 1, px, on a window of 5x5."""
    channel: Channel = "learned"
    """Which channel, or mix of channels, is looked at. `learned`: gray until a seed shows what
    tells the thread from its surroundings."""
    polarity: Polarity = "auto"
    """Whether the thread is darker or brighter than its surroundings. `auto`: dark until a seed
    shows otherwise."""
    adapt: bool = True
    """Whether what was learned of a thread follows, once a second, how it looks along its curve."""

    def __post_init__(self) -> None:
        if self.sigmas == ():
            raise InputError("--segmentation.sigmas: give at least one, or None")
        check_ranges(
            self,
            "segmentation",
            sigmas=(0.3, 20),
            beta=(0.01, 100),
            c=(0.01, 10_000),
            blur=(0.1, 20),
        )

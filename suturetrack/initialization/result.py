"""What comes of the initialisation."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from suturetrack.camera import StereoRig
from suturetrack.nurbs import reversed_curve
from suturetrack.types import Float32, Float64, Nurbs

PlacedDoubts = tuple[tuple[tuple[float, float], ...], tuple[tuple[float, float], ...]]
"""The parameters of a curve where the left and the right view are in doubt, and what each leaves of the
confidence."""
ENDS = "first end", "last end"
"""How reasons call the ends of a curve."""
_MEANT = 0.3
"""What is left of the confidence where the seed lies on another strand as well: of twelve such starts,
among 141 in clutter, three were right."""
_EITHER = "the seed lies on another strand as well; seed it where it runs alone"


@dataclass(frozen=True, eq=False)
class ViewGrowth:
    """What the growth found in one view (Fig. 3), in rectified pixels."""

    cost: Float32
    """(H, W) L of eq. (3); infinite where the growth did not come."""
    segments: tuple[Float64, ...]
    """Unbranched stretches of ridge that the growth reached, each (k, 2)."""
    merges: Float64
    """(m, 2, 2) the pairs of segment ends that were joined into the thread."""
    rejected: tuple[tuple[Float64, str], ...]
    """Segments that are no part of the thread, and why."""

    def enlarged(self, scale: int, shape: tuple[int, ...]) -> ViewGrowth:
        """The same in the pixels of the whole image, (H, W, ...), that was reduced by `scale`."""
        cost = self.cost.repeat(scale, axis=0).repeat(scale, axis=1)[: shape[0], : shape[1]]
        return ViewGrowth(
            cost,
            tuple(scale * s for s in self.segments),
            scale * self.merges,
            tuple((scale * s, why) for s, why in self.rejected),
        )


@dataclass(frozen=True, eq=False)
class Growth:
    """What the growth found, and the stereo points marked on the way."""

    left: ViewGrowth
    right: ViewGrowth
    marks: Float64
    """(k, 2, 2) left and right pixel of each mark, from end to end of the thread."""

    def enlarged(self, scale: int, shape: tuple[int, ...]) -> Growth:
        """The same in the pixels of the whole image, (H, W, ...), that was reduced by `scale`."""
        left, right = (view.enlarged(scale, shape) for view in (self.left, self.right))
        return Growth(left, right, scale * self.marks)


@dataclass(frozen=True, eq=False)
class Initialization:
    """The first curve of a thread."""

    curve: Nurbs
    """Cubic, unit weights; rectified left frame, calibration's unit."""
    confidence: float
    """In [0, 1]; below 0.5 the curve should not be relied on."""
    reasons: tuple[str, ...]
    """What lowers the confidence, and where the thread ends, in words."""
    reprojection_px: float
    """Mean distance of the projected curve from the crest of the ridge, both views, px."""
    growth: Growth
    doubts: PlacedDoubts = ((), ())
    """Those of the left and of the right view that the confidence is lowered by."""
    is_seed_shared: bool = False
    """Whether the seed lies on another strand as well, which may be the one that is meant."""
    is_alone: bool = False
    """Whether both views show hardly any ridge but the thread's."""
    row_offset_px: float = 0.0
    """How much lower, against the left view, than the calibration says the right view lies; the curve
    is half of it off in each. 0 where that cannot be told from none."""

    def turned_round(self) -> Initialization:
        """The same, with the curve run from its other end on."""
        reasons = tuple(re.sub("|".join(ENDS), _other_end, reason) for reason in self.reasons)
        left, right = (tuple((1 - s, rest) for s, rest in view) for view in self.doubts)
        growth = replace(self.growth, marks=self.growth.marks[::-1])
        curve = reversed_curve(self.curve)
        return replace(self, curve=curve, reasons=reasons, growth=growth, doubts=(left, right))

    def meaning(self, *, either: bool) -> Initialization:
        """The same, with a seed that may mean another strand as well, or one that does not."""
        if self.is_seed_shared == either:
            return self
        others = tuple(reason for reason in self.reasons if reason != _EITHER)
        reasons = (_EITHER, *others) if either else others
        confidence = self.confidence * _MEANT if either else self.confidence / _MEANT
        return replace(self, confidence=confidence, reasons=reasons, is_seed_shared=either)


def _other_end(named: re.Match[str]) -> str:
    return ENDS[1 - ENDS.index(named[0])]


def remaining(doubts: PlacedDoubts) -> float:
    """What doubts leave of the confidence: those of the view that has the graver ones count.

    Of one view the gravest counts in full, the others by their square root: what makes one of them
    groundless often does so for the others.
    """
    left, right = ([rest for _, rest in view] for view in doubts)
    return min(math.sqrt(math.prod(rests) * min(rests, default=1.0)) for rests in (left, right))


def in_words(pixels: Float64, rig: StereoRig, scale: int = 1, *, right: bool = False) -> list[str]:
    """(k, 2) rectified pixels of a view, as those of its raw image that people look at."""
    raw = scale * rig.raw_pixels(pixels, right=right)
    return [f"({u:.0f}, {v:.0f})" for u, v in raw]


def nearest_ridges(
    candidates: Float64, rig: StereoRig, scale: int = 1, *, right: bool = False
) -> str:
    """What is said of the ridges near a seed that is on none."""
    if not candidates.size:
        return f"the {'right' if right else 'left'} view shows no ridge at all"
    return f"the nearest ridges are at {', '.join(in_words(candidates, rig, scale, right=right))}"


class InitializationError(Exception):
    """No thread could be found; the message is the reason."""

    def __init__(
        self,
        reason: str,
        candidates: Float64,
        growth: Growth | None = None,
        *,
        swapped: bool = False,
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.candidates = candidates
        """(k, 2) ridge pixels nearest to the seed, rectified left view."""
        self.growth = growth
        self.swapped = swapped
        """Whether the right view shows it where only swapped cameras would."""

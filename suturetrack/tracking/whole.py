"""The whole thread as it was seen of late: what a tool has covered may show again beyond the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from suturetrack.tracking.alignment import shifted
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import length_of, views_at
from suturetrack.types import Nurbs

# A curve that lacks no more than this part is as long as before; for how long a longer one is remembered.
_AS_LONG, _REMEMBERED_NS = 0.96, 3_000_000_000
# How often it is looked for while the curve is shorter.
_PAUSE_NS = 90_000_000
# What is further than this from the curve is missing; how much of that has to be seen, and what response,
# against a clear view, is seen.
_AWAY_PX, _SEEN_PX, _CLEAR = 6.0, 10.0, 0.4
_PLACES = np.linspace(0, 1, 256)


@dataclass(frozen=True, eq=False)
class Whole:
    """The curve when it was last as long as ever.

    An end that a tool moves over seems to be drawn back, and what comes out of hiding beyond the tool no
    search from the end finds: it is where the whole thread was, moved with the rest.
    """

    curve: Nurbs
    length: float
    """When it was longest."""
    seen_ns: int
    looked_ns: int
    is_found: bool = False
    """Whether the last field shows an end of it that the rest lacks."""

    @classmethod
    def of(cls, curve: Nurbs, now_ns: int) -> Whole:
        """A curve that lacks nothing, as far as anybody knows."""
        return cls(curve, length_of(curve), now_ns, now_ns)

    def learned(self, curve: Nurbs, now_ns: int) -> Whole:
        """With a curve that is tracked, unless it is shorter than one of late."""
        if not 0 <= now_ns - self.seen_ns < _REMEMBERED_NS:
            return Whole.of(curve, now_ns)
        length = max(length_of(curve), self.length)
        return (
            replace(self, curve=curve, length=length, seen_ns=now_ns)
            if self.is_met(curve)
            else self
        )

    def is_met(self, curve: Nurbs) -> bool:
        """Whether the curve is about as long."""
        return length_of(curve) >= _AS_LONG * self.length

    def step(self, rest: Nurbs, images: Images) -> Whole:
        """Looked for in the next field, where only a shorter rest is followed by now."""
        now = images.field.stamp.capture_ns
        if self.is_met(rest) or 0 <= now - self.looked_ns < _PAUSE_NS:
            return replace(self, is_found=False)
        curve = shifted(self.curve, images)
        is_found = _shows_missing_end(curve, rest, images)
        return replace(self, curve=curve, looked_ns=now, is_found=is_found)


def _shows_missing_end(whole: Nurbs, rest: Nurbs, images: Images) -> bool:
    """Whether enough is seen of what lies beyond one of the ends of the rest."""
    both, (left, _) = (views_at(images.rig, curve, _PLACES) for curve in (whole, rest))
    distances = cdist(both[0].pixels, left.pixels)
    gaps, nearest = distances.min(axis=1), distances.argmin(axis=1)
    responses = [
        view.responses(image) / level
        for view, image, level in zip(both, images.both, images.levels, strict=True)
    ]
    is_seen = (np.minimum(*responses) > _CLEAR) & (gaps > _AWAY_PX)
    step_px = float(np.mean(both[0].speed)) / (len(_PLACES) - 1)
    beyond = [np.count_nonzero(is_seen & (nearest == end)) for end in (0, len(_PLACES) - 1)]
    return bool(max(beyond) * step_px > _SEEN_PX)

"""Strands in an image that a search must not mistake for one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.tracking.sampling import View
from suturetrack.types import Bool, Float64

SAME_STRAND_PX = 45.0
"""What is nearer than this along a curve is no other strand of it; a tight knot is a point."""


@dataclass(frozen=True, eq=False)
class Strand:
    """Samples of a curve in one image."""

    pixels: Float64
    """(k, 2)"""
    tangents: Float64
    """(k, 2) unit tangents."""
    along: Float64
    """(k,) px travelled along the curve; infinite on other threads."""

    @classmethod
    def of(cls, view: View, share: Float64) -> Strand:
        """A curve's own samples, which stand for `share` of it each."""
        return cls(view.pixels, view.tangents, np.cumsum(view.speed * share))

    @classmethod
    def other(cls, view: View, seen: Bool) -> Strand:
        """The seen samples of another thread."""
        count = int(np.count_nonzero(seen))
        return cls(view.pixels[seen], view.tangents[seen], np.full(count, np.inf))

    def where(self, seen: Bool) -> Strand:
        """The samples that are seen."""
        return Strand(self.pixels[seen], self.tangents[seen], self.along[seen])

    def joined(self, other: Strand) -> Strand:
        """Both, the samples of the other after its own."""
        if not len(other.along):
            return self
        if not len(self.along):
            return other
        return Strand(
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.tangents, other.tangents]),
            np.concatenate([self.along, other.along]),
        )

    @property
    def arrays(self) -> tuple[Float64, Float64, Float64]:
        """What the kernels take."""
        return self.pixels, self.tangents, self.along


Neighbours = tuple[Strand, Strand]
"""Other threads in the left and in the right image."""

_NONE = Strand(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
NOBODY: Neighbours = (_NONE, _NONE)

"""Strands in an image that a search must not mistake for one another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from suturetrack.kernels import search
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View
from suturetrack.types import Bool, Float32, Float64

SAME_STRAND_PX = 45.0
"""What is nearer than this along a curve is no other strand of it; a tight knot is a point."""
# Share of a clear view's response from which another thread draws the middle aside.
_SHOWN = 0.35


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


_NONE = Strand(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another thread."""

    left: Strand
    right: Strand
    confidence: float = math.inf
    """How sure it is that it is one."""
    name: str = ""
    """Where it is tracked; else empty."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Other threads."""

    threads: tuple[Neighbour, ...] = ()

    def as_sure_as(self, confidence: float) -> Neighbours:
        """Those of which it is at least as sure."""
        return Neighbours(tuple(t for t in self.threads if t.confidence >= confidence))

    @property
    def tracked(self) -> dict[str, Neighbours]:
        """Each that is tracked, alone, by name."""
        return {thread.name: Neighbours((thread,)) for thread in self.threads if thread.name}

    @cached_property
    def both(self) -> tuple[Strand, Strand]:
        """All of them, in the left and in the right image."""
        left, right = _NONE, _NONE
        for thread in self.threads:
            left, right = left.joined(thread.left), right.joined(thread.right)
        return left, right

    def shown_in(self, images: Images) -> Neighbours:
        """Those that are seen in images, which may be made for one thread."""
        both, levels = images.both, images.levels
        shown = (t for t in self.threads if any(map(_is_shown, (t.left, t.right), both, levels)))
        return Neighbours(tuple(shown))


def _is_shown(strand: Strand, image: Float32, level: float) -> bool:
    responses = search.responses(image, strand.pixels, strand.tangents)
    return len(responses) > 0 and float(np.median(responses)) > _SHOWN * level


NOBODY = Neighbours()

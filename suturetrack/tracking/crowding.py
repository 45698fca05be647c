"""Where another ridge runs so close beside the thread that it draws its middle aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.kernels import search
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View
from suturetrack.tracking.strands import SAME_STRAND_PX, Neighbours, Strand
from suturetrack.types import Bool, Float32, Float64

# The filter blurs ridges that are nearer than this into one another.
_NEAR_PX = 4.0
# Places beside the curve where summits are counted; at both ends they can be none.
_GRID_PX = np.arange(-6.0, 6.1)
_CLEAR = 0.4
_SHORTEST_PX, _GAP_PX = 4.0, 48.0


@dataclass(frozen=True, eq=False)
class Crowd:
    """Samples beside which another ridge runs, in either image."""

    others: Bool
    """(k,) beside another thread or an unknown ridge, or at an end beside the thread itself: whose the
    ridge is, is doubtful."""
    itself: Bool
    """(k,) beside another strand of the thread: it is one ridge with it, and its middle is that of both."""


def crowded(
    both: tuple[View, View], share: Float64, images: Images, neighbours: Neighbours
) -> Crowd:
    """Looks beside the samples of a curve.

    Args:
        both: the samples as predicted, left and right.
        share: (k,) part of the curve that each stands for.
        neighbours: other threads.
    """
    flags, itself = np.zeros(len(share), bool), np.zeros(len(share), bool)
    for image, view, level, others in zip(
        images.both, both, images.levels, neighbours.both, strict=True
    ):
        own = Strand.of(view, share)
        touching = search.doubled(own.arrays, own.arrays, SAME_STRAND_PX, _NEAR_PX)
        flags |= _beside(image, view, own, view.speed * share, level, others)
        flags |= _from_the_ends(touching)
        itself |= touching
    return Crowd(_closed(flags, both[0].speed * share), itself)


def covered(both: tuple[View, View], neighbours: Neighbours) -> Bool:
    """(k,) samples on which another thread lies, or which lie on it, in either image."""
    here: Float64 = np.zeros(1)
    left, right = (
        search.covered(view.pixels, view.tangents, here, others.pixels, _NEAR_PX)[:, 0]
        for view, others in zip(both, neighbours.both, strict=True)
    )
    return left | right


def _beside(
    image: Float32, view: View, own: Strand, lengths: Float64, level: float, others: Strand
) -> Bool:
    """(k,) samples, of so many px each, beside which another thread or an unknown ridge runs."""
    known = search.doubled(own.arrays, others.arrays, SAME_STRAND_PX, _NEAR_PX)
    itself = search.doubled(own.arrays, own.arrays, SAME_STRAND_PX, _GRID_PX[-1])
    profiles = view.profiles(image, _GRID_PX)
    inner = profiles[:, 1:-1]
    summits = (inner > profiles[:, :-2]) & (inner >= profiles[:, 2:]) & (inner > _CLEAR * level)
    several = search.solid((summits.sum(axis=1) > 1) & ~itself, lengths, _SHORTEST_PX)
    return known | several


def _from_the_ends(flags: Bool) -> Bool:
    """The flags that are set from either end on."""
    return np.logical_and.accumulate(flags) | np.logical_and.accumulate(flags[::-1])[::-1]


def _closed(flags: Bool, lengths: Float64) -> Bool:
    """The flags with short gaps closed: ridges that cross or touch are one in between."""
    closed, places = flags.copy(), np.flatnonzero(flags)
    if len(places):
        within = slice(places[0], places[-1] + 1)
        closed[within] = ~search.solid(~flags[within], lengths[within], _GAP_PX)
    return closed

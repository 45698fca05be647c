"""Where another ridge runs so close beside the thread that it draws its middle aside."""

from __future__ import annotations

import numpy as np

from suturetrack.kernels import search
from suturetrack.tracking.sampling import View
from suturetrack.tracking.strands import SAME_STRAND_PX, Neighbours, Strand
from suturetrack.types import Bool, Float32, Float64, RidgeField

# The filter blurs ridges that are nearer than this into one another.
_NEAR_PX = 4.0
# Places beside the curve where summits are counted; at both ends they can be none.
_GRID_PX = np.arange(-6.0, 6.1)
_CLEAR = 0.4
_SHORTEST_PX, _GAP_PX = 4.0, 48.0


def crowded(
    both: tuple[View, View],
    share: Float64,
    field: RidgeField,
    levels: tuple[float, float],
    neighbours: Neighbours,
) -> Bool:
    """(k,) samples beside which another thread or an unknown ridge runs, in either image.

    The thread's own strands do not count, for in a knot they are all there is to go by; but those do
    that run beside its ends.

    Args:
        both: the samples as predicted, left and right.
        share: (k,) part of the curve that each stands for.
        levels: response of a clear view of the thread, left and right.
        neighbours: other threads.
    """
    images = field.left, field.right
    flags = np.zeros(len(share), bool)
    for image, view, level, others in zip(images, both, levels, neighbours.both, strict=True):
        flags |= _beside(image, view, share, level, others)
    return _closed(flags, both[0].speed * share)


def covered(both: tuple[View, View], neighbours: Neighbours) -> Bool:
    """(k,) samples on which another thread lies, or which lie on it, in either image."""
    here: Float64 = np.zeros(1)
    left, right = (
        search.covered(view.pixels, view.tangents, here, others.pixels, _NEAR_PX)[:, 0]
        for view, others in zip(both, neighbours.both, strict=True)
    )
    return left | right


def _beside(image: Float32, view: View, share: Float64, level: float, others: Strand) -> Bool:
    own, lengths = Strand.of(view, share), view.speed * share
    known = search.doubled(own.arrays, others.arrays, SAME_STRAND_PX, _NEAR_PX)
    itself = search.doubled(own.arrays, own.arrays, SAME_STRAND_PX, _GRID_PX[-1])
    touching = search.doubled(own.arrays, own.arrays, SAME_STRAND_PX, _NEAR_PX)
    profiles = search.normal_profiles(image, view.pixels, view.tangents, _GRID_PX, 0.0)
    inner = profiles[:, 1:-1]
    summits = (inner > profiles[:, :-2]) & (inner >= profiles[:, 2:]) & (inner > _CLEAR * level)
    several = search.solid((summits.sum(axis=1) > 1) & ~itself, lengths, _SHORTEST_PX)
    return known | several | _from_the_ends(touching)


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

"""Which view shows the thread better: each proposes its own, and the other is searched for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.initialization.confidence import AGREED, NEAR_PX, clarity
from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.matching import Match, match
from suturetrack.initialization.meetings import untangled
from suturetrack.initialization.segments import Ridges, nearest_segment
from suturetrack.initialization.threads import Chain, Thread, follow_thread, without_other_tails
from suturetrack.polylines import coverage, nearest_index, polyline_distances
from suturetrack.types import Float64, RidgeField

_UNMATCHED = 0.35
"""Response, against that of a thread, below which the other view does not show it."""
_UNMATCHED_PRICE = 12.0
"""What the share that the other view does not show takes from the worth of a hypothesis."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A thread in both views."""

    left: Thread
    right: Thread | None
    """None where the right view shows no ridge."""
    matched: Match
    """The right pixels of `pixels`' left ones, or the left ones where `by_right`."""
    by_right: bool = False
    """Whether the chain is the right view's, matched in the left one."""

    @property
    def pixels(self) -> Float64:
        """(k, 4) left and right pixels, about 1 px apart in the view that shows the thread better; of a
        right chain only what the left view shows, too."""
        if self.by_right and self.right is not None:
            inside = np.flatnonzero(self.matched.inside)
            both = slice(inside[0], inside[-1] + 1)
            return np.c_[self.matched.pixels[both], self.right.chain.pixels[both]]
        return np.c_[self.left.chain.pixels, self.matched.pixels]

    @property
    def chains(self) -> tuple[Chain, Chain]:
        """The thread as each view by itself has it."""
        nothing = Chain(np.empty((0, 2)))
        return self.left.chain, nothing if self.right is None else self.right.chain

    @property
    def others(self) -> tuple[list[Float64], list[Float64]]:
        """The ridges of other strands in both views, (m, 2) pixels each."""
        pixels = self.pixels
        right = [] if self.right is None else self.right.others_along(pixels[:, 2:])
        return self.left.others_along(pixels[:, :2]), right


def find_thread(
    field: RidgeField,
    ridges: tuple[Ridges, Ridges],
    left: Thread,
    seed: Float64,
    at_infinity: float,
    config: InitializationConfig,
) -> Hypothesis:
    """A thread of the left view as the view shows it that shows it better.

    Args:
        field: both views.
        ridges: of the left and the right view.
        left: the thread as the left view by itself has it, whatever its depth.
        seed: (2,) left pixel on it.
        at_infinity: disparity of points at infinity, px.
        config: settings.
    """
    matched = match(left.chain.pixels, field.left, field.right, at_infinity, 1)
    apart = (left.chain.pixels - matched.pixels)[matched.inside, 0]
    there = matched.pixels[nearest_index(left.chain.pixels, seed)]
    partner, _ = nearest_segment(ridges[1], there, np.inf)
    right: Thread | None = None
    if not len(apart):
        right = None if partner is None else follow_thread(ridges[1], partner, config)
    else:
        depths = (
            Depth.around(apart, field.left, field.right),
            Depth.around(-apart, field.right, field.left),
        )
        left = follow_thread(ridges[0], left.origin, config, depths[0])
        if partner is not None:
            right = follow_thread(ridges[1], partner, config, depths[1])
            left, right = untangled((left, right), ridges, depths, (seed, there))
        left = without_other_tails(left, seed)
        matched = match(left.chain.pixels, field.left, field.right, at_infinity, 1)
    if right is None:
        return Hypothesis(left, None, matched)
    right = without_other_tails(right, there)
    first = Hypothesis(left, right, matched)
    if _agreement(matched.pixels[matched.inside], right.chain.pixels) >= AGREED:
        return first
    mirrored = match(right.chain.pixels, field.right, field.left, -at_infinity, -1)
    through_seed = np.linalg.norm(mirrored.pixels - seed, axis=1).min() <= config.snap_px
    if left.is_all_there_is != right.is_all_there_is:
        # To leave strands to nobody is worse than any doubt.
        is_better = right.is_all_there_is
    else:
        is_better = _worth(right, mirrored, matched) > _worth(left, matched, mirrored)
    return Hypothesis(left, right, mirrored, by_right=True) if through_seed and is_better else first


def _agreement(one: Float64, other: Float64) -> float:
    """The lesser share of two chains, (k, 2) and (m, 2), that runs along the other."""
    if len(one) < 2 or len(other) < 2:
        return 0.0
    return min(coverage(one, other, NEAR_PX), coverage(other, one, NEAR_PX))


def _worth(thread: Thread, matched: Match, other: Match) -> float:
    """How much speaks for the thread of one view where that of the other view runs another way.

    Args:
        thread: of one view.
        matched: its counterpart in the other view.
        other: the other view's thread, matched in the view of `thread`.
    """
    unmatched = float(((matched.response < _UNMATCHED) & matched.inside).mean())
    pixels = thread.chain.pixels
    partings = np.r_[_partings(pixels, other.pixels), _partings(other.pixels, pixels)]
    worth = np.count_nonzero(matched.inside) * clarity(thread.chain, partings)
    return float(worth * np.exp(-_UNMATCHED_PRICE * unmatched))


def _partings(one: Float64, other: Float64) -> Float64:
    """(k, 2) where the chain `one` leaves the other, or comes back to it."""
    apart = polyline_distances(one, other) > NEAR_PX
    return one[:-1][apart[1:] != apart[:-1]]

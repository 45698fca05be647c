"""Whether two arms that meet at a crossing are one strand: as it bends, and as depth and colour change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from suturetrack.initialization.colours import Tints, difference
from suturetrack.initialization.depth import Depth, Disparities
from suturetrack.initialization.joints import Pair, inward
from suturetrack.initialization.pricing import Merges
from suturetrack.initialization.smoothness import ROUGHEST, bend, step
from suturetrack.types import Float64

REACH = 60
"""Points of an arm at most; two strands may share a segment that is shorter."""
_LEAST_ARM = 10
_LONGEST_GAP_PX = 3.0
_LIKELY = 1.3
"""Price of a merge up to which it is a rival of others."""
_RIVAL, _CLOSE_RIVAL = 0.5, 0.25
"""How much dearer a rival may be that counts, and one with which a segment may be shared."""
ENERGY = 0.03
"""Price of a unit of the energy by which arms fit together less well."""
_MOST_BENT, _MOST_RECOLOURED = 25.0, 8.0
"""Energy of a step at most: where two strands are on top of each other, both have the colour of one."""
_LEAST_HIDDEN_ARM = 20
_HIDDEN_PX = 30.0
"""Length of a hidden stretch that is worth a unit of energy."""
_SKIPPED, _SHAPE_POINTS, _EVERY = 4, 40, 2


class Arms:
    """The arms of one view's segments, from each end inwards."""

    def __init__(
        self,
        segments: Sequence[Float64],
        partner: dict[int, int],
        merges: Merges,
        depth: Depth | None,
        tints: Tints | None,
        roughness: float = ROUGHEST,
    ) -> None:
        self._segments, self._partner, self._depth = segments, partner, depth
        self._tints, self._roughness = tints, roughness
        self._leads = _leads(merges, partner)
        self._arms: dict[int, Float64] = {}
        self._bends: dict[Pair, float] = {}
        self._disparities: dict[int, Disparities | None] = {}
        self._colours: dict[int, Float64] = {}

    def with_steps(self, merges: Merges) -> Merges:
        """The merges, those dearer whose arms differ in depth or in colour."""
        cost = merges.cost.copy()
        for k in np.flatnonzero(cost < _LIKELY):
            i, j = merges.pairs[k].tolist()
            if min(self._lead(i), self._lead(j)) < _RIVAL:
                cost[k] += ENERGY * (self._step(i, j) + self._change_of_colour(i, j))
        return replace(merges, cost=cost)

    def change(self, pairs: list[Pair], others: list[Pair]) -> float | None:
        """What it would cost if the arms of some ends were joined as `others`, and not as `pairs`;
        None where an arm is too short to tell."""
        if min(len(self._arm(end)) for pair in pairs for end in pair) < _LEAST_ARM:
            return None
        return sum(self._misfit(*p) for p in others) - sum(self._misfit(*p) for p in pairs)

    def bend(self, i: int, j: int) -> float:
        """Energy of the bend between the arms of two ends; 0 where one is too short to tell."""
        if i // 2 == j // 2 or min(len(self._arm(i)), len(self._arm(j))) < _LEAST_ARM:
            return 0.0
        return self._bend(i, j)

    def goes_on(self, i: int, j: int) -> float:
        """Energy by which the arms of two ends are less well one strand, hidden between them, than two:
        the more, the longer it would be hidden; infinite where one is too short to tell."""
        one, other = self._arm(i), self._arm(j)
        if i // 2 == j // 2 or min(len(one), len(other)) < _LEAST_HIDDEN_ARM:
            return np.inf
        length = float(np.linalg.norm(other[0] - one[0]))
        return self._bend(i, j) + self._step(i, j) + (length / _HIDDEN_PX) ** 2

    def _misfit(self, i: int, j: int) -> float:
        energy = self._bend(i, j) + self._step(i, j) + self._change_of_colour(i, j)
        return ENERGY * energy

    def _bend(self, i: int, j: int) -> float:
        """How much more the arms of two ends have to bend as one strand than as two."""
        pair = min(i, j), max(i, j)
        if pair not in self._bends:
            one, other = (
                arm[min(_SKIPPED, len(arm) // 4) : _SHAPE_POINTS : _EVERY]
                for arm in map(self._arm, pair)
            )
            self._bends[pair] = bend(one, other, self._roughness)
        return self._bends[pair]

    def _step(self, i: int, j: int) -> float:
        """Energy of a step in depth from one arm to the other."""
        if self._depth is None:
            return 0.0
        for end in (i, j):
            if end not in self._disparities:
                self._disparities[end] = self._depth.along(self._arm(end))
        one, other = self._disparities[i], self._disparities[j]
        return 0.0 if one is None or other is None else min(step(one, other), _MOST_BENT)

    def _change_of_colour(self, i: int, j: int) -> float:
        """Energy of a step in colour from one arm to the other."""
        if self._tints is None:
            return 0.0
        for end in (i, j):
            if end not in self._colours:
                self._colours[end] = self._tints.along(self._arm(end)[_SKIPPED:])
        return min(difference(self._colours[i], self._colours[j]), _MOST_RECOLOURED)

    def _lead(self, end: int) -> float:
        return self._leads.get(end, np.inf)

    def _arm(self, end: int) -> Float64:
        if end not in self._arms:
            self._arms[end] = self._walk(end)
        return self._arms[end]

    def _walk(self, end: int) -> Float64:
        """(k, 2) inwards, through segments that are joined without a gap, up to one that two strands
        may share."""
        points: list[Float64] = [np.empty((0, 2))]
        total, seen = 0, set()
        while total < REACH and end // 2 not in seen:
            seen.add(end // 2)
            piece = inward(self._segments, end)
            shared = max(self._lead(end), self._lead(end ^ 1)) < _CLOSE_RIVAL
            if len(piece) < REACH and shared:
                break
            if total and np.linalg.norm(piece[0] - points[-1][-1]) > _LONGEST_GAP_PX:
                break
            points.append(piece)
            total += len(piece)
            if end ^ 1 not in self._partner:
                break
            end = self._partner[end ^ 1]
        return np.concatenate(points)[:REACH]


def _leads(merges: Merges, partner: dict[int, int]) -> dict[int, float]:
    """How much dearer the second best merge of an end is than its best; one that leaves out a segment of the
    same strand, which no other strand might take, is no other."""
    likely = merges.cost < _LIKELY
    pairs, costs = merges.pairs[likely].tolist(), merges.cost[likely].tolist()
    between = [_between(i, j, partner) for i, j in pairs]
    rivals = Counter(
        e for pair, left_out in zip(pairs, between, strict=True) if not left_out for e in pair
    )
    found: dict[int, list[float]] = {}
    for pair, left_out, cost in zip(pairs, between, costs, strict=True):
        if not left_out or any(rivals[end] > 1 for end in left_out):
            for end in pair:
                found.setdefault(end, []).append(cost)
    return {e: sorted(c)[1] - min(c) for e, c in found.items() if len(c) > 1}


def _between(i: int, j: int, partner: dict[int, int]) -> list[int]:
    """The ends of the one segment that joins two ends; none if none does."""
    if i not in partner or partner.get(partner[i] ^ 1) != j:
        return []
    return [partner[i], partner[i] ^ 1]

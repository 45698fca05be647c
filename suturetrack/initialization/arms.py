"""Whether two arms that meet at a crossing are one strand: as it bends, and as depth and colour change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky

from suturetrack.initialization.colours import Tints, difference
from suturetrack.initialization.depth import Depth, Disparities
from suturetrack.initialization.joints import Pair, inward
from suturetrack.initialization.pricing import Merges
from suturetrack.polylines import arc_lengths
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
_DISPARITY_BEND = 1e-4
_SHAPE_BEND = 3e-5
"""Spectral density of the change of slope in disparity, and of curvature in an image, 1/px."""
_SHAPE_NOISE_PX = 0.25
_SKIPPED, _SHAPE_POINTS, _EVERY = 4, 40, 2
_ANYWHERE_PX = 100.0
_ANY_CURVATURE = 0.05


class Arms:
    """The arms of one view's segments, from each end inwards."""

    def __init__(
        self,
        segments: Sequence[Float64],
        partner: dict[int, int],
        merges: Merges | None,
        depth: Depth | None,
        tints: Tints | None,
    ) -> None:
        self._segments, self._partner, self._depth = segments, partner, depth
        self._tints = tints
        self._leads = {} if merges is None else _leads(merges)
        self._arms: dict[int, Float64] = {}
        self._disparities: dict[int, Disparities | None] = {}
        self._colours: dict[int, Float64] = {}

    @cached_property
    def pieces(self) -> Arms:
        """The arms as far as the segments go by themselves, whoever may share them."""
        return Arms(self._segments, {}, None, self._depth, self._tints)

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
        return _bend(self._arm(i), self._arm(j))

    def goes_on(self, i: int, j: int) -> float:
        """Energy by which the arms of two ends are less well one strand, hidden between them, than two:
        the more, the longer it would be hidden; infinite where one is too short to tell."""
        one, other = self._arm(i), self._arm(j)
        if i // 2 == j // 2 or min(len(one), len(other)) < _LEAST_HIDDEN_ARM:
            return np.inf
        length = float(np.linalg.norm(other[0] - one[0]))
        return _bend(one, other) + self._step(i, j) + (length / _HIDDEN_PX) ** 2

    def _misfit(self, i: int, j: int) -> float:
        bend = _bend(self._arm(i), self._arm(j))
        return ENERGY * (bend + self._step(i, j) + self._change_of_colour(i, j))

    def _step(self, i: int, j: int) -> float:
        """Energy of a step in depth from one arm to the other."""
        if self._depth is None:
            return 0.0
        for end in (i, j):
            if end not in self._disparities:
                self._disparities[end] = self._depth.along(self._arm(end))
        one, other = self._disparities[i], self._disparities[j]
        return 0.0 if one is None or other is None else min(_step(one, other), _MOST_BENT)

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


def _leads(merges: Merges) -> dict[int, float]:
    """How much dearer the second best merge of an end is than its best."""
    costs: dict[int, list[float]] = {}
    for pair, cost in zip(merges.pairs.tolist(), merges.cost.tolist(), strict=True):
        if cost < _LIKELY:
            for end in pair:
                costs.setdefault(end, []).append(cost)
    return {e: sorted(c)[1] - min(c) for e, c in costs.items() if len(c) > 1}


def _bend(one: Float64, other: Float64) -> float:
    """How much more two arms (k, 2) and (m, 2) have to bend as one strand than as two."""
    one, other = (
        a[min(_SKIPPED, len(a) // 4) : _SHAPE_POINTS : _EVERY] for a in (one[:REACH], other[:REACH])
    )
    t = arc_lengths(np.r_[one[::-1], other])
    variances = [np.full(len(a), _SHAPE_NOISE_PX**2) for a in (one[::-1], other)]
    return _excess(t, (one[::-1], other), variances, _curving)


def _step(one: Disparities, other: Disparities) -> float:
    """How much more the disparity of two arms has to change as one strand than as two."""
    t = arc_lengths(np.r_[one.pixels[::-1], other.pixels])
    values = one.value[::-1, None], other.value[:, None]
    variances = [one.variance[::-1], other.variance]
    return max(_excess(t, values, variances, _sloping), 0.0)


def _excess(
    t: Float64,
    values: tuple[Float64, Float64],
    variances: list[Float64],
    prior: Callable[[Float64], Float64],
) -> float:
    """Energy of (k, d) and (m, d) values at the places t as one strand, less that as two."""
    n = len(values[0])
    one = _energy(t, np.concatenate(values), np.concatenate(variances), prior)
    return (
        one
        - _energy(t[:n], values[0], variances[0], prior)
        - _energy(t[n:], values[1], variances[1], prior)
    )


def _energy(
    t: Float64, values: Float64, variance: Float64, prior: Callable[[Float64], Float64]
) -> float:
    """Minus the exponent of the Gaussian process `prior` at noisy values (k, d)."""
    covariance = prior(t - t[0])
    covariance[np.diag_indices(len(t))] += variance
    values = values - values.mean(0)
    factor = cholesky(covariance, lower=True)
    return 0.5 * float((values * cho_solve((factor, True), values)).sum())


def _sloping(t: Float64) -> Float64:
    """(k, k) covariance of a line whose slope drifts."""
    least, gap, centred = np.minimum.outer(t, t), abs(np.subtract.outer(t, t)), t - t.mean()
    drift = least**3 / 3 + gap * least**2 / 2
    return _DISPARITY_BEND * drift + _ANYWHERE_PX**2 + np.outer(centred, centred)


def _curving(t: Float64) -> Float64:
    """(k, k) covariance of a curve whose curvature drifts."""
    least, gap, centred = np.minimum.outer(t, t), abs(np.subtract.outer(t, t)), t - t.mean()
    drift = least**5 / 20 + gap * least**4 / 8 + gap**2 * least**3 / 12
    bent = _ANY_CURVATURE**2 * np.outer(centred**2, centred**2)
    return _SHAPE_BEND * drift + _ANYWHERE_PX**2 + np.outer(centred, centred) + bent

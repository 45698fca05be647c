"""Merging segments into threads by the distance and the angle of their ends (Fig. 3b)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.depth import Depth
from suturetrack.initialization.hairpins import double_stubs
from suturetrack.initialization.model import InitializationConfig
from suturetrack.initialization.paths import is_ring, other_end, ring_from
from suturetrack.initialization.pricing import FREE_END, Merge, price_merges
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.initialization.strands import REACH, Strands
from suturetrack.types import Float64, Int64

_LONGEST_RUN = 4
"""Segments that two strands may share in a row."""
_CLEARLY = 0.03
"""By how much less two strands have to cost in all if their far parts are swapped."""
_BENT = 8.0
"""Energy by which two arms fit together less well as one strand than as two."""
_LONGEST_HIDDEN_PX = 60.0
_ONE_STRAND = 2.5
"""Energy up to which two arms with a hidden stretch in between are one strand."""
_AS_STRONG = 0.5
"""Ratio of their strengths, at least."""
_FACING = 0.5
"""Cosine of the angle by which an end may miss another one that it points at."""


@dataclass(frozen=True, eq=False)
class Merged:
    """Which ends were joined, and what that cost."""

    segments: tuple[Float64, ...]
    """Those of the ridges, and once more those that two strands share."""
    partner: dict[int, int]
    """The end that each joined end was joined to."""
    price: dict[tuple[int, int], float]
    """Of every pair of ends within reach."""
    bent: frozenset[int]
    """The joined ends whose strands bend there as two would, and not one."""
    hidden: frozenset[int] = frozenset()
    """The joined ends of strands that something hides in between."""
    lead: Mapping[int, float] = field(default_factory=dict)
    """Of ends at which two strands part that touched: by how much the ways that they take cost less than
    exchanged, by their arms."""

    def is_copy(self, one: int, other: int) -> bool:
        """Whether two ends are the same one of a segment that strands share."""
        return one % 2 == other % 2 and self.segments[one // 2] is self.segments[other // 2]


def merge_ends(ridges: Ridges, config: InitializationConfig, depth: Depth | None = None) -> Merged:
    """Pairs up the ends so that all merges and free ends together cost least (almost: by exchange).

    With `depth`, ends whose arms differ in depth are dearer to join.
    """
    if not ridges.segments:
        return Merged((), {}, {}, frozenset())
    merges = price_merges(ridges, config)
    first = _merge(ridges, merges, None)
    strands = Strands(first.segments, first.partner, merges, depth)
    return _merge(ridges, strands.with_depth(merges), strands)


def _merge(ridges: Ridges, merges: Merge, strands: Strands | None) -> Merged:
    price = {
        (int(i), int(j)): float(c) for (i, j), c in zip(merges.pairs, merges.cost, strict=True)
    }
    price |= {(j, i): c for (i, j), c in price.items()}
    partner: dict[int, int] = {}
    order = np.argsort(merges.cost)
    _pair(partner, merges.pairs[order[merges.cost[order] < 1]])
    _exchange(partner, price)
    if strands is not None:
        _uncross(ridges.segments, partner, price, strands)
    lead: dict[int, float] = {}
    segments = _share(ridges.segments, partner, price, strands, lead)
    _open_rings(partner, price)
    segments = double_stubs(segments, partner, price)
    _pair(partner, merges.pairs[order[merges.touching[order]]])
    bent = _bent(ridges.segments, segments, partner, strands)
    hidden = _bridge_hidden(ridges, partner, price, strands)
    lead |= _leads_beside(ridges.segments, segments, partner, price, strands)
    return Merged(segments, partner, price, bent, hidden, lead)


def _bent(
    originals: tuple[Float64, ...],
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    strands: Strands | None,
) -> frozenset[int]:
    if strands is None:
        return frozenset()
    ends = {end: _original(end, originals, segments) for end in partner}
    return frozenset(i for i, j in partner.items() if strands.bend(ends[i], ends[j]) > _BENT)


def _original(end: int, originals: Sequence[Float64], segments: Sequence[Float64]) -> int:
    """The end that `end`, of `segments`, is or is a copy of: strands know of no copies but their own."""
    if end // 2 < len(originals):
        return end
    copied = segments[end // 2]
    return 2 * next(k for k, segment in enumerate(originals) if segment is copied) + end % 2


def _bridge_hidden(
    ridges: Ridges,
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands | None,
) -> frozenset[int]:
    """Joins free ends of one strand that something, such as a tool, hides in between; returns them."""
    free = [end for end in range(2 * len(ridges.segments)) if end not in partner]
    if strands is None or len(free) < 2:
        return frozenset()
    ways = [(strands.goes_on(i, j), i, j) for i, j in _facing(free, ridges)]
    hidden: set[int] = set()
    for energy, i, j in sorted(ways):
        if energy > _ONE_STRAND:
            break
        if i not in partner and j not in partner and other_end(i, partner) != j:
            for one, other in ((i, j), (j, i)):
                partner[one] = other
                price.setdefault((one, other), FREE_END)
            hidden |= {i, j}
    return frozenset(hidden)


def _facing(ends: list[int], ridges: Ridges) -> list[tuple[int, int]]:
    """Pairs of ends, near each other, of segments of like strength that point at each other."""
    arms = [ridges.segments[end // 2][:: -1 if end % 2 else 1][: ARM + 1] for end in ends]
    places = np.array([arm[0] for arm in arms])
    heading = places - [arm[-1] for arm in arms]
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-9)
    strength = np.array([np.median(ridges.sample(ridges.segments[end // 2])) for end in ends])
    a, b = cKDTree(places).query_pairs(_LONGEST_HIDDEN_PX, output_type="ndarray").T
    way = places[b] - places[a]
    facing = np.minimum((heading[a] * way).sum(1), -(heading[b] * way).sum(1))
    is_pair = facing > _FACING * np.linalg.norm(way, axis=1)
    is_pair &= np.minimum(strength[a], strength[b]) > _AS_STRONG * np.maximum(
        strength[a], strength[b]
    )
    return [(ends[i], ends[j]) for i, j in zip(a[is_pair], b[is_pair], strict=True)]


def _uncross(
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands,
) -> None:
    """Where one strand leads through a short segment and another beside it, swaps their far parts if
    these fit better so: short segments say little about direction."""
    within = within_reach(price)
    for k, segment in enumerate(segments):
        start, stop = 2 * k, 2 * k + 1
        if len(segment) >= REACH or start not in partner or stop not in partner:
            continue
        a, b = partner[start], partner[stop]
        for c in within.get(start, ()):
            d = partner.get(c, -1)
            if c in (a, b) or d in (a, b, start, stop) or d not in within.get(stop, ()):
                continue
            change = strands.change([(a, b), (c, d)], [(a, d), (c, b)])
            if change is None:
                continue
            ways = [
                (price[stop, d] + price.get((c, b), 2.0) - price[stop, b], (stop, d), (c, b)),
                (price[start, c] + price.get((a, d), 2.0) - price[start, a], (start, c), (a, d)),
            ]
            added, *pairs = min(ways)
            if added - price[c, d] + change < -_CLEARLY:
                for i, j in pairs:
                    partner[i], partner[j] = j, i
                    price.setdefault((i, j), FREE_END)
                    price.setdefault((j, i), FREE_END)
                break


def _share(
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands | None,
    lead: dict[int, float],
) -> tuple[Float64, ...]:
    """Doubles the runs of segments that a second strand waits for at both ends; tells the `lead`."""
    waiting: dict[int, tuple[float, int]] = {}
    for (i, j), cost in price.items():
        if i in partner and j not in partner and cost < 2 * FREE_END:
            waiting[i] = min(waiting.get(i, (np.inf, -1)), (cost, j))
    found = [(waiting[run[0]][0] + waiting[run[-1] ^ 1][0], run) for run in _runs(waiting, partner)]
    copies = list(segments)
    taken: set[int] = set()
    for _, run in sorted(found):
        one, other = waiting[run[0]][1], waiting[run[-1] ^ 1][1]
        if one == other or one in partner or other in partner:
            continue
        if any(e // 2 in taken for e in run):
            continue
        taken.update(e // 2 for e in run)
        last = partner[run[-1] ^ 1]
        better_by = _double(run, one, other, segments, copies, partner, price, strands)
        if better_by is not None:
            lead[last] = lead[other] = better_by
    return tuple(copies)


def _runs(waiting: dict[int, tuple[float, int]], partner: dict[int, int]) -> list[list[int]]:
    """Ends at which joined segments are entered, from one end where a strand waits to another."""
    runs = []
    for start in waiting:
        run = [start]
        while True:
            leave = run[-1] ^ 1
            if leave in waiting and start < leave:
                runs.append(run.copy())
            if leave not in partner or len(run) == _LONGEST_RUN or partner[leave] in run:
                break
            run.append(partner[leave])
    return runs


def _double(
    run: list[int],
    one: int,
    other: int,
    originals: tuple[Float64, ...],
    copies: list[Float64],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands | None,
) -> float | None:
    """Leads a second strand, which waits with the ends `one` and `other`, through a run; by how much
    that costs less than the other way, as far as the strands tell."""
    start, stop = run[0], run[-1] ^ 1
    first, last = partner[start], partner[stop]
    # Of the two ways to connect the strands none may close a loop; else the smoother one is taken.
    ring = other_end(one, partner) == other or is_ring(start, partner)
    told = None
    if ring or other == other_end(first, partner) or one == other_end(last, partner):
        swap = ring
    else:
        straight, crossed = [(one, other), (first, last)], [(one, last), (first, other)]
        change = told = _change(straight, crossed, originals, copies, strands)
        if change is None:
            change = sum(price.get(p, 2.0) for p in crossed)
            change -= sum(price.get(p, 2.0) for p in straight)
        swap = change < 0
    copied = {}
    for entry in run:
        for end in (entry, entry ^ 1):
            copied[end] = 2 * len(copies) + (end & 1)
        copies.append(copies[entry // 2])
    price |= {(copied[e], j): c for (e, j), c in price.items() if e in copied}
    price |= {(j, copied[e]): c for (j, e), c in price.items() if e in copied}
    pairs = [(copied[a ^ 1], copied[b]) for a, b in pairwise(run)]
    pairs += [(one, copied[start])]
    pairs += [(copied[stop], last), (stop, other)] if swap else [(copied[stop], other)]
    for i, j in pairs:
        partner[i], partner[j] = j, i
    return None if told is None else abs(told)


def _change(
    taken: list[tuple[int, int]],
    exchanged: list[tuple[int, int]],
    originals: Sequence[Float64],
    segments: Sequence[Float64],
    strands: Strands | None,
) -> float | None:
    """How much dearer the ends of two strands are joined as `exchanged`; None where it is not told."""
    if strands is None:
        return None
    ways = (
        [(_original(i, originals, segments), _original(j, originals, segments)) for i, j in way]
        for way in (taken, exchanged)
    )
    return strands.change(*ways)


def _leads_beside(
    originals: tuple[Float64, ...],
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands | None,
) -> dict[int, float]:
    """The leads of strands that pass beside a short segment of another strand, which they touch."""
    within, lead = within_reach(price), dict[int, float]()
    pieces = None if strands is None else strands.pieces
    for a, b in partner.items():
        for near in within.get(a, ()):
            far = near ^ 1
            if far not in within.get(b, ()) or len(segments[near // 2]) >= REACH:
                continue
            c, d = partner.get(near, b), partner.get(far, a)
            if len({a, b, c, d} - {near, far}) < 4:
                continue
            change = _change([(a, b), (c, d)], [(a, d), (c, b)], originals, segments, pieces)
            if change is not None:
                lead[a] = lead[b] = min(change, lead.get(a, np.inf))
    return lead


def _open_rings(partner: dict[int, int], price: dict[tuple[int, int], float]) -> None:
    """Leads a strand that crosses a ring of segments through it: a thread has two ends."""
    for start in list(partner):
        if not is_ring(start, partner):
            continue
        ring = ring_from(start, partner)
        ways = [
            (price[i, a] + price.get((j, b), 2.0) - price[i, j] - price[a, b], i, j, a, b)
            for i, j in ((e, partner[e]) for e in ring)
            for a, b in partner.items()
            if a not in ring and (i, a) in price
        ]
        added, i, j, a, b = min(ways, default=(np.inf, 0, 0, 0, 0))
        if added < 2 * FREE_END:
            for one, other in ((i, a), (j, b)):
                partner[one], partner[other] = other, one
                price.setdefault((one, other), 2 * FREE_END)
                price.setdefault((other, one), 2 * FREE_END)


def _pair(partner: dict[int, int], pairs: Int64) -> None:
    for i, j in pairs.tolist():
        if i not in partner and j not in partner:
            partner[i], partner[j] = j, i


def _exchange(partner: dict[int, int], price: dict[tuple[int, int], float]) -> None:
    """Swaps partners as long as that lowers the total."""
    within = within_reach(price)
    improved = True
    while improved:
        improved = False
        for i, j in list(price):
            if partner.get(i) == j or price[i, j] >= 2 * FREE_END:
                continue
            added, left, pairs = swap(i, j, partner, price, within)
            if added < -1e-9:
                for end in left:
                    del partner[end]
                for one, other in pairs:
                    partner[one], partner[other] = other, one
                improved = True


def within_reach(price: dict[tuple[int, int], float]) -> dict[int, list[int]]:
    """The ends that each end might be joined to."""
    within: dict[int, list[int]] = {}
    for (i, j), cost in price.items():
        if cost < 2 * FREE_END:
            within.setdefault(i, []).append(j)
    return within


def swap(
    i: int,
    j: int,
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    within: dict[int, list[int]],
) -> tuple[float, list[int], list[tuple[int, int]]]:
    """What joining the ends i and j would add to the total, the ends that lose their partners, and
    the cheapest pairs for all of them."""

    def paid(end: int) -> float:
        if end not in partner:
            return FREE_END
        return min(price[end, partner[end]], 2 * FREE_END)

    left = [partner[end] for end in (i, j) if end in partner]
    ways: list[tuple[float, list[tuple[int, int]]]] = [(FREE_END * len(left), [])]
    if len(left) == 2 and left[1] in within.get(left[0], ()):
        ways.append((price[left[0], left[1]], [(left[0], left[1])]))
    if len(left) == 1:
        free = [k for k in within.get(left[0], ()) if k not in partner and k not in (i, j)]
        ways += [(price[left[0], k] - FREE_END, [(left[0], k)]) for k in free]
    cost, pairs = min(ways)
    return price[i, j] + cost - paid(i) - paid(j), left, [(i, j), *pairs]

"""Merging segments into threads by the distance and the angle of their ends (Fig. 3b)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from suturetrack.initialization.depth import Depth
from suturetrack.initialization.model import InitializationConfig
from suturetrack.initialization.pricing import FREE_END, TOUCHING_PX, Merge, price_merges
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.initialization.strands import REACH, Strands
from suturetrack.types import Float64

Int64 = NDArray[np.int64]

CROSSING = "an ambiguous crossing"
"""Why a thread is doubtful where it might leave a crossing another way."""
_REASSURANCE = 0.3
"""Share of its lead over the next best way that the price of a merge is less doubtful by."""
_STRAIN = 1.5
"""How much of the confidence is lost with each unit of doubt that is left of the price."""
_RUNS_ON = 0.55
"""Price of a merge below which an end might as well run on."""
_GAP, _GAP_SAMPLES = 0.85, 13
"""Least ||V|| between an end and another strand, against both, below which a gap is seen there."""
_LONGEST_RUN = 4
"""Segments that two strands may share in a row."""
_CLEARLY = 0.03
"""By how much less two strands have to cost in all if their far parts are swapped."""


@dataclass(frozen=True, eq=False)
class Merged:
    """Which ends were joined, and what that cost."""

    segments: tuple[Float64, ...]
    """Those of the ridges, and once more those that two strands share."""
    partner: dict[int, int]
    """The end that each joined end was joined to."""
    price: dict[tuple[int, int], float]
    """Of every pair of ends within reach."""

    def doubts(self, entries: list[int], ridges: Ridges) -> list[tuple[int, str, float]]:
        """What is doubtful about the thread that enters its segments at `entries`: at which end, why,
        and what that leaves of the confidence; `ridges` are those that were merged."""
        within = _within_reach(self.price)
        found = []
        for entry in entries[1:]:
            price = self.price[entry, self.partner[entry]]
            lead = min(self._lead(entry, entries, within), FREE_END)
            strain = price - _REASSURANCE * lead
            if price >= 2 * FREE_END:
                found.append((entry, "a sharp bend", 0.6))
            elif strain > 0:
                rest = max(1 - _STRAIN * strain, 0.1)
                found.append((entry, CROSSING, rest))
        for tip in (entries[0], entries[-1] ^ 1):
            if self._runs_into_another(tip, entries, ridges):
                on = min((self.price[tip, j] for j in within.get(tip, ())), default=np.inf)
                rest = 0.25 if on < _RUNS_ON else 0.4
                found.append((tip, "an end beside another ridge", rest))
        return found

    def _lead(self, entry: int, entries: list[int], within: dict[int, list[int]]) -> float:
        """How much more the ends cost in total if another way is taken at `entry`."""
        other = self.partner[entry]
        on_thread = {e // 2 for e in entries}
        added = [
            _swap(end, rival, self.partner, self.price, within)[0]
            for end, partner in ((entry, other), (other, entry))
            for rival in within.get(end, ())
            if rival != partner and not (self._is_copy(rival, partner) and rival // 2 in on_thread)
        ]
        return max(min(added, default=1.0), 0.0)

    def _is_copy(self, one: int, other: int) -> bool:
        return one % 2 == other % 2 and self.segments[one // 2] is self.segments[other // 2]

    def _runs_into_another(self, tip: int, entries: list[int], ridges: Ridges) -> bool:
        """Whether another ridge is at a tip, or, without a gap before it, the thread itself."""
        segment, own = self.segments[tip // 2], {e // 2 for e in entries}
        end = segment[-(tip % 2)]
        others = [s for k, s in enumerate(self.segments) if k not in own]
        if others and _nearest(np.concatenate(others), end)[1] < TOUCHING_PX:
            return True
        passing = [self.segments[k] for k in own - {tip // 2}]
        passing.append(segment[: -2 * ARM] if tip % 2 else segment[2 * ARM :])
        points = np.concatenate(passing)
        if not len(points):
            return False
        nearest, distance = _nearest(points, end)
        between = ridges.sample(np.linspace(end, nearest, _GAP_SAMPLES))
        is_joined = between.min() > _GAP * min(between[0], between[-1])
        return bool(distance < TOUCHING_PX and is_joined)


def _nearest(points: Float64, place: Float64) -> tuple[Float64, float]:
    """Of (k, 2) points the one nearest to a place, and how far it is."""
    distance = np.linalg.norm(points - place, axis=1)
    nearest = int(np.argmin(distance))
    return points[nearest], float(distance[nearest])


def merge_ends(ridges: Ridges, config: InitializationConfig, depth: Depth | None = None) -> Merged:
    """Pairs up the ends so that all merges and free ends together cost least (almost: by exchange).

    With `depth`, ends whose arms differ in depth are dearer to join.
    """
    if not ridges.segments:
        return Merged((), {}, {})
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
    segments = _share(ridges.segments, partner, price, strands)
    _open_rings(partner, price)
    _pair(partner, merges.pairs[order[merges.touching[order]]])
    return Merged(segments, partner, price)


def _uncross(
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands,
) -> None:
    """Where one strand leads through a short segment and another beside it, swaps their far parts if
    these fit better so: short segments say little about direction."""
    within = _within_reach(price)
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
) -> tuple[Float64, ...]:
    """Doubles the runs of segments that a second strand waits for at both ends."""
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
        _double(run, one, other, copies, partner, price, strands)
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
    copies: list[Float64],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
    strands: Strands | None,
) -> None:
    """Leads a second strand, which waits with the ends `one` and `other`, through a run."""
    start, stop = run[0], run[-1] ^ 1
    first, last = partner[start], partner[stop]
    # Of the two ways to connect the strands none may close a loop; else the smoother one is taken.
    ring = _leads_to(one, partner) == other or _is_ring(start, partner)
    if ring or other == _leads_to(first, partner) or one == _leads_to(last, partner):
        swap = ring
    else:
        straight, crossed = [(one, other), (first, last)], [(one, last), (first, other)]
        change = None if strands is None else strands.change(straight, crossed)
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


def _open_rings(partner: dict[int, int], price: dict[tuple[int, int], float]) -> None:
    """Leads a strand that crosses a ring of segments through it: a thread has two ends."""
    for start in list(partner):
        if not _is_ring(start, partner):
            continue
        ring = _ends_from(start, partner)
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


def _ends_from(start: int, partner: dict[int, int]) -> list[int]:
    """The ends, two a segment, of the ring that leads through the end `start`."""
    ends = [start, start ^ 1]
    while partner[ends[-1]] != start:
        ends += [partner[ends[-1]], partner[ends[-1]] ^ 1]
    return ends


def _is_ring(start: int, partner: dict[int, int]) -> bool:
    """Whether the segments joined to that of the end `start` lead back to it."""
    end = start ^ 1
    while end in partner:
        end = partner[end] ^ 1
        if end == start ^ 1:
            return True
    return False


def _leads_to(end: int, partner: dict[int, int]) -> int:
    """The free end at the other side of the chain of segments that begins at the free `end`."""
    end ^= 1
    while end in partner:
        end = partner[end] ^ 1
    return end


def follow(start: int, partner: dict[int, int]) -> list[int]:
    """The ends at which the segments of a thread are entered, in order, from one of its ends to the
    other; `start` is a segment on it."""
    entry = 2 * start
    seen = {start}
    while entry in partner and partner[entry] // 2 not in seen:
        entry = partner[entry] ^ 1
        seen.add(entry // 2)
    entries, seen = [entry], {entry // 2}
    while (leave := entries[-1] ^ 1) in partner and partner[leave] // 2 not in seen:
        entries.append(partner[leave])
        seen.add(entries[-1] // 2)
    return entries


def _pair(partner: dict[int, int], pairs: Int64) -> None:
    for i, j in pairs.tolist():
        if i not in partner and j not in partner:
            partner[i], partner[j] = j, i


def _exchange(partner: dict[int, int], price: dict[tuple[int, int], float]) -> None:
    """Swaps partners as long as that lowers the total."""
    within = _within_reach(price)
    improved = True
    while improved:
        improved = False
        for i, j in list(price):
            if partner.get(i) == j or price[i, j] >= 2 * FREE_END:
                continue
            added, left, pairs = _swap(i, j, partner, price, within)
            if added < -1e-9:
                for end in left:
                    del partner[end]
                for one, other in pairs:
                    partner[one], partner[other] = other, one
                improved = True


def _within_reach(price: dict[tuple[int, int], float]) -> dict[int, list[int]]:
    within: dict[int, list[int]] = {}
    for (i, j), cost in price.items():
        if cost < 2 * FREE_END:
            within.setdefault(i, []).append(j)
    return within


def _swap(
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

"""Ends of segments, joined at a price; end 2i is the start of segment i, 2i + 1 its end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from suturetrack.initialization.pricing import FREE_END, Merges
from suturetrack.types import Float64, Int64

_OUT_OF_REACH = 2.0
"""Price of joining two ends that are too far apart to be priced, against the highest."""

Pair = tuple[int, int]
"""Two ends."""
Way = tuple[int, int]
"""The end at which a segment is entered, and how many of its points from there on are passed over."""


def inward(segments: Sequence[Float64], end: int) -> Float64:
    """(k, 2) the points of the segment of an end, from that end on."""
    return segments[end // 2][:: -1 if end % 2 else 1]


@dataclass(eq=False)
class Joints:
    """Which ends are joined, and what it costs to join any two."""

    segments: list[Float64]
    """Those of the ridges, and once more those that two strands share."""
    price: dict[Pair, float]
    """Of every pair of ends within reach, both ways round."""
    free_end: float = FREE_END
    """Of an end that is joined to none."""
    partner: dict[int, int] = field(default_factory=dict)
    """The end that each joined end is joined to."""
    bent: frozenset[int] = frozenset()
    """The joined ends whose strands bend there as two would, and not one."""
    hidden: set[int] = field(default_factory=set)
    """The joined ends of strands that something hides in between."""
    lead: dict[int, float] = field(default_factory=dict)
    """Of ends at which two strands leave what they share: by how much the ways that they take cost less than
    exchanged, by their arms."""
    _copied: dict[int, int] = field(default_factory=dict)
    """Which segment each copy is of."""

    @classmethod
    def priced(cls, segments: Iterable[Float64], merges: Merges, free_end: float) -> Joints:
        """With nothing joined yet."""
        pairs, costs = merges.pairs.tolist(), merges.cost.tolist()
        price = {(i, j): cost for (i, j), cost in zip(pairs, costs, strict=True)}
        price |= {(j, i): cost for (i, j), cost in price.items()}
        return cls(list(segments), price, free_end)

    @property
    def highest(self) -> float:
        """The highest price that is paid for a join: that of the two ends without it."""
        return 2 * self.free_end

    @property
    def free(self) -> list[int]:
        """The ends that are joined to none."""
        return [end for end in range(2 * len(self.segments)) if end not in self.partner]

    def price_of(self, pair: Pair) -> float:
        """Of any pair of ends."""
        return self.price.get(pair, _OUT_OF_REACH * self.highest)

    def within_reach(self) -> dict[int, list[int]]:
        """The ends that each end might be joined to."""
        within: dict[int, list[int]] = {}
        for (i, j), cost in self.price.items():
            if cost < self.highest:
                within.setdefault(i, []).append(j)
        return within

    def join(self, i: int, j: int, price: float | None = None) -> None:
        """Joins two ends; `price` is for those that have none."""
        self.partner[i], self.partner[j] = j, i
        if price is not None:
            self.price.setdefault((i, j), price)
            self.price.setdefault((j, i), price)

    def exchanged(self, one: Way, other: Way) -> Joints:
        """These, but that two strands go on as each other does."""
        joints = Joints(
            self.segments.copy(),
            self.price.copy(),
            self.free_end,
            self.partner.copy(),
            self.bent,
            self.hidden,
            self.lead,
            self._copied,
        )
        one_end, other_end = joints._entered(*one), joints._entered(*other)
        before, others_before = joints.partner[one_end], joints.partner[other_end]
        joints.join(before, other_end, self.free_end)
        joints.join(others_before, one_end, self.free_end)
        joints._know_nothing_of({before, other_end, others_before, one_end})
        return joints

    def _know_nothing_of(self, ends: set[int]) -> None:
        """Forgets how strands ran at ends that were joined to others."""
        self.bent, self.hidden = self.bent - ends, self.hidden - ends
        self.lead = {end: lead for end, lead in self.lead.items() if end not in ends}

    def _entered(self, entry: int, count: int) -> int:
        """The end at which the rest of a segment is entered behind so many of its points from an end on; it
        becomes a segment of its own."""
        if not count:
            return entry
        line, far, rest = inward(self.segments, entry), entry ^ 1, 2 * len(self.segments)
        self.segments[entry // 2] = line[:count][:: -1 if entry % 2 else 1]
        self.segments.append(line[count:])
        if far in self.partner:
            self.join(rest ^ 1, self.partner.pop(far))
        moved = {far: rest ^ 1}
        self.price = {
            (moved.get(i, i), moved.get(j, j)): cost for (i, j), cost in self.price.items()
        }
        self.bent = frozenset(moved.get(end, end) for end in self.bent)
        self.hidden = {moved.get(end, end) for end in self.hidden}
        self.lead = {moved.get(end, end): lead for end, lead in self.lead.items()}
        self.join(far, rest, 0.0)
        return rest

    def join_free(self, pairs: Int64) -> None:
        """Joins those of (m, 2) pairs whose ends are both free, the first first."""
        for i, j in pairs.tolist():
            if i not in self.partner and j not in self.partner:
                self.join(i, j)

    def copy(self, segment: int) -> int:
        """Adds a segment once more, for a second strand; the index of the copy."""
        self._copied[len(self.segments)] = self._copied.get(segment, segment)
        self.segments.append(self.segments[segment])
        return len(self.segments) - 1

    def copy_prices(self, copied: dict[int, int]) -> None:
        """Prices the copies of ends as these."""
        self.price |= {(copied[e], j): c for (e, j), c in self.price.items() if e in copied}
        self.price |= {(j, copied[e]): c for (j, e), c in self.price.items() if e in copied}

    def original(self, end: int) -> int:
        """The end that this one is or is a copy of."""
        return 2 * self._copied.get(end // 2, end // 2) + end % 2

    def follow(self, start: int) -> list[int]:
        """The ends at which the segments of a thread are entered, in order, from one of its ends to the
        other; `start` is a segment on it."""
        entry = 2 * start
        seen = {start}
        while entry in self.partner and self.partner[entry] // 2 not in seen:
            entry = self.partner[entry] ^ 1
            seen.add(entry // 2)
        entries, seen = [entry], {entry // 2}
        while (leave := entries[-1] ^ 1) in self.partner and self.partner[leave] // 2 not in seen:
            entries.append(self.partner[leave])
            seen.add(entries[-1] // 2)
        return entries

    def other_end(self, end: int) -> int:
        """The free end at the other side of the chain of segments that begins at the free `end`."""
        end ^= 1
        while end in self.partner:
            end = self.partner[end] ^ 1
        return end

    def ring(self, start: int) -> list[int]:
        """The ends, two a segment, of the ring that leads through the end `start`; none if none does."""
        ends = [start, start ^ 1]
        while (end := self.partner.get(ends[-1], start)) != start:
            ends += [end, end ^ 1]
        return ends if ends[-1] in self.partner else []

    def open_rings(self) -> None:
        """Leads a strand that crosses a ring of segments through it: a thread has two ends."""
        price = self.price
        for start in list(self.partner):
            ring = self.ring(start)
            ways = [
                (price[i, a] + self.price_of((j, b)) - price[i, j] - price[a, b], i, j, a, b)
                for i, j in ((e, self.partner[e]) for e in ring)
                for a, b in self.partner.items()
                if a not in ring and (i, a) in price
            ]
            added, i, j, a, b = min(ways, default=(self.highest, 0, 0, 0, 0))
            if added < self.highest:
                self.join(i, a, self.highest)
                self.join(j, b, self.highest)

    def exchange(self) -> None:
        """Swaps partners as long as that lowers the total."""
        within = self.within_reach()
        improved = True
        while improved:
            improved = False
            for i, j in list(self.price):
                if self.partner.get(i) == j or self.price[i, j] >= self.highest:
                    continue
                added, left, pairs = self.swap(i, j, within)
                if added < -1e-9:
                    for end in left:
                        del self.partner[end]
                    for pair in pairs:
                        self.join(*pair)
                    improved = True

    def swap(
        self, i: int, j: int, within: dict[int, list[int]]
    ) -> tuple[float, list[int], list[Pair]]:
        """What joining the ends i and j would add to the total, the ends that lose their partners, and
        the cheapest pairs for all of them."""
        left = [self.partner[end] for end in (i, j) if end in self.partner]
        ways: list[tuple[float, list[Pair]]] = [(self.free_end * len(left), [])]
        if len(left) == 2 and left[1] in within.get(left[0], ()):
            ways.append((self.price[left[0], left[1]], [(left[0], left[1])]))
        if len(left) == 1:
            free = [k for k in within.get(left[0], ()) if k not in self.partner and k not in (i, j)]
            ways += [(self.price[left[0], k] - self.free_end, [(left[0], k)]) for k in free]
        cost, pairs = min(ways)
        added = self.price[i, j] + cost - self._paid(i) - self._paid(j)
        return added, left, [(i, j), *pairs]

    def _paid(self, end: int) -> float:
        if end not in self.partner:
            return self.free_end
        return min(self.price[end, self.partner[end]], self.highest)

"""Where a thread touches other strands of its view, and how well each goes on as the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.colours import difference
from suturetrack.initialization.depth import Depth, Disparities
from suturetrack.initialization.joints import Joints, Way, inward
from suturetrack.initialization.segments import Ridges
from suturetrack.initialization.smoothness import bending, roughness, step
from suturetrack.initialization.threads import Thread
from suturetrack.polylines import Run, runs_of
from suturetrack.types import Float64, Int64

_TOUCHING_PX = 3.0
"""Distance below which two strands draw each other's crests aside."""
_TOGETHER, _MOST_TOUCHES = 30, 4
"""Points between two such places up to which these are one contact: what lies between is too short an arm to
tell by itself; and how many may be one whose sides are told apart."""
_ARM, _SHAPE, _EVERY = 60, 40, 2
"""Points of an arm, of those how many tell its shape, and which of these."""
_SHORTEST_ARM, _LONGEST_GAP = 12, 8
"""Points of an arm at least, and of a gap in it at most."""
_CLEAR_PX, _LEAST_TOLD = 5.0, 5
"""Distance from the other strand from which a point tells its depth, and how many do at least."""
_SHORTEST_PART = 4
"""Points of a segment, at least, that are left on each side of where it is divided."""
_HEADING = 4
"""Points before and behind the middle of a contact that tell where a strand runs."""
_FAINT = 0.4
"""Strength, against the thread's, below which another strand is a vein or a shadow."""
_SHARE = 0.3
"""How rough strands that touch are, against the roughest part of all that a view shows: of 1,524 contacts 28
are told wrong with all of it, 20 with 0.3, 32 with 0.1."""
_STRENGTH = 0.25
"""By how much the logarithms of the strengths of two arms of one thread differ (standard deviation)."""
_MOST_BENT, _MOST_STEP, _MOST_RECOLOURED, _MOST_FADED = 24.0, 25.0, 8.0, 8.0
"""Energy of the bends of two strands, and of a step in depth, in colour, or in strength, at most: an arm that
ends there fits no other."""
CLEARLY = 1.0
"""Energy by which strands fit together better if exchanged, from which they are."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A strand on one side of a contact."""

    pixels: Float64
    """(k, 2) from the contact on."""
    disparities: Disparities | None
    """None where they cannot be told."""
    clear: Disparities | None
    """Those of them that the other strand is too far away to be taken for."""
    tints: Float64
    """(k, 3); nothing where the images are gray."""
    strength: float
    """Median ||V||."""

    @property
    def there(self) -> Float64:
        """(m, 2) pixels in the other view; nothing where they cannot be told."""
        known = self.disparities
        if known is None:
            return np.empty((0, 2))
        return known.pixels - np.c_[known.value, np.zeros(len(known.value))]


Ways = list[tuple[Way, Way]]
"""Where two strands go on as each other does, the farthest first."""


@dataclass(frozen=True, eq=False)
class Contact:
    """A place at which two strands of one view touch: each comes with one arm and leaves with another."""

    pixels: Float64
    """(k, 2) of the thread, between its arms."""
    own: tuple[Arm, Arm]
    """Of the thread, before and behind it."""
    other: tuple[Arm, Arm]
    """Of another strand."""
    energy: float
    """By how much less well they would be two strands if they left with each other's arm."""
    ways: Ways
    """Where both have to go on as each other does to leave with each other's arm."""
    sides: Ways
    """And where to leave with their own, but part in between on each other's side, which fits better; none if
    that is as it is."""

    @property
    def disparity(self) -> float:
        """Median u_own - u_other of all arms, px; NaN where none is known."""
        known = [a.disparities.value for a in (*self.own, *self.other) if a.disparities is not None]
        return float(np.median(np.concatenate(known))) if known else np.nan


def contacts(thread: Thread, ridges: Ridges, depth: Depth) -> list[Contact]:
    """Where a thread touches other strands of its view.

    Args:
        thread: one view's.
        ridges: of that view.
        depth: of arms in it.
    """
    look, rough = partial(_arm, ridges=ridges, depth=depth), _SHARE * roughness(ridges)
    own, found = _Line.of(thread.joints, thread.entries), []
    tree = cKDTree(own.points)
    for entries in _others(thread):
        other = _Line.of(thread.joints, entries)
        is_near = np.asarray(tree.query(other.points)[0]) < _TOUCHING_PX
        if not is_near.any():
            continue
        for touches in _touches(own.points, other.points, runs_of(is_near)):
            line = other
            if not _run_alike(own.points, other.points, touches):
                line, touches = _turned(thread.joints, other, touches)
            contact = _contact(own, line, touches, look, rough)
            if contact is not None:
                found.append(contact)
    return found


_Touch = tuple[Run, Run]
"""The first point, and that behind the last one, of the stretches of two lines that touch there."""


def _touches(own: Float64, other: Float64, others: list[Run]) -> Iterator[list[_Touch]]:
    """Where two lines (k, 2) and (m, 2) touch, of the second in those runs, in order along the first; what is
    near together at once."""
    distance, nearest = map(np.asarray, cKDTree(other).query(own))
    found: list[_Touch] = []
    for start, stop in runs_of(distance < _TOUCHING_PX):
        if found and start - found[-1][0][1] >= _TOGETHER:
            yield found
            found = []
        first, last = sorted((int(nearest[start]), int(nearest[stop - 1])))
        first = min([first, *(a for a, b in others if a <= first < b)])
        last = max([last + 1, *(b for a, b in others if a <= last < b)])
        found.append(((start, stop), (first, last)))
    if found:
        yield found


def _whole(touches: list[_Touch]) -> _Touch:
    """All of some touches as one."""
    own, other = ([touch[line] for touch in touches] for line in (0, 1))
    return (
        (own[0][0], own[-1][1]),
        (min(start for start, _ in other), max(stop for _, stop in other)),
    )


def _run_alike(own: Float64, other: Float64, touches: list[_Touch]) -> bool:
    """Whether two lines run in the same direction where they touch."""
    headings = []
    for line, (start, stop) in zip((own, other), _whole(touches), strict=True):
        middle = (start + stop) // 2
        ahead = line[min(middle + _HEADING, len(line) - 1)]
        headings.append(ahead - line[max(middle - _HEADING, 0)])
    return bool(headings[0] @ headings[1] >= 0)


def _turned(joints: Joints, line: _Line, touches: list[_Touch]) -> tuple[_Line, list[_Touch]]:
    """A line that others touch from its other end on."""
    count = len(line.points)
    turned = _Line.of(joints, [entry ^ 1 for entry in line.entries[::-1]])
    return turned, [(own, (count - stop, count - start)) for own, (start, stop) in touches]


def _others(thread: Thread) -> Iterator[list[int]]:
    """The ends at which the segments of every other strand are entered."""
    seen = {entry // 2 for entry in thread.entries}
    for k in range(len(thread.joints.segments)):
        if k not in seen:
            entries = thread.joints.follow(k)
            seen |= {entry // 2 for entry in entries}
            yield entries


@dataclass(frozen=True, eq=False)
class _Line:
    """The points of a strand."""

    entries: list[int]
    points: Float64
    """(n, 2)."""
    segment: Int64
    """(n,) of which of its segments each point is."""
    sizes: list[int]
    """Points of each segment; those behind are in the gap to the next."""

    @classmethod
    def of(cls, joints: Joints, entries: list[int]) -> _Line:
        pieces = [inward(joints.segments, entry) for entry in entries]
        bridged = [_bridged(a, b) for a, b in pairwise(pieces)] + pieces[-1:]
        return cls(
            entries,
            np.concatenate(bridged),
            np.repeat(np.arange(len(pieces)), [len(piece) for piece in bridged]),
            [len(piece) for piece in pieces],
        )

    @cached_property
    def _gaps(self) -> list[Run]:
        """The long ones: the first point in each, and that behind the last one."""
        starts = np.searchsorted(self.segment, np.arange(len(self.sizes)))
        stops = np.r_[starts[1:], len(self.segment)]
        gaps = zip((starts + self.sizes).tolist(), stops.tolist(), strict=True)
        return [(start, stop) for start, stop in gaps if stop - start > _LONGEST_GAP]

    def before(self, place: int) -> Float64:
        """(k, 2) the points before one, or before the gap that it is in, backwards, as far as a gap."""
        place = min([start for start, stop in self._gaps if start < place < stop], default=place)
        gap = max((stop for _, stop in self._gaps if stop <= place), default=0)
        return self.points[max(gap, place - _ARM) : place][::-1]

    def behind(self, place: int) -> Float64:
        """(k, 2) the points from one, or from behind the gap that it is in, on, as far as a gap."""
        place = max([stop for start, stop in self._gaps if start <= place < stop], default=place)
        gap = min((start for start, _ in self._gaps if start >= place), default=len(self.points))
        return self.points[place : min(gap, place + _ARM)]

    def between(self, start: int, stop: int) -> Float64:
        """(k, 2) the points from one to another; none over a gap."""
        is_seen = all(gap_stop <= start or gap_start >= stop for gap_start, gap_stop in self._gaps)
        return self.points[start : stop if is_seen else start]

    def way(self, start: int, stop: int) -> Way:
        """How it goes on behind a stretch: by the last joint there, or through a segment."""
        k = int(self.segment[stop])
        passed = stop - int(np.argmax(self.segment == k))
        if passed > self.sizes[k] - _SHORTEST_PART and k + 1 < len(self.entries):
            return self.entries[k + 1], 0
        return self.entries[k], 0 if passed < _SHORTEST_PART or self.segment[start] < k else passed


def _bridged(piece: Float64, following: Float64) -> Float64:
    """A piece of a line with points over the gap to that which follows."""
    count = int(np.linalg.norm(following[0] - piece[-1]))
    share = np.arange(1, count)[:, None] / max(count, 1)
    return np.concatenate([piece, piece[-1] + share * (following[0] - piece[-1])])


_Look = Callable[[Float64, Float64], Arm]


def _contact(
    own: _Line, other: _Line, touches: list[_Touch], look: _Look, rough: float
) -> Contact | None:
    """That of two lines which touch, if their arms are long enough to tell."""
    lines = own, other
    whole = _whole(touches)
    before = [line.before(start) for line, (start, _) in zip(lines, whole, strict=True)]
    behind = [line.behind(stop) for line, (_, stop) in zip(lines, whole, strict=True)]
    if min(map(len, (*before, *behind))) < _SHORTEST_ARM:
        return None
    beside = other.points, own.points
    arms = list(map(look, before, beside)), list(map(look, behind, beside))
    if max(arm.strength for arm in (arms[0][1], arms[1][1])) < _FAINT * arms[0][0].strength:
        return None
    if len(touches) > _MOST_TOUCHES or not _are_apart(lines, touches):
        touches = [whole]
    pieces = [
        [piece[:_SHAPE:_EVERY][::-1] for piece in before],
        *(
            [
                line.between(stop, start)[::_EVERY]
                for line, (_, stop), (start, _) in zip(lines, one, two, strict=True)
            ]
            for one, two in pairwise(touches)
        ),
        [piece[:_SHAPE:_EVERY] for piece in behind],
    ]
    # At each touch the strands may cross, or not.
    crossed = sorted(product((False, True), repeat=len(touches)), key=sum)
    apart = sum(bending(piece, rough) for both in pieces for piece in both if len(piece))
    energies = np.array([_bending(pieces, ways, rough) - apart for ways in crossed])
    is_odd = np.array([sum(ways) % 2 for ways in crossed], bool)
    change = _change(*arms[0], *arms[1])
    even, odd = (int(np.where(which, energies, np.inf).argmin()) for which in (~is_odd, is_odd))
    bends = np.minimum(energies[[even, odd]], _MOST_BENT)
    energy = bends[1] - bends[0] + change
    if energies[even] > energies[0] - CLEARLY:
        even = 0
    return Contact(
        own.points[slice(*whole[0])],
        (arms[0][0], arms[1][0]),
        (arms[0][1], arms[1][1]),
        float(energy),
        *(
            [
                (own.way(*at), other.way(*there))
                for (at, there), is_crossed in zip(touches, crossed[which], strict=True)
                if is_crossed
            ][::-1]
            for which in (odd, even)
        ),
    )


def _are_apart(lines: tuple[_Line, _Line], touches: list[_Touch]) -> bool:
    """Whether both lines pass the touches in order, and go on behind each in a way of its own."""
    starts = [start for _, (start, _) in touches]
    ways = [[line.way(*touch[k]) for touch in touches] for k, line in enumerate(lines)]
    return starts == sorted(starts) and all(len(set(each)) == len(touches) for each in ways)


def _bending(pieces: list[list[Float64]], crossed: tuple[bool, ...], rough: float) -> float:
    """Energy of two strands that go on from piece to piece, and cross from each other's to each other's where
    they touch."""
    sides = np.cumsum([0, *crossed]) % 2
    return sum(
        bending(
            np.concatenate([both[side ^ k] for both, side in zip(pieces, sides, strict=True)]),
            rough,
        )
        for k in (0, 1)
    )


def _change(before: Arm, others_before: Arm, behind: Arm, others_behind: Arm) -> float:
    """By how much more two strands change if they leave a place with each other's arm."""
    return (
        _misfit(before, others_behind)
        + _misfit(others_before, behind)
        - _misfit(before, behind)
        - _misfit(others_before, others_behind)
    )


def _arm(pixels: Float64, other: Float64, ridges: Ridges, depth: Depth) -> Arm:
    """What a view shows of (k, 2) pixels of a strand that touches another one, (m, 2)."""
    tints = np.empty((0, 3)) if ridges.tints is None else ridges.tints.along(pixels)
    strength = float(np.median(ridges.sample(pixels)))
    known = clear = depth.along(pixels)
    if known is not None:
        is_clear = np.asarray(cKDTree(other).query(known.pixels)[0]) > _CLEAR_PX
        clear = Disparities(known.pixels[is_clear], known.value[is_clear], known.variance[is_clear])
    is_told = clear is not None and len(clear.value) >= _LEAST_TOLD
    return Arm(pixels, known, clear if is_told else None, tints, strength)


def _misfit(one: Arm, other: Arm) -> float:
    """Energy by which two arms are less well one strand than two, but for their shapes."""
    energy = min(difference(one.tints, other.tints), _MOST_RECOLOURED)
    if one.clear is not None and other.clear is not None:
        energy += min(step(one.clear, other.clear), _MOST_STEP)
    ratio = np.log(max(one.strength, 1e-6) / max(other.strength, 1e-6))
    return energy + min(0.5 * float(ratio / _STRENGTH) ** 2, _MOST_FADED)

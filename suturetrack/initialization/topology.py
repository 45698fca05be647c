"""Merging segments into threads by the distance and the angle of their ends (Fig. 3b)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.arms import Arms
from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.hairpins import double_stubs
from suturetrack.initialization.joints import Joints, Pair, inward
from suturetrack.initialization.pricing import (
    DEAR_END,
    FEW_ENDS,
    FREE_END,
    STRAND,
    Merges,
    price_merges,
)
from suturetrack.initialization.segments import ARM, Ridges
from suturetrack.initialization.smoothness import roughness
from suturetrack.polylines import unit
from suturetrack.types import Bool

_LONGEST_RUN = 4
"""Segments that two strands may share in a row."""
_LONG_PX, _WIDER = 100, 1.1
"""Length from which such a segment has to be wider than those of the view are, and by how much, squared."""
_BENT = 8.0
"""Energy by which two arms fit together less well as one strand than as two."""
_LONGEST_HIDDEN_PX = 60.0
_ONE_STRAND = 2.5
"""Energy up to which two arms with a hidden stretch in between are one strand."""
_AS_STRONG = 0.5
"""Ratio of their strengths, at least."""
_CLEAR = 0.5
"""Strength, against that of the strongest segment that is no speck, from which an end is one of a thread."""
_TOUCHED_PX, _LEAST_PART = 12.0, 8
"""How far from a segment an end is that touches it, and how many points there are at least of each part if it
is divided there."""
_FACING = 0.5
"""Cosine of the angle by which an end may miss another one that it points at."""


def merge_ends(ridges: Ridges, config: InitializationConfig, depth: Depth | None = None) -> Joints:
    """Pairs up the ends so that all merges and free ends together cost least (almost: by exchange).

    Ends whose arms differ in colour are dearer to join, and with `depth` those whose arms differ in that.
    Where a view shows little but a thread, free ends are dearer if that leaves its own two, and a segment on
    whose side a loop ends is divided there if it takes that.
    """
    if not ridges.segments:
        return Joints([], {})
    joints = _pair_up(ridges, config, depth)
    if 2 < len(_clear_ends(joints, ridges)) <= FEW_ENDS:
        divided = _divided(ridges, joints)
        if len(divided.segments) > len(ridges.segments):
            one_thread = _pair_up(divided, config, depth)
            if len(_clear_ends(one_thread, divided)) == 2:
                return one_thread
    return joints


def _pair_up(ridges: Ridges, config: InitializationConfig, depth: Depth | None) -> Joints:
    """The ends of segments as they are."""
    shapes = price_merges(ridges, config)
    first = _merge(ridges, shapes, None)
    arms = Arms(first.segments, first.partner, shapes, depth, ridges.tints, roughness(ridges))
    merges = arms.with_steps(shapes)
    joints = _merge(ridges, merges, arms)
    if 2 < len(_clear_ends(joints, ridges)) <= FEW_ENDS:
        # Beside another strand an arm has the colour and the depth of both: only its shape must fit.
        one_thread = _merge(ridges, merges.where(shapes.may_be_one_thread), arms, DEAR_END)
        if len(_clear_ends(one_thread, ridges)) == 2:
            return one_thread
    return joints


def _clear_ends(joints: Joints, ridges: Ridges) -> list[int]:
    """The free ends of strands about as strong as the strongest."""
    is_clear = _are_clear(ridges)
    return [end for end in joints.free if is_clear[joints.original(end) // 2]]


def _are_clear(ridges: Ridges) -> Bool:
    """(n,) which segments are about as strong as the strongest."""
    strength = ridges.strengths
    is_long = np.array([len(segment) >= STRAND for segment in ridges.segments])
    return np.asarray(strength > _CLEAR * strength[is_long | ~is_long.any()].max())


def _divided(ridges: Ridges, joints: Joints) -> Ridges:
    """The ridges, of which those that are clear are divided where both ends of a strand touch others."""
    touched = {end: _touched(end, ridges, joints) for end in _clear_ends(joints, ridges)}
    cuts: dict[int, list[int]] = {}
    for end, place in touched.items():
        if place is not None and touched.get(joints.other_end(end)) is not None:
            k, at = place
            bounds = np.array([0, len(ridges.segments[k]), *cuts.get(k, ())])
            if np.abs(bounds - at).min() >= _LEAST_PART:
                cuts.setdefault(k, []).append(at)
    segments = list(ridges.segments)
    for k, places in cuts.items():
        segments[k], *rest = np.split(segments[k], sorted(places))
        segments += rest
    return replace(ridges, segments=tuple(segments))


def _touched(end: int, ridges: Ridges, joints: Joints) -> tuple[int, int] | None:
    """The clear segment of another strand that the end of one touches, and the point of it; None if none."""
    own = {joints.original(entry) // 2 for entry in joints.follow(end // 2)}
    clear = np.flatnonzero(_are_clear(ridges)).tolist()
    place = inward(joints.segments, end)[0]
    away = {k: np.linalg.norm(ridges.segments[k] - place, axis=1) for k in clear if k not in own}
    k = min(away, key=lambda k: away[k].min(), default=-1)
    if k < 0 or away[k].min() >= _TOUCHED_PX:
        return None
    return k, int(away[k].argmin())


def _merge(ridges: Ridges, merges: Merges, arms: Arms | None, free_end: float = FREE_END) -> Joints:
    joints = Joints.priced(ridges.segments, merges, free_end)
    order = np.argsort(merges.cost)
    joints.join_free(merges.pairs[order[merges.cost[order] < joints.highest]])
    joints.exchange()
    _share(joints, ridges, arms)
    joints.open_rings()
    double_stubs(joints)
    if arms is not None:
        _mark_bent(joints, arms)
        _bridge_hidden(joints, ridges, arms)
    return joints


def _mark_bent(joints: Joints, arms: Arms) -> None:
    joints.bent = frozenset(
        i
        for i, j in joints.partner.items()
        if arms.bend(joints.original(i), joints.original(j)) > _BENT
    )


def _bridge_hidden(joints: Joints, ridges: Ridges, arms: Arms) -> None:
    """Joins free ends of one strand that something, such as a tool, hides in between."""
    free = [end for end in joints.free if end < 2 * len(ridges.segments)]
    if len(free) < 2:
        return
    ways = [(arms.goes_on(i, j), i, j) for i, j in _facing(free, ridges)]
    for energy, i, j in sorted(ways):
        if energy > _ONE_STRAND:
            break
        is_free = i not in joints.partner and j not in joints.partner
        if is_free and joints.other_end(i) != j:
            joints.join(i, j, FREE_END)
            joints.hidden |= {i, j}


def _facing(ends: list[int], ridges: Ridges) -> list[Pair]:
    """Pairs of ends, near each other, of segments of like strength that point at each other."""
    arms = [inward(ridges.segments, end)[: ARM + 1] for end in ends]
    places = np.array([arm[0] for arm in arms])
    heading = unit(places - [arm[-1] for arm in arms])
    # Behind what hides it the ground may be another one, for all of the strand or for its last points.
    wholes = ridges.strengths[[end // 2 for end in ends]]
    strengths = np.array([wholes, [np.median(ridges.sample(arm)) for arm in arms]])
    a, b = cKDTree(places).query_pairs(_LONGEST_HIDDEN_PX, output_type="ndarray").T
    way = places[b] - places[a]
    facing = np.minimum((heading[a] * way).sum(1), -(heading[b] * way).sum(1))
    is_pair = facing > _FACING * np.linalg.norm(way, axis=1)
    least, most = _AS_STRONG * strengths.min(0), strengths.max(0)
    is_pair &= (most[a] > least[b]) & (most[b] > least[a])
    return [(ends[i], ends[j]) for i, j in zip(a[is_pair], b[is_pair], strict=True)]


def _share(joints: Joints, ridges: Ridges, arms: Arms | None) -> None:
    """Doubles the runs of segments that a second strand waits for at both ends."""
    partner = joints.partner
    waiting: dict[int, tuple[float, int]] = {}
    for (i, j), cost in joints.price.items():
        if i in partner and j not in partner and cost < joints.highest:
            waiting[i] = min(waiting.get(i, (np.inf, -1)), (cost, j))
    found = [(waiting[run[0]][0] + waiting[run[-1] ^ 1][0], run) for run in _runs(waiting, partner)]
    taken: set[int] = set()
    for _, run in sorted(found):
        one, other = waiting[run[0]][1], waiting[run[-1] ^ 1][1]
        if one == other or one in partner or other in partner:
            continue
        if any(e // 2 in taken for e in run) or _is_of_one(joints, run, ridges):
            continue
        taken.update(e // 2 for e in run)
        _double(joints, run, one, other, arms)


def _is_of_one(joints: Joints, run: list[int], ridges: Ridges) -> bool:
    """Whether some of a run is too long to be that narrow, if two strands shared it."""
    long = [s for s in (joints.segments[end // 2] for end in run) if len(s) >= _LONG_PX]
    if not long:
        return False
    usual = np.median([ridges.squared_width(s) for s in ridges.segments if len(s) >= ARM])
    return any(ridges.squared_width(segment) < _WIDER * usual for segment in long)


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


def _double(joints: Joints, run: list[int], one: int, other: int, arms: Arms | None) -> None:
    """Leads a second strand, which waits with the ends `one` and `other`, through a run; its lead is by
    how much that costs less than the other way, as far as the arms tell."""
    start, stop = run[0], run[-1] ^ 1
    first, last = joints.partner[start], joints.partner[stop]
    # Of the two ways to connect the strands none may close a loop; else the smoother one is taken.
    is_ring = joints.other_end(one) == other or bool(joints.ring(start))
    if is_ring or other == joints.other_end(first) or one == joints.other_end(last):
        is_crossed = is_ring
    else:
        straight, crossed = [(one, other), (first, last)], [(one, last), (first, other)]
        change = None if arms is None else _change(joints, straight, crossed, arms)
        if change is None:
            change = sum(map(joints.price_of, crossed)) - sum(map(joints.price_of, straight))
        else:
            joints.lead[last] = joints.lead[other] = abs(change)
        is_crossed = change < 0
    copied: dict[int, int] = {}
    for entry in run:
        copy = joints.copy(entry // 2)
        copied |= {end: 2 * copy + end % 2 for end in (entry, entry ^ 1)}
    joints.copy_prices(copied)
    for a, b in pairwise(run):
        joints.join(copied[a ^ 1], copied[b])
    joints.join(one, copied[start])
    joints.join(copied[stop], last if is_crossed else other)
    if is_crossed:
        joints.join(stop, other)


def _change(joints: Joints, taken: list[Pair], exchanged: list[Pair], arms: Arms) -> float | None:
    """How much dearer the ends of two strands are joined as `exchanged`; None where it is not told."""
    # The arms know of no copies but their own.
    ways = (
        [(joints.original(i), joints.original(j)) for i, j in way] for way in (taken, exchanged)
    )
    return arms.change(*ways)

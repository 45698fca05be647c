"""What is doubtful about a thread of joints segments: where it crosses, bends, ends, or is joined."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from suturetrack.initialization.arms import ENERGY
from suturetrack.initialization.colours import Tints, difference
from suturetrack.initialization.joints import Joints, inward
from suturetrack.initialization.pricing import FREE_END, HIGHEST
from suturetrack.initialization.segments import ARM, Ridges, chain_tangents
from suturetrack.polylines import nearest_index
from suturetrack.types import Float64

CROSSING = "an ambiguous crossing"
"""Where the thread might leave a crossing another way."""
SHARED = "a stretch that two strands share"
"""Which of them goes on which way, their arms do not tell."""
TOUCHES = "another strand that it touches"
"""Which of them goes on which way, both views together do not tell for sure."""
JOINED = "another strand that ends on it"
"""Where two strands come and one goes on: it may be the other one."""
BENT = "a bend as of two strands"
"""Where the thread may end, and another one go on from there."""
SHARP = "a sharp bend"
FADES = "a fainter ridge behind an end"
RECOLOURED = "a ridge of another colour behind an end"
BEYOND = "a part beyond a gap that is longer"
"""Something else may lie where the thread would go on: of 208 threads found right none had such a part in
both views."""
HIDDEN = "a hidden stretch"
"""What is seen on both sides of it may be two threads."""
FOREIGN = JOINED, BENT
"""Whether a part is another thread's: what one view shows as the one, the other may as the other."""
_FOREIGN = 0.45
"""What such a doubt leaves of the confidence."""
_BEYOND = 0.45
"""What such a part leaves of it."""
_UNSEEN = 0.3
"""Strength in the gap, against the part's, at most."""
_HIDDEN = 0.7
"""What a hidden stretch leaves of it."""
_REASSURANCE = 0.3
"""Share of its lead over the next best way that the price of a merge is less doubtful by."""
_STRAIN = 1.5
"""How much of the confidence is lost with each unit of doubt that is left of the price."""
_RUNS_ON = 0.55
"""Price of a merge below which an end might as well run on."""
_GAP, _GAP_SAMPLES = 0.85, 13
"""Least ||V|| between an end and the thread itself, against both, below which a gap is seen there."""
_GROUND = 0.5
"""The same of an end and another strand: in 400 starts beside other threads all eight ends before ground
were right, and six of the 31 others."""
_SEPARATE_PX = 4.2
"""Distance from which an end beside the thread itself is seen to end: nearer ones run into it."""
_PARALLEL = 0.7
"""Cosine of the angle up to which a strand that ends on the thread runs into it."""
_JOINS_PX = 8.0
"""How near to it such a strand ends: the thread draws its last points aside."""
_TOUCHING_PX = 6.0
"""Distance of an end from another one, or from a strand, up to which it touches that."""
_CLEAR, _LEAVES_PX = 0.4, 10.0
"""Strength of a strand at the thread's side or end, against the thread there, and how far away it leads, at
least: another thread may have another colour, and a shadow has a quarter of the strength."""
_SIDE, _AT = 40, 4
"""Points of the thread on each side of a place whose strength and colour count there, and those at the place
that have the colour of both strands."""


class Doubt(NamedTuple):
    """Where a thread may run another way."""

    place: Float64
    """(2,) pixel."""
    why: str
    rest: float
    """The confidence that this leaves."""


def doubts(joints: Joints, entries: list[int], ridges: Ridges) -> list[Doubt]:
    """What is doubtful about the thread that enters its segments at `entries`; `ridges` are those that
    were joined."""
    return [
        Doubt(inward(joints.segments, end)[0], why, rest)
        for end, why, rest in (
            *_at_merges(joints, entries),
            *((end, JOINED, _FOREIGN) for end in _mistakable(joints, entries, ridges)),
            *_at_tips(joints, entries, ridges),
        )
    ]


def _at_merges(joints: Joints, entries: list[int]) -> list[tuple[int, str, float]]:
    within = joints.within_reach()
    lengths = np.cumsum([len(joints.segments[entry // 2]) for entry in entries])
    found = []
    for entry, before in zip(entries[1:], lengths[:-1], strict=True):
        if entry in joints.hidden:
            found.append((entry, HIDDEN, _HIDDEN))
            continue
        price = joints.price[entry, joints.partner[entry]]
        lead = min(_lead(joints, entry, entries, within), FREE_END)
        strain = price - _REASSURANCE * lead
        # Without another way, all that is in doubt of a tip without a direction is where it ends.
        is_tip = lead >= FREE_END and min(before, lengths[-1] - before) < ARM
        if price >= HIGHEST:
            found.append((entry, SHARP, 0.6))
        elif strain > 0 and not is_tip:
            found.append((entry, CROSSING, max(1 - _STRAIN * strain, 0.1)))
        by_arms = joints.lead.get(entry, joints.lead.get(joints.partner[entry]))
        if by_arms is not None:
            found.append((entry, SHARED, float(expit(by_arms / ENERGY))))
        if entry in joints.bent:
            found.append((entry, BENT, _FOREIGN))
    return found


def _lead(joints: Joints, entry: int, entries: list[int], within: dict[int, list[int]]) -> float:
    """How much more the ends cost in total if another way is taken at `entry`."""
    other = joints.partner[entry]
    on_thread = {e // 2 for e in entries}
    added = [
        joints.swap(end, rival, within)[0]
        for end, partner in ((entry, other), (other, entry))
        for rival in within.get(end, ())
        if rival != partner
        and not (joints.original(rival) == joints.original(partner) and rival // 2 in on_thread)
    ]
    return max(min(added, default=1.0), 0.0)


def _mistakable(joints: Joints, entries: list[int], ridges: Ridges) -> list[int]:
    """The free ends of strands that run into the side of the thread and may be what goes on there."""
    line = np.concatenate([inward(joints.segments, entry) for entry in entries])
    return [
        end
        for end in joining(joints, entries, ridges)
        if ridges.tints is None or not _differs(inward(joints.segments, end), line, ridges.tints)
    ]


def _differs(strand: Float64, line: Float64, tints: Tints) -> bool:
    """Whether a strand, (k, 2) from its end on, differs in colour from both sides of the thread (m, 2) there,
    which are alike."""
    at = nearest_index(line, strand[0])
    sides = line[max(at - _SIDE, 0) : max(at - _AT, 0)], line[at + _AT : at + _SIDE]
    before, after, other = (tints.along(p) for p in (*sides, strand[_AT:_SIDE]))
    return difference(before, after) == 0 < min(difference(before, other), difference(after, other))


def joining(joints: Joints, entries: list[int], ridges: Ridges) -> list[int]:
    """The free ends of other strands, clear enough for threads, that run into its side."""
    own = {e // 2 for e in entries}
    pieces = [inward(joints.segments, e) for e in entries]
    line, tangents = np.concatenate(pieces), np.concatenate([chain_tangents(p) for p in pieces])
    strength, tree = ridges.sample(line), cKDTree(line)
    found = []
    for end in joints.free:
        if end // 2 in own:
            continue
        segment = inward(joints.segments, end)
        arm = segment[:ARM]
        distance, at = tree.query(arm[0])
        heading = chain_tangents(arm)[len(arm) // 2]
        if distance > _JOINS_PX or abs(float(heading @ tangents[at])) < _PARALLEL:
            continue
        strand = _strand(joints, end // 2, own)
        if np.max(tree.query(strand)[0]) < _LEAVES_PX:  # The rim of a highlight.
            continue
        sides = strength[max(at - _SIDE, 0) : at + 1], strength[at : at + _SIDE]
        level = min(float(np.median(side)) for side in sides)
        if np.median(ridges.sample(segment)) > _CLEAR * level:
            found.append(end)
    return found


def _strand(joints: Joints, segment: int, thread: set[int]) -> Float64:
    """(k, 2) points of the strand of a segment, without those of the thread."""
    entries = joints.follow(segment)
    return np.concatenate([joints.segments[e // 2] for e in entries if e // 2 not in thread])


def _at_tips(joints: Joints, entries: list[int], ridges: Ridges) -> list[tuple[int, str, float]]:
    within = joints.within_reach()
    found = []
    for tip in (entries[0], entries[-1] ^ 1):
        if _runs_into_another(joints, tip, entries, ridges):
            on = min((joints.price[tip, j] for j in within.get(tip, ())), default=np.inf)
            rest = 0.25 if on < _RUNS_ON else 0.4
            found.append((tip, "an end beside another ridge", rest))
        if is_beyond_gap(joints, tip, ridges):
            found.append((tip, BEYOND, _BEYOND))
    return found


def is_beyond_gap(joints: Joints, tip: int, ridges: Ridges) -> bool:
    """Whether the segment at a tip is shorter than a gap through which it is joined to the thread."""
    segment, start = inward(joints.segments, tip), joints.partner.get(tip ^ 1)
    if start is None:
        return False
    before, after = segment[-1], inward(joints.segments, start)[0]
    gap = float(np.linalg.norm(after - before))
    between = ridges.sample(np.linspace(before, after, _GAP_SAMPLES))
    is_unseen = between.min() < _UNSEEN * np.median(ridges.sample(segment))
    return bool(is_unseen and gap > _TOUCHING_PX and len(segment) < gap)


def _meets_strand(joints: Joints, tip: int, thread: set[int], ridges: Ridges) -> bool:
    """Whether a strand at a tip is clear, and leads far enough away, for the thread to go on as it, and no
    ground is seen between the two."""
    segment = inward(joints.segments, tip)
    end, level = segment[0], _CLEAR * float(np.median(ridges.sample(segment)))
    for k, other in enumerate(joints.segments):
        if k in thread:
            continue
        nearest = other[nearest_index(other, end)]
        is_near = np.linalg.norm(nearest - end) < _TOUCHING_PX
        if is_near and _lowest_between(ridges, end, nearest) > _GROUND:
            strand = _strand(joints, k, thread)
            leads_away = np.linalg.norm(strand - end, axis=1).max() > _LEAVES_PX
            if leads_away and np.median(ridges.sample(strand)) > level:
                return True
    return False


def _runs_into_another(joints: Joints, tip: int, entries: list[int], ridges: Ridges) -> bool:
    """Whether another ridge is at a tip, or, without a gap before it, the thread itself."""
    own = {e // 2 for e in entries}
    if _meets_strand(joints, tip, own, ridges):
        return True
    segment = inward(joints.segments, tip)
    end = segment[0]
    passing = [joints.segments[k] for k in own - {tip // 2}]
    passing.append(segment[2 * ARM :])
    points = np.concatenate(passing)
    if not len(points):
        return False
    nearest = points[nearest_index(points, end)]
    is_joined = _lowest_between(ridges, end, nearest) > _GAP
    return bool(np.linalg.norm(nearest - end) < _SEPARATE_PX and is_joined)


def _lowest_between(ridges: Ridges, one: Float64, other: Float64) -> float:
    """The least strength between two pixels (2,), against the lesser one of their own."""
    strength = ridges.sample(np.linspace(one, other, _GAP_SAMPLES))
    return float(strength.min() / max(min(strength[0], strength[-1]), 1e-9))

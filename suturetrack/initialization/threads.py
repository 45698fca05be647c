"""The thread in one view: its segments, from end to end, and what may be doubted about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from scipy.special import expit

from suturetrack.initialization.colours import another_begins, darkening
from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.doubts import (
    CROSSING,
    FADES,
    RECOLOURED,
    SHARED,
    TOUCHES,
    Doubt,
    doubts,
    is_beyond_gap,
    joining,
)
from suturetrack.initialization.joints import Joints, Way, inward
from suturetrack.initialization.segments import Ridges
from suturetrack.initialization.topology import merge_ends
from suturetrack.polylines import arc_lengths, nearest_index, polyline_distances, resample
from suturetrack.types import Float32, Float64, read_only

_FAINT = 0.4
"""Strength, against the rest of the thread, below which a last segment is no part of it."""
_SPECK = 8
"""Points below which one says nothing about where the thread goes on."""
_FALLEN = 0.42
"""Strength, against the rest of the thread, of what goes on behind its end at most."""
_FALL = 0.5
"""Ratio of the strengths behind and before such an end at most: threads fade more slowly."""
_STEP, _LOWER = 0.7, 0.85
"""That ratio and that share where a strand that ends on the thread may be what goes on."""
_IN_SHADE, _STEADY = 100, 0.2
"""Points of what has the colour of the thread, and goes on where it ends, from which it is the thread in the
shade, and by how much brighter or darker it may be all the same (of the logarithm)."""
_SHADED = 0.45
"""By how much darker the thread may be where its ground is."""
_CUT = {FADES: 0.49, RECOLOURED: 0.2}
"""What is left of the confidence in an end at which a vein goes on, or another thread: below that one it may
lie hidden."""
_SHORTEST_TAIL = 24
"""Points that go on so, at least: what is shorter may be the thread's own end, in the shade."""
_AS_CLEAR = 0.6
"""Strength of another strand, against the thread's, from which it might be meant as well."""
_AS_STRONG, NEXT_TO_NOTHING = 0.75, 0.1
"""Strength, and length, of other strands, against the thread's, from which a view shows more than it."""
_MEETS_PX, _BRIDGED_PX = 5.0, 12.0
"""By how much farther from a seed than the thread it may run there, and how far from there its segments end
at most."""
_LEAVES_PX, _AROUND_PX = 6.0, 60.0
"""How far away from the thread it leads, at least, and how far around the seed: what runs along the thread
for longer is a part of it that was doubled."""
_BESIDE_PX = 5
"""How far beside its crest a ridge shows."""
_ANOTHER_WAY_PX, _OWN_PX = 3.0, 1.5
"""How far from a path a chain goes that runs another way, and how near the path's own segments are."""
_SETTLED = CROSSING, SHARED
"""What is doubted about a contact until both views have told of it."""
_AT_CONTACT_PX = 15.0
"""How far from it."""
_CLEAR_LEAD, _DOUBTFUL_LEAD, _LEAD = 7.0, 3.0, 1.5
"""Energy by which strands have to fit together less well if exchanged for no doubt to be left, what halves
the confidence, and the unit: of 1,437 contacts above 7 one was wrong, of 56 from 2 to 7 nine, of 31 below 2
ten."""
_SIDE = 40
"""Points on each side of an end whose colour counts."""
_WINDOW, _STEP_POINTS = 10, 3
"""Points whose strength counts on each side of an end, and those about it that do not."""


@dataclass(frozen=True, eq=False)
class Chain:
    """A thread in one view, from end to end."""

    pixels: Float64
    """(k, 2) about one pixel apart."""
    doubts: tuple[Doubt, ...] = ()
    """Where the thread may run another way."""


@dataclass(frozen=True, eq=False)
class Thread:
    """Segments of one view that make a thread, from end to end."""

    ridges: Ridges
    """Of the view; segments that two strands share are doubled."""
    joints: Joints
    """Of all segments."""
    entries: list[int]
    """The end at which each segment is entered: 2i is the start of segment i, 2i + 1 its end."""
    origin: int
    """The segment that the seed lies on."""
    chain: Chain
    behind: Float64
    """(k, 2) pixels of what goes on behind the ends at which the chain was cut."""

    @cached_property
    def field(self) -> Float32:
        """(H, W, 2) that of the view, without what goes on behind the ends."""
        whole = self.ridges.field
        if not len(self.behind):
            return whole
        near = np.zeros(whole.shape[:2], bool)
        near[tuple(np.rint(self.behind[:, ::-1]).astype(int).T)] = True
        places = np.argwhere(binary_dilation(near, np.ones((3, 3), bool), _BESIDE_PX))
        behind, own = (
            cKDTree(p).query(places[:, ::-1])[0] for p in (self.behind, self.chain.pixels)
        )
        field = whole.copy()
        field[tuple(places[behind < own].T)] = 0
        return read_only(field)

    def exchanged(self, ways: list[tuple[Way, Way]], place: Float64) -> Thread:
        """The thread through the same place (2,), exchanged with another strand where both go on."""
        joints = self.joints
        for both in ways:
            joints = joints.exchanged(*both)
        parts = [self.origin, *range(len(self.joints.segments), len(joints.segments))]
        origin = min(parts, key=lambda k: np.linalg.norm(joints.segments[k] - place, axis=1).min())
        return _thread(replace(self.ridges, segments=tuple(joints.segments)), joints, origin)

    def told(self, contacts: list[tuple[Float64, float]]) -> Thread:
        """The thread with its doubts about contacts settled, by the pixels (k, 2) of each and the energy by
        which the strands would fit together less well if exchanged there."""
        doubts = list(self.chain.doubts)
        for pixels, lead in contacts:
            near = cKDTree(pixels)
            doubts = [
                doubt
                for doubt in doubts
                if doubt.why not in _SETTLED or near.query(doubt.place)[0] > _AT_CONTACT_PX
            ]
            if lead < _CLEAR_LEAD:
                rest = float(expit((lead - _DOUBTFUL_LEAD) / _LEAD))
                doubts.append(Doubt(pixels[len(pixels) // 2], TOUCHES, rest))
        return replace(self, chain=replace(self.chain, doubts=tuple(doubts)))

    @property
    def pieces(self) -> list[Float64]:
        """The segments in order, each run in the direction of the thread."""
        return [inward(self.ridges.segments, entry) for entry in self.entries]

    def others_along(self, path: Float64) -> list[Float64]:
        """The ridges of other strands, as clear as the thread's or shared with it, (m, 2) pixels each.

        Args:
            path: (k, 2) pixels of the thread; where the chain runs another way they are right.
        """
        segments = self.ridges.segments
        if polyline_distances(path, self.chain.pixels).max() < _ANOTHER_WAY_PX:
            return [segments[k] for k in self._others(_FAINT)]
        near = cKDTree(path)
        return [
            segments[k]
            for k in self._as_strong(_FAINT)
            if np.median(near.query(segments[k])[0]) > _OWN_PX
        ]

    def meets_another_at(self, place: Float64) -> bool:
        """Whether another strand that leads away runs as near by a pixel (2,) as the thread itself."""
        pixels, segments = self.chain.pixels, self.ridges.segments
        reach = np.linalg.norm(pixels - place, axis=1).min() + _MEETS_PX
        for k in self._others(_AS_CLEAR):
            if np.linalg.norm(segments[k] - place, axis=1).min() > reach + _BRIDGED_PX:
                continue
            entries = self.joints.follow(k)
            if not self._is_as_clear(entries):
                continue
            strand = _join([inward(segments, entry) for entry in entries])
            away = np.linalg.norm(strand - place, axis=1)
            around = strand[away < _AROUND_PX]
            if away.min() < reach and polyline_distances(around, pixels).max() > _LEAVES_PX:
                return True
        return False

    @property
    def is_all_there_is(self) -> bool:
        """Whether next to none of the ridges of the view that are as strong is left to other strands."""
        others = sum(len(self.ridges.segments[k]) for k in self._others(_AS_STRONG))
        return others <= NEXT_TO_NOTHING * len(self.chain.pixels)

    def _is_as_clear(self, entries: list[int]) -> bool:
        """Whether a strand that enters its segments there is as clear as the thread where it runs alone."""
        own = {self.joints.original(entry) // 2 for entry in self.entries}
        alone = [
            self.ridges.segments[entry // 2]
            for entry in entries
            if self.joints.original(entry) // 2 not in own
        ]
        if not alone:
            return False
        return bool(
            np.median(self.ridges.sample(np.concatenate(alone))) > _AS_CLEAR * self._strength
        )

    @property
    def _strength(self) -> float:
        return float(np.median(self.ridges.sample(self.chain.pixels)))

    def _others(self, strength: float) -> list[int]:
        """The segments that are no part of the thread, and have that share of its strength."""
        own = {e // 2 for e in self.entries}
        return [k for k in self._as_strong(strength) if k not in own]

    def _as_strong(self, strength: float) -> list[int]:
        """The segments that have that share of its strength."""
        return np.flatnonzero(self.ridges.strengths > strength * self._strength).tolist()


def follow_thread(
    ridges: Ridges, origin: int, config: InitializationConfig, depth: Depth | None = None
) -> Thread:
    """The merged segments through segment `origin`."""
    joints = merge_ends(ridges, config, depth)
    return _thread(replace(ridges, segments=tuple(joints.segments)), joints, origin)


def _thread(ridges: Ridges, joints: Joints, origin: int) -> Thread:
    """The thread through segment `origin` of those that were joined."""
    entries = _without_faint_ends(joints, ridges, joints.follow(origin), origin)
    line = _join([inward(ridges.segments, entry) for entry in entries])
    chain = Chain(line, tuple(doubts(joints, entries, ridges)))
    return Thread(ridges, joints, entries, origin, chain, np.empty((0, 2)))


def without_other_tails(thread: Thread, place: Float64) -> Thread:
    """The thread through `place` (2,), cut where its strength falls, or its colour changes, at once and for
    good: it ends there at a vein, or at another thread, that goes on in its direction."""
    chain, pixels = thread.chain, thread.chain.pixels
    near, met = nearest_index(pixels, place), _strands_met(thread)
    stop, why_stop = _stops_at(thread.ridges, pixels, near, met)
    # The same from the other end.
    count, why_start = _stops_at(thread.ridges, pixels[::-1], len(pixels) - 1 - near, met)
    start = len(pixels) - count
    if stop - start == len(pixels):
        return thread
    kept = pixels[start:stop]
    left = [d for d in chain.doubts if np.linalg.norm(kept - d.place, axis=1).min() < _WINDOW]
    cut = [(0, why_start)] * (start > 0) + [(-1, why_stop)] * (stop < len(pixels))
    left += [Doubt(kept[end], kind, _CUT[kind]) for end, kind in cut]
    behind = np.concatenate([pixels[:start], pixels[stop:]])
    return replace(thread, chain=Chain(kept, tuple(left)), behind=behind)


def _stops_at(
    ridges: Ridges, pixels: Float64, first: int, met: list[tuple[Float64, float]]
) -> tuple[int, str]:
    """Where behind the point `first` of a chain (k, 2) a vein, or a strand that the thread met before, goes
    on behind the end, and what tells so; k if nowhere."""
    strength = ridges.sample(pixels)
    stops = [_falls_at(strength, first, _FALL, _FALLEN)]
    own = float(np.median(strength))
    for place, level in met:
        at = nearest_index(pixels, place)
        if at > first:
            start = max(first, at - _WINDOW - _STEP_POINTS)
            # What goes on is that strand if it is more like that one than like the thread.
            fallen = min(_LOWER, float(np.sqrt(level / own)))
            stops.append(_falls_at(strength, start, _STEP, fallen))
    stop = min(stops)
    # The strength tells an end below another thread, too, the colour only where that begins to hide it.
    if stop < len(pixels) or ridges.tints is None:
        sides = pixels[:stop], pixels[stop:]
        is_shaded = stop == stops[0] and _goes_on_in_the_shade(ridges, *sides)
        is_own = is_shaded or _looks_the_same(ridges, *sides)
        return (len(pixels) if is_own else stop), FADES
    return another_begins(ridges.tints.along(pixels), first), RECOLOURED


def _looks_the_same(ridges: Ridges, before: Float64, behind: Float64) -> bool:
    """Whether what is fainter behind a place, (m, 2) pixels, has the colour and about the brightness of the
    thread (k, 2), near the place and as a whole: it is the thread, on a darker ground."""
    if ridges.tints is None:
        return False
    sides = [(before, behind), (before[-_SIDE:-_STEP_POINTS], behind[_STEP_POINTS:_SIDE])]
    steps = [darkening(*map(ridges.tints.along, pair)) for pair in sides]
    return all(-_STEADY < step < _SHADED for step in steps)


def _goes_on_in_the_shade(ridges: Ridges, before: Float64, behind: Float64) -> bool:
    """Whether what is fainter behind an end, (m, 2) pixels from there on, is the thread (k, 2) all the same:
    the light then falls no more than the contrast does, which falls with it or with its square."""
    if ridges.tints is None or len(behind) < _IN_SHADE:
        return False
    sides = before[-_SIDE:-_STEP_POINTS], behind[_STEP_POINTS:_IN_SHADE]
    lit, shaded = (float(np.median(ridges.sample(side))) for side in sides)
    darker = darkening(*map(ridges.tints.along, sides))
    fainter = np.log(max(lit, 1e-6) / max(shaded, 1e-6))
    return bool(-_STEADY < darker < _STEADY + max(fainter, 0.0))


def _strands_met(thread: Thread) -> list[tuple[Float64, float]]:
    """Where other strands end on the thread, and how strong they are."""
    joints, ridges = thread.joints, thread.ridges
    arms = [inward(joints.segments, end) for end in joining(joints, thread.entries, ridges)]
    return [(arm[0], float(np.median(ridges.sample(arm)))) for arm in arms]


def _falls_at(strength: Float64, first: int, fall_to: float, fallen: float) -> int:
    """Where behind the point `first` a chain falls at once to the share `fall_to` of its strength there, and
    for good to the share `fallen` of the whole; its length if nowhere."""
    aside = _WINDOW + _STEP_POINTS
    if len(strength) <= first + aside + _SHORTEST_TAIL:
        return len(strength)
    medians = np.median(sliding_window_view(strength, _WINDOW), axis=1)
    places = np.arange(first + aside, len(strength) - _SHORTEST_TAIL + 1)
    fall = medians[places + _STEP_POINTS] / np.maximum(medians[places - aside], 1e-9)
    for k in np.argsort(fall):
        place = int(places[k])
        if fall[k] > fall_to:
            break
        if np.median(strength[place:]) < fallen * np.median(strength[:place]):
            level = (medians[place - aside] + medians[place + _STEP_POINTS]) / 2
            above = np.cumsum(strength[place - aside : place + aside] - level)
            return place - aside + int(np.argmax(above)) + 1
    return len(strength)


def _without_faint_ends(
    joints: Joints, ridges: Ridges, entries: list[int], origin: int
) -> list[int]:
    """Leaves out segments at either end that are far fainter than the thread, such as shadows and veins,
    and specks behind gaps that are longer, such as rims of highlights."""
    segments = joints.segments
    strength = {e: ridges.sample(segments[e // 2]).mean() for e in entries}
    for leaves in (1, 0):
        while entries[-1] // 2 != origin:
            last, rest = entries[-1], entries[:-1]
            sizes = [len(segments[e // 2]) for e in rest]
            level = np.average([strength[e] for e in rest], weights=sizes)
            # In the second turn the thread is followed backwards, and left where its segments were entered.
            before, behind = [inward(segments, e ^ 1 ^ leaves) for e in rest], last ^ 1 ^ leaves
            is_faint = strength[last] <= _FAINT * level and not _goes_on_in_the_shade(
                ridges, np.concatenate(before), inward(segments, behind)
            )
            is_short = len(segments[last // 2]) < _SPECK
            if not (is_faint or (is_short and is_beyond_gap(joints, last ^ leaves, ridges))):
                break
            entries = rest
        entries = entries[::-1]
    return entries


def _join(pieces: list[Float64]) -> Float64:
    """(k, 2) pixels through all pieces, straight over the gaps between them, one pixel apart."""
    points = [pieces[0]]
    for a, b in pairwise(pieces):
        count = int(np.linalg.norm(b[0] - a[-1]))
        share = np.arange(1, count)[:, None] / max(count, 1)
        points += [a[-1] + share * (b[0] - a[-1]), b]
    line = np.concatenate(points)
    return resample(line, max(round(arc_lengths(line)[-1]), 1) + 1)

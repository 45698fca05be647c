"""Where the thread runs abreast of another strand, or of itself: which flank of the ridge that both make is
its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from suturetrack.initialization.crest import View
from suturetrack.initialization.flanks import NOWHERE, Flanks, look_beside
from suturetrack.initialization.smoothness import depth_energy, shape_energy
from suturetrack.polylines import Run, arc_lengths, runs_of
from suturetrack.types import Float32, Float64, Int64

_CONTEXT, _NEXT, _MOST_STRETCHES = 15, 8, 6
"""Samples around stretches by which these are judged, between two that are judged together, and how many
are at most."""
_SLACK = 4
"""By how many samples two stretches may be off that are beside each other."""
_LEAST_KNOWN = 6
"""Samples that say anything of a bend, or of depth, at least."""


def tell_apart(
    fields: tuple[Float32, Float32],
    pixels: Float64,
    others: tuple[Sequence[Float64], Sequence[Float64]],
) -> tuple[View, View]:
    """Both views, with the places of the thread beside other strands, and beside itself.

    Of each stretch in which a ridge is as wide as two strands, or is two ridges, the thread is taken to run
    along that side on which it bends least in both views and changes its disparity least. Where both strands
    are its own, they take a side each, the same in both views.

    Args:
        fields: left and right, (H, W, 2).
        pixels: (k, 4) left and right pixels along the thread, about 2 px apart; up to a few pixels off it
            where it runs abreast of another strand.
        others: of each view, the ridges of other strands, (m, 2) pixels each.
    """
    paths = pixels[:, :2], pixels[:, 2:]
    both = [look_beside(*view) for view in zip(fields, paths, others, strict=True)]
    left, right = (
        View(field, np.concatenate([NOWHERE, *strands]), flanks.told(side), flanks.blurred(side))
        for field, strands, flanks, side in zip(fields, others, both, _choose(both), strict=True)
    )
    return left, right


def _choose(both: list[Flanks]) -> list[Int64]:
    """(k,) on which side of another strand the thread runs in each view; 0 where there is none, or nothing
    tells."""
    sides = [-flanks.beside for flanks in both]
    for group in _groups(_stretches(both)):
        windows = _windows(group, len(sides[0]))
        ways = [_with(sides, group, way) for way in product((-1, 1), repeat=len(group))]
        sides = min(ways, key=lambda way: sum(_energy(both, way, window) for window in windows))
    return sides


@dataclass(frozen=True, eq=False)
class _Pass:
    """A stretch of one view in which the thread passes another strand, or itself."""

    view: int
    run: Run
    side: int
    """1, or -1 where it is on the other side than the first pass of its stretch."""


_Stretch = list[_Pass]
"""What is on one side or on the other together: a pass beside another strand, or both of a thread beside
itself, in one view or in two."""


def _stretches(both: list[Flanks]) -> list[_Stretch]:
    """Those of both views, in order along the thread."""
    found = _passes(both[0], 0)
    for stretch in _passes(both[1], 1):
        same = [other for other in found if _is_same(other, stretch)]
        if same:
            same[0].extend(stretch)
        else:
            found.append(stretch)
    return sorted(found, key=_first)


def _first(stretch: _Stretch) -> Run:
    """What it covers of the first pass along the thread."""
    first = min(each.run for each in stretch)
    return first[0], max(each.run[1] for each in stretch if each.run[0] < first[1])


def _is_same(one: _Stretch, other: _Stretch) -> bool:
    """Whether a thread runs beside itself at the same places of two views."""
    if not len(one) == len(other) == 2:
        return False
    runs = [(a.run, b.run) for a, b in zip(one, other, strict=True)]
    return all(min(a[1], b[1]) > max(a[0], b[0]) for a, b in runs)


def _passes(flanks: Flanks, view: int) -> list[_Stretch]:
    """The stretches of one view."""
    twins = {run: flanks.twin_of(run) for run in flanks.unknown}
    found = [[_Pass(view, run, 1)] for run, twin in twins.items() if twin is None]
    own = {run: twin for run, twin in twins.items() if twin is not None}
    while own:
        run, twin = own.popitem()
        off = {b: max(_outside(twin, b), _outside(there, run)) for b, there in own.items()}
        other = min(off, key=off.__getitem__, default=run)
        # Of a pass without its counterpart nothing is known.
        if off.get(other, np.inf) <= _SLACK:
            del own[other]
            one, two = (flanks.normals[sum(each) // 2] for each in (run, other))
            found.append([_Pass(view, other, 1), _Pass(view, run, -1 if one @ two > 0 else 1)])
    return found


def _outside(sample: int, run: Run) -> int:
    """By how many samples one lies outside of a stretch."""
    return max(run[0] - sample, sample - run[1] + 1, 0)


def _groups(stretches: list[_Stretch]) -> Iterator[list[_Stretch]]:
    """Stretches that are judged together."""
    group: list[_Stretch] = []
    for stretch in stretches:
        if group and (
            _first(stretch)[0] >= max(_first(before)[1] for before in group) + _NEXT
            or len(group) == _MOST_STRETCHES
        ):
            yield group
            group = []
        group.append(stretch)
    if group:
        yield group


def _windows(group: list[_Stretch], count: int) -> list[slice]:
    """The samples, of `count`, by which stretches are judged."""
    is_within = np.zeros(count, bool)
    for start, stop in (each.run for stretch in group for each in stretch):
        is_within[max(start - _CONTEXT, 0) : stop + _CONTEXT] = True
    return [slice(*run) for run in runs_of(is_within)]


def _with(sides: list[Int64], stretches: list[_Stretch], way: tuple[int, ...]) -> list[Int64]:
    """The sides, with those of some stretches."""
    sides = [side.copy() for side in sides]
    for stretch, side in zip(stretches, way, strict=True):
        for each in stretch:
            sides[each.view][slice(*each.run)] = side * each.side
    return sides


def _energy(both: list[Flanks], sides: list[Int64], window: slice) -> float:
    """How much the thread has to bend in both views, and to change its disparity, within a window."""
    energy = 0.0
    disparity, variance = np.zeros((2, *both[0].pixels[window, 0].shape))
    told = np.ones(len(disparity), bool)
    for flanks, side, sign in zip(both, sides, (1, -1), strict=True):
        across, noise = flanks.across(side)[window], flanks.noise(side)[window]
        pixels, normals = flanks.pixels[window], flanks.normals[window]
        known = np.isfinite(noise)
        if known.sum() >= _LEAST_KNOWN:
            places = (pixels + across[:, None] * normals)[known]
            energy += shape_energy(places, noise[known] ** 2)
        told &= known & flanks.tells_depth[window]
        # Along its row a line goes farther aside than across itself.
        slope = np.where(told, normals[:, 0], 1.0)
        disparity += sign * (pixels[:, 0] + across / slope)
        variance += (noise / slope) ** 2
    if told.sum() < _LEAST_KNOWN:
        return energy
    travelled = arc_lengths(both[0].pixels[window])
    return energy + depth_energy(travelled[told], disparity[told], variance[told])

"""Where the thread runs abreast of another strand: which flank of the ridge that both make is its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from suturetrack.initialization.crest import View, is_near
from suturetrack.initialization.smoothness import depth_energy, shape_energy
from suturetrack.kernels import search
from suturetrack.polylines import arc_lengths, polyline_tangents
from suturetrack.types import Bool, Float32, Float64, Int64

_EVERY = 2
"""Points of a path about 1 px apart from one sample to the next."""
_ACROSS = np.arange(-10.0, 10.01, 0.5)
"""Where ridges are looked at across the path, px."""
_NEAR_PX = 6.0
"""Distance up to which another strand lies beside the path."""
_ASIDE_PX, _ASIDE = 2.0, 0.6
"""How far aside it lies at least, and which share of its distance, for its side to be known."""
_LEAVES_PX, _ON_PX = 8.0, 1.0
"""Distance from the path that a strand reaches which leads away from it, and from that up to which a ridge is
its own."""
_TOGETHER_PX = 100.0
"""Length up to which two strands may run as one ridge between places where they are apart."""
_EXPECTED_PX = 2.0
"""How far from the path the thread's ridge is expected where it is alone (standard deviation)."""
_AS_CLEAR = 0.35
"""Height of a ridge, against the highest one beside the path, from which it may be the thread's."""
_FLANK = 0.3
"""Share of a ridge's height that its flank has."""
_LEAST_ALONE = 10
"""Samples of the thread alone that tell how wide it is."""
_ONE_PX, _TWO_PX, _APART_PX = 0.1, 0.8, 2.3
"""How much wider than one strand a ridge is at most that is one, at least that is two, and from where
these do not draw the flanks of each other."""
_DRAWN_PX, _UNDRAWN_PX = 0.45, 3.0
"""How far nearer strands do, and how much wider the ridge is where they do not at all."""
_APART_NOISE_PX, _DRAWN_NOISE_PX, _ALONE_NOISE_PX = 0.35, 0.6, 0.25
_CONTEXT, _NEXT, _MOST_RUNS = 15, 8, 6
"""Samples around stretches by which these are judged, between two that are judged together, and how many
are at most."""
_LEAST_WIDE = 2
"""Samples of such a stretch at least."""
_LEAST_KNOWN = 6
"""Samples that say anything of a bend, or of depth, at least."""
_NOWHERE: Float64 = np.empty((0, 2))
_LEAST_SLOPE = 0.25
"""Sine of the angle to the epipolar lines from which a place tells a disparity."""


def tell_apart(
    fields: tuple[Float32, Float32],
    pixels: Float64,
    others: tuple[Sequence[Float64], Sequence[Float64]],
) -> tuple[View, View]:
    """Both views, with the places of the thread beside other strands.

    Of each stretch in which a ridge is as wide as two strands, or is two ridges, the thread is taken to run
    along that side on which it bends least in both views and changes its disparity least.

    Args:
        fields: left and right, (H, W, 2).
        pixels: (k, 4) left and right pixels along the thread, about 1 px apart; up to a few pixels off it
            where it runs abreast of another strand.
        others: of each view, the ridges of other strands, (m, 2) pixels each.
    """
    paths = pixels[::_EVERY, :2], pixels[::_EVERY, 2:]
    both = [_look(*view) for view in zip(fields, paths, others, strict=True)]
    left, right = (
        View(field, np.concatenate([_NOWHERE, *strands]), flanks.told(side), flanks.blurred(side))
        for field, strands, flanks, side in zip(fields, others, both, _choose(both), strict=True)
    )
    return left, right


@dataclass(frozen=True, eq=False)
class _Flanks:
    """The ridges beside a path in one view."""

    pixels: Float64
    """(k, 2) along the path."""
    normals: Float64
    """(k, 2)."""
    places: Float64
    """(2, k) across the path, px: of a strand whose left, or right, flank is that of the ridges; NaN where
    nothing is seen."""
    wider: Float64
    """(k,) how much wider the ridges are than one strand, px."""
    beside: Int64
    """(k,) 1 or -1: side of another strand that leads away; 0 where there is none."""
    shared: Bool
    """(k,) where another strand may be in the ridge, on any side."""

    @classmethod
    def of_one_strand(cls, pixels: Float64, normals: Float64) -> _Flanks:
        """Beside a path (k, 2) that is right as it is."""
        k = len(pixels)
        return cls(
            pixels, normals, np.zeros((2, k)), np.zeros(k), np.zeros(k, np.int64), np.zeros(k, bool)
        )

    @property
    def tells_depth(self) -> Bool:
        """(k,) where the path does not run along the rows: there a little aside in one view is far off in
        depth, while another strand draws the crests of both views alike."""
        return np.abs(self.normals[:, 0]) > _LEAST_SLOPE

    def across(self, side: Int64) -> Float64:
        """(k,) place of the thread across the path where it runs on the left (-1) or on the right (1) of
        another strand, or alone (0), px."""
        left, right = self.places
        return np.select([side < 0, side > 0], [left, right], (left + right) / 2)

    def noise(self, side: Int64) -> Float64:
        """(k,) standard deviation of that, px; infinite where it is not known."""
        apart = (self.beside != 0) | (self.wider > _APART_PX)
        noise = np.where(apart, _APART_NOISE_PX, _DRAWN_NOISE_PX)
        noise[side == 0] = _ALONE_NOISE_PX
        unknown = (side == 0) & self.shared & ~(self.wider < _ONE_PX)
        return np.where(unknown | ~np.isfinite(self.across(side)), np.inf, noise)

    def told(self, side: Int64) -> Float64:
        """(m, 2) pixels of the thread beside another strand, but for those along the rows."""
        across = self.across(side)
        at = (side != 0) & np.isfinite(across) & self.tells_depth
        return self.pixels[at] + across[at, None] * self.normals[at]

    def blurred(self, side: Int64) -> Float64:
        """(m, 2) pixels of the path where nothing tells two strands apart, but for those along the rows."""
        may_be_two = (self.shared | (self.beside != 0)) & ~np.isfinite(self.noise(side))
        return self.pixels[may_be_two & self.tells_depth]

    def unknown(self) -> list[tuple[int, int]]:
        """The stretches in which the thread runs on either side of another strand."""
        wide = np.flatnonzero(
            np.diff(self.shared & (self.wider > _TWO_PX), prepend=False, append=False)
        )
        runs = wide.reshape(-1, 2).tolist()
        return [(start, stop) for start, stop in runs if stop - start >= _LEAST_WIDE]


def _look(field: Float32, path: Float64, others: Sequence[Float64]) -> _Flanks:
    pixels = gaussian_filter1d(path, 1.0, axis=0, mode="nearest")
    tangents = polyline_tangents(pixels)
    normals = np.c_[-tangents[:, 1], tangents[:, 0]]
    leading = _leading_away(pixels, others)
    beside, shared = _strands_beside(pixels, normals, others, leading)
    alone = ~shared & (beside == 0)
    if alone.all():
        return _Flanks.of_one_strand(pixels, normals)
    profiles = search.normal_profiles(field, pixels, tangents, _ACROSS, 0.0)
    tops = _tops(profiles)
    there = pixels[shared, None] + _ACROSS[:, None] * normals[shared, None]
    another = is_near(there.reshape(-1, 2), leading, _ON_PX).reshape(-1, len(_ACROSS))
    tops[shared] &= ~(another & (np.abs(_ACROSS) > _ASIDE_PX))
    edges = [_edges(*p) for p in zip(profiles, tops, shared.tolist(), strict=True)]
    left, right = np.array(edges, np.float64).T
    width: Float64 = (right - left)[alone]
    if np.isfinite(width).sum() < _LEAST_ALONE:
        return _Flanks.of_one_strand(pixels, normals)
    usual = float(np.nanmedian(width))
    wider = right - left - usual
    drawn = np.clip((_UNDRAWN_PX - wider) / (_UNDRAWN_PX - _APART_PX), 0, 1)
    aside = usual / 2 - _DRAWN_PX * np.where(shared & (wider > _TWO_PX), drawn, 0)
    return _Flanks(pixels, normals, np.array([left + aside, right - aside]), wider, beside, shared)


def _leading_away(pixels: Float64, others: Sequence[Float64]) -> Float64:
    """(m, 2) pixels on the ridges of strands that lead away from the path (k, 2)."""
    path = cKDTree(pixels)
    return np.concatenate(
        [_NOWHERE, *(piece for piece in others if np.max(path.query(piece)[0]) >= _LEAVES_PX)]
    )


def _strands_beside(
    pixels: Float64, normals: Float64, others: Sequence[Float64], leading: Float64
) -> tuple[Int64, Bool]:
    """(k,) `beside` and `shared` of `_Flanks`."""
    beside, shared = np.zeros(len(pixels), np.int64), np.zeros(len(pixels), bool)
    if len(leading):
        distance, nearest = map(np.asarray, cKDTree(leading).query(pixels))
        across = ((leading[nearest] - pixels) * normals).sum(1)
        is_aside = np.abs(across) > np.maximum(_ASIDE * distance, _ASIDE_PX)
        beside = np.where(is_aside & (distance < _NEAR_PX), np.sign(across), 0).astype(np.int64)
    near = np.flatnonzero(is_near(pixels, np.concatenate([_NOWHERE, *others]), _NEAR_PX))
    shared[near] = beside[near] == 0
    travelled = arc_lengths(pixels)[near]
    for k in np.flatnonzero(np.diff(travelled) <= _TOGETHER_PX):
        shared[near[k] + 1 : near[k + 1]] = True
    return beside, shared


def _tops(profiles: Float64) -> Bool:
    """(k, m) where (k, m) profiles have a ridge."""
    inner, tops = profiles[:, 1:-1], np.zeros(profiles.shape, bool)
    tops[:, 1:-1] = (inner >= profiles[:, :-2]) & (inner >= profiles[:, 2:]) & (inner > 0)
    return tops & (np.abs(_ACROSS) <= _NEAR_PX)


def _edges(profile: Float64, is_top: Bool, is_shared: bool) -> tuple[float, float]:
    """Where the left and the right flank of the ridge by the path are, or where that `is_shared` those of the
    outermost ridges, px; NaN where there are none."""
    tops = np.flatnonzero(is_top)
    if not len(tops):
        return np.nan, np.nan
    if is_shared:
        high = tops[profile[tops] > _AS_CLEAR * profile[tops].max()]
        return _edge(profile, high[0], -1), _edge(profile, high[-1], 1)
    top = tops[np.argmax(profile[tops] * np.exp(-0.5 * (_ACROSS[tops] / _EXPECTED_PX) ** 2))]
    return _edge(profile, top, -1), _edge(profile, top, 1)


def _edge(profile: Float64, top: int, way: int) -> float:
    """Where a ridge has fallen to the height of a flank, px; NaN where it rises again before."""
    level = _FLANK * profile[top]
    falling = profile[top:] if way > 0 else profile[top::-1]
    below = np.flatnonzero(falling <= level)
    if not len(below) or (np.diff(falling[: below[0] + 1]) > 0).any():
        return np.nan
    k = int(below[0])
    share = (falling[k - 1] - level) / (falling[k - 1] - falling[k])
    return float(_ACROSS[top] + way * 0.5 * (k - 1 + share))


def _choose(both: list[_Flanks]) -> list[Int64]:
    """(k,) on which side of another strand the thread runs in each view; 0 where there is none, or nothing
    tells."""
    sides = [-flanks.beside for flanks in both]
    runs = sorted((*run, view) for view, flanks in enumerate(both) for run in flanks.unknown())
    for group in _groups(runs):
        first, last = group[0][0], max(stop for _, stop, _ in group)
        window = slice(max(first - _CONTEXT, 0), last + _CONTEXT)
        ways = [_with(sides, group, way) for way in product((-1, 1), repeat=len(group))]
        sides = min(ways, key=lambda way: _energy(both, way, window))
    return sides


_Run = tuple[int, int, int]
"""First sample, that behind the last one, and view."""


def _groups(runs: list[_Run]) -> Iterator[list[_Run]]:
    """Stretches that are judged together."""
    group: list[_Run] = []
    for run in runs:
        if group and (
            run[0] >= max(stop for _, stop, _ in group) + _NEXT or len(group) == _MOST_RUNS
        ):
            yield group
            group = []
        group.append(run)
    if group:
        yield group


def _with(sides: list[Int64], runs: list[_Run], way: tuple[int, ...]) -> list[Int64]:
    """The sides, with those of some stretches."""
    sides = [side.copy() for side in sides]
    for (start, stop, view), side in zip(runs, way, strict=True):
        sides[view][start:stop] = side
    return sides


def _energy(both: list[_Flanks], sides: list[Int64], window: slice) -> float:
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

"""What a view shows beside a path on which the thread may run abreast of another strand, or of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from suturetrack.initialization.crest import is_near
from suturetrack.kernels import search
from suturetrack.polylines import Run, arc_lengths, polyline_tangents, runs_of
from suturetrack.types import Bool, Float32, Float64, Int64

_ACROSS = np.arange(-10.0, 10.01, 0.5)
"""Where ridges are looked at across the path, px."""
_NEAR_PX = 6.0
"""Distance up to which another strand lies beside the path."""
_ASIDE_PX, _ASIDE = 2.0, 0.6
"""How far aside it lies at least, and which share of its distance, for its side to be known."""
_LEAVES_PX, _ON_PX = 8.0, 1.0
"""Distance from the path that a strand reaches which leads away from it, and from that up to which a ridge is
its own."""
_BACK_PX = 25.0
"""Length of the path, at least, to where it comes back beside itself."""
_TOGETHER_PX = 100.0
"""Length up to which two strands may run as one ridge between places where they are apart."""
_EXPECTED_PX = 2.0
"""How far from the path the thread's ridge is expected where it is alone (standard deviation)."""
_AS_CLEAR = 0.2
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
_LEAST_WIDE, _LEAST_TWICE = 2, 4
"""Samples, at least, of a stretch beside another strand, and of one beside the thread itself."""
_LEAST_ALONG = 10
"""Samples, at least, for which a thread that runs beside itself does not only cross itself."""
NOWHERE: Float64 = np.empty((0, 2))
_LEAST_SLOPE = 0.25
"""Sine of the angle to the epipolar lines from which a place tells a disparity."""


@dataclass(frozen=True, eq=False)
class Flanks:
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
    twin: Int64
    """(k,) the sample that the path comes back beside; -1 where it does not."""

    @classmethod
    def of_one_strand(cls, pixels: Float64, normals: Float64) -> Flanks:
        """Beside a path (k, 2) that is right as it is."""
        k = len(pixels)
        nowhere, never, no_twin = np.zeros(k, np.int64), np.zeros(k, bool), np.full(k, -1)
        return cls(pixels, normals, np.zeros((2, k)), np.zeros(k), nowhere, never, no_twin)

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
        """(m, 3) pixels of the thread beside another strand, but for those along the rows, and the share of
        the path that lies before them."""
        across = self.across(side)
        at = (side != 0) & np.isfinite(across) & self.tells_depth
        share = np.linspace(0, 1, len(side))[at]
        return np.c_[self.pixels[at] + across[at, None] * self.normals[at], share]

    def blurred(self, side: Int64) -> Float64:
        """(m, 2) pixels of the path where nothing tells two strands apart, but for those along the rows."""
        may_be_two = (self.shared | (self.beside != 0)) & ~np.isfinite(self.noise(side))
        return self.pixels[may_be_two & self.tells_depth]

    @property
    def unknown(self) -> list[Run]:
        """The stretches in which the thread runs on either side of another strand, or of itself."""
        runs = runs_of(self.shared & (self.wider > _TWO_PX))
        return [
            run
            for run in runs
            if run[1] - run[0] >= (_LEAST_WIDE if self.twin_of(run) is None else _LEAST_TWICE)
        ]

    def twin_of(self, run: Run) -> int | None:
        """The sample beside which the path comes back to the middle of a stretch; None if it does not."""
        twins = self.twin[slice(*run)]
        return int(np.median(twins[twins >= 0])) if (twins >= 0).any() else None


def runs_beside_itself(path: Float64) -> bool:
    """Whether a path, (k, 2) pixels about 2 px apart, does, and not only crosses itself."""
    return any(stop - start >= _LEAST_ALONG for start, stop in runs_of(_twins(path) >= 0))


def look_beside(field: Float32, path: Float64, others: Sequence[Float64]) -> Flanks:
    """What a view shows beside a path.

    Args:
        field: (H, W, 2).
        path: (k, 2) pixels, about 2 px apart.
        others: the ridges of other strands, (m, 2) pixels each.
    """
    pixels = gaussian_filter1d(path, 1.0, axis=0, mode="nearest")
    tangents = polyline_tangents(pixels)
    normals = np.c_[-tangents[:, 1], tangents[:, 0]]
    leading = _leading_away(pixels, others)
    beside, shared = _strands_beside(pixels, normals, others, leading)
    twin = _twins(path)
    shared |= (twin >= 0) & (beside == 0)
    alone = ~shared & (beside == 0)
    if alone.all():
        return Flanks.of_one_strand(pixels, normals)
    profiles = search.normal_profiles(field, pixels, tangents, _ACROSS, 0.0)
    tops = _tops(profiles)
    there = pixels[shared, None] + _ACROSS[:, None] * normals[shared, None]
    another = is_near(there.reshape(-1, 2), leading, _ON_PX).reshape(-1, len(_ACROSS))
    tops[shared] &= ~(another & (np.abs(_ACROSS) > _ASIDE_PX))
    left, right = _edges(profiles, tops, shared)
    width: Float64 = (right - left)[alone]
    if np.isfinite(width).sum() < _LEAST_ALONE:
        return Flanks.of_one_strand(pixels, normals)
    usual = float(np.nanmedian(width))
    wider = right - left - usual
    drawn = np.clip((_UNDRAWN_PX - wider) / (_UNDRAWN_PX - _APART_PX), 0, 1)
    aside = usual / 2 - _DRAWN_PX * np.where(shared & (wider > _TWO_PX), drawn, 0)
    places = np.array([left + aside, right - aside])
    return Flanks(pixels, normals, places, wider, beside, shared, twin)


def _twins(path: Float64) -> Int64:
    """(k,) the nearest sample that a path (k, 2) comes back beside; -1 where it does not."""
    travelled, twin = arc_lengths(path), np.full(len(path), -1)
    pairs = cKDTree(path).query_pairs(_NEAR_PX, output_type="ndarray")
    pairs = pairs[travelled[pairs[:, 1]] - travelled[pairs[:, 0]] > _BACK_PX]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    apart = np.linalg.norm(path[pairs[:, 0]] - path[pairs[:, 1]], axis=1)
    one, other = pairs[np.argsort(-apart)].T
    twin[one] = other  # The nearest last.
    return twin


def _leading_away(pixels: Float64, others: Sequence[Float64]) -> Float64:
    """(m, 2) pixels on the ridges of strands that lead away from the path (k, 2)."""
    path = cKDTree(pixels)
    return np.concatenate(
        [NOWHERE, *(piece for piece in others if np.max(path.query(piece)[0]) >= _LEAVES_PX)]
    )


def _strands_beside(
    pixels: Float64, normals: Float64, others: Sequence[Float64], leading: Float64
) -> tuple[Int64, Bool]:
    """(k,) `beside` and `shared` of `Flanks`."""
    beside, shared = np.zeros(len(pixels), np.int64), np.zeros(len(pixels), bool)
    if len(leading):
        distance, nearest = map(np.asarray, cKDTree(leading).query(pixels))
        across = ((leading[nearest] - pixels) * normals).sum(1)
        is_aside = np.abs(across) > np.maximum(_ASIDE * distance, _ASIDE_PX)
        beside = np.where(is_aside & (distance < _NEAR_PX), np.sign(across), 0).astype(np.int64)
    near = np.flatnonzero(is_near(pixels, np.concatenate([NOWHERE, *others]), _NEAR_PX))
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


def _edges(profiles: Float64, tops: Bool, shared: Bool) -> tuple[Float64, Float64]:
    """(k,) where the left and the right flank of the ridge by the path are, or where samples are `shared`
    those of the outermost ridges, px; NaN where there are none."""
    heights = np.where(tops, profiles, 0)
    own = np.argmax(heights * np.exp(-0.5 * (_ACROSS / _EXPECTED_PX) ** 2), axis=1)
    high = tops & (profiles > _AS_CLEAR * heights.max(1, keepdims=True))
    turned, last = profiles[:, ::-1], len(_ACROSS) - 1
    left = -_edge(turned, last - np.where(shared, high.argmax(1), own))
    right = _edge(profiles, np.where(shared, last - high[:, ::-1].argmax(1), own))
    seen = tops.any(1)
    return np.where(seen, left, np.nan), np.where(seen, right, np.nan)


def _edge(profiles: Float64, top: Int64) -> Float64:
    """(k,) where ridges with their (k,) tops have fallen to the height of a flank on the right, px; NaN where
    they rise again before."""
    row, behind = np.arange(len(profiles)), np.arange(len(_ACROSS)) > top[:, None]
    level = _FLANK * profiles[row, top]
    below = behind & (profiles <= level[:, None])
    rises = np.diff(profiles, axis=1, prepend=np.inf) > 0
    k = below.argmax(1)
    falls = below.any(1) & ~(rises & behind & (np.arange(len(_ACROSS)) <= k[:, None])).any(1)
    before, after = profiles[row, k - 1], profiles[row, k]
    share = (before - level) / np.where(before > after, before - after, 1.0)
    return np.where(falls, _ACROSS[k - 1] + share * (_ACROSS[1] - _ACROSS[0]), np.nan)

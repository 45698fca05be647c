"""Ridges as segments: unbranched chains of sub-pixel points along the crest of ||V||."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.spatial import cKDTree

from suturetrack.initialization.colours import Tints
from suturetrack.initialization.config import InitializationConfig
from suturetrack.kernels import crest, search
from suturetrack.kernels.widths import moments
from suturetrack.polylines import nearest_index, polyline_tangents, unit
from suturetrack.types import Colours, Float32, Float64, Int64

ARM = 14
"""Points of a segment that tell where it is heading."""
_SHORTEST = 4
"""Points; what is shorter says nothing about direction."""
_NEAR_PX = 6.0
"""How near an end comes to the side of the segment that it runs into."""
_GLANCING = 0.3
"""Cosine of the angle below which an end runs into the side of a segment rather than along it."""
_HEADING = 6
"""Points at an end that tell where it runs into another segment."""
_CHORD = 3
"""Points to both sides of one at which the tangent is that of the chord."""
_KINK_REACH = 5
_KINK = 0.6
"""Cosine of the turn, over `_KINK_REACH` points to both sides, from which a segment has a kink."""
_TURN_REACH = 8
"""Points to both sides over which a segment turns as much that touches another one's kink."""
_WIDTH_REACH = 40
"""Points of a segment, on each side of the seed, whose width counts."""
_STEP_ACROSS = 0.5
_ACROSS = np.arange(-12.0, 12.01, _STEP_ACROSS)
_ACROSS_RIDGE = np.arange(-4.0, 4.01, _STEP_ACROSS)
_NARROW_PX = 1.33
"""How far from its crest the ridge of a narrow thread is half as high, px."""
_NOISE_QUANTILE = 0.9
_ABOVE_NOISE = 2.0
_MOST_CREST = 1 / 16
"""Share of the pixels on crests from which a field shows noise and nothing else: a dark image."""
_MOST_AT_ONCE = 32766
"""Places that OpenCV looks up in one call."""


@dataclass(frozen=True, eq=False)
class Ridges:
    """The ridges of one view."""

    field: Float32
    """(H, W, 2)."""
    magnitude: Float32
    """(H, W) ||V||."""
    segments: tuple[Float64, ...]
    """Each (k, 2) pixels."""
    low: float
    """||V|| below which a pixel is background."""
    tints: Tints | None = None
    """None where the images are gray."""

    @cached_property
    def strengths(self) -> Float64:
        """(n,) the median ||V|| of each segment."""
        return np.array([np.median(self.sample(segment)) for segment in self.segments])

    def sample(self, pixels: Float64) -> Float64:
        """(k,) ||V|| at (k, 2) pixels, bilinear, 0 outside."""
        return _bilinear(self.magnitude, pixels)

    def squared_width(self, pixels: Float64) -> float:
        """Of the ridge along (k, 2) pixels in order, px^2, in the median."""
        profiles = search.normal_profiles(
            self.field, pixels, polyline_tangents(pixels), _ACROSS_RIDGE, 0.0
        )
        return float(np.median(moments(profiles, np.tile(_ACROSS_RIDGE, (len(pixels), 1)))[1]))


def find_ridges(
    field: Float32, config: InitializationConfig, colours: Colours | None = None
) -> Ridges:
    """Crest lines of an (H, W, 2) field, split at junctions; weak and tiny ones are left out.

    A field of noise has none: thousands of them would keep whoever asks busy for minutes.
    """
    # cv2.magnitude would make the last bits depend on where the arrays lie in memory.
    magnitude = np.sqrt(field[..., 0] ** 2 + field[..., 1] ** 2)
    background = float(np.quantile(magnitude[::4, ::4], _NOISE_QUANTILE))
    low = float(np.clip(_ABOVE_NOISE * background, config.low / 4, config.low))
    mask = crest.crest_pixels(field, magnitude, low)
    crest.thin(mask, magnitude)
    pixels, starts = crest.trace_chains(mask)
    if not 0 < len(pixels) < _MOST_CREST * mask.size:
        return Ridges(field, magnitude, (), low)
    refined = _sub_pixel(field, magnitude, pixels)
    strength = magnitude[pixels[:, 1], pixels[:, 0]]
    segments = tuple(
        refined[a:b]
        for a, b in pairwise(starts)
        if b - a >= _SHORTEST and (b - a >= ARM or strength[a:b].max() >= config.high)
    )
    tints = None if colours is None else Tints.of(colours)
    return Ridges(field, magnitude, split_at_touches(segments), low, tints)


def nearest_segment(ridges: Ridges, seed: Float64, reach: float) -> tuple[int | None, Float64]:
    """The segment that a seed (2,) means, None if there is none within `reach`, and (k, 2) the
    nearest ridge points, one a segment."""
    nearest = [s[nearest_index(s, seed)] for s in ridges.segments]
    if not nearest:
        return None, np.empty((0, 2))
    distance = np.linalg.norm(np.array(nearest) - seed, axis=1)
    # Among ridges as near as the seed is exact, the long and clear one is meant.
    weight = [min(len(s), 40) / 40 * ridges.sample(s).mean() for s in ridges.segments]
    score = distance - 4 * np.array(weight)
    score[distance > reach] = np.inf
    candidates = np.array(nearest)[np.argsort(distance)[:3]]
    best = int(np.argmin(score))
    return (best if np.isfinite(score[best]) else None), candidates


def thread_scale(ridges: Ridges, seed: Float64) -> int:
    """How many times wider than a narrow thread the ridge nearest to the seed (2,) is, 1 at least."""
    segments = [s for s in ridges.segments if len(s) >= ARM]
    if not segments:
        return 1
    distances = [np.linalg.norm(s - seed, axis=1) for s in segments]
    nearest = int(np.argmin([d.min() for d in distances]))
    at = int(np.argmin(distances[nearest]))
    segment = segments[nearest][max(at - _WIDTH_REACH, 0) : at + _WIDTH_REACH]
    tangents = polyline_tangents(segment)
    profiles = search.normal_profiles(ridges.field, segment, tangents, _ACROSS, 0.0)
    profile = np.median(profiles, axis=0)
    middle = len(_ACROSS) // 2
    width = (_half_width(profile[middle:]) + _half_width(profile[middle::-1])) / 2
    return max(round(width / _NARROW_PX), 1)


def _half_width(profile: Float64) -> float:
    """Where a profile has fallen from its first value to half of that, px."""
    below = np.flatnonzero(profile < profile[0] / 2)
    if len(below) == 0:
        return _STEP_ACROSS * len(profile)
    k = int(below[0])
    over = (profile[k - 1] - profile[0] / 2) / max(profile[k - 1] - profile[k], 1e-9)
    return float(_STEP_ACROSS * (k - 1 + over))


def split_at_touches(segments: tuple[Float64, ...]) -> tuple[Float64, ...]:
    """Cuts segments at junctions that the crest lines do not show as such: where the end of another
    runs into their side at a small angle, so that what two strands share becomes a segment of its
    own, and where they turn from one strand into another, as both do that touch there."""
    if not segments:
        return ()
    near = _Neighbourhood(segments)
    cuts: dict[int, set[int]] = {}
    for k, segment in enumerate(segments):
        for reverse, at in ((segment, 0), (segment[::-1], len(segment) - 1)):
            hit = near.side_hit(k, at, reverse[: _HEADING + 1])
            if hit is not None:
                cuts.setdefault(hit[0], set()).add(hit[1])
        for i in _kinks(segment):
            others = near.others(k, i, segment[i])
            if len(others):
                cuts.setdefault(k, set()).add(i)
                owner, j = near.nearest(others, segment[i])
                if _turns(segments[owner], j):
                    cuts.setdefault(owner, set()).add(j)
    return tuple(
        piece
        for k, s in enumerate(segments)
        for piece in np.split(s, _apart(sorted(cuts.get(k, ()))))
        if len(piece) >= _SHORTEST
    )


class _Neighbourhood:
    """Which points of which segments are near a place."""

    def __init__(self, segments: tuple[Float64, ...]) -> None:
        self._segments = segments
        self._points = np.concatenate(segments)
        self._owner = np.repeat(np.arange(len(segments)), [len(s) for s in segments])
        self._index = np.concatenate([np.arange(len(s)) for s in segments])
        self._tree = cKDTree(self._points)

    def others(self, k: int, at: int, place: Float64) -> Int64:
        """Points near `place` that lie on another segment than `k`, or far from `at` on it."""
        near = np.array(self._tree.query_ball_point(place, _NEAR_PX), dtype=np.int64)
        apart = (self._owner[near] != k) | (abs(self._index[near] - at) > 2 * ARM)
        return near[apart]

    def nearest(self, near: Int64, place: Float64) -> tuple[int, int]:
        """The segment, and where on it, of that of some points that is nearest to a place."""
        hit = near[nearest_index(self._points[near], place)]
        return int(self._owner[hit]), int(self._index[hit])

    def side_hit(self, k: int, at: int, arm: Float64) -> tuple[int, int] | None:
        """The segment, and where on it, that the end of segment `k` runs into along its side."""
        heading = arm[0] - arm[-1]
        heading = heading / max(float(np.linalg.norm(heading)), 1e-9)
        near = self.others(k, at, arm[0] + 2 * heading)
        if len(near) == 0:
            return None
        owner, i = self.nearest(near, arm[0])
        other = self._segments[owner]
        if min(i, len(other) - 1 - i) < _NEAR_PX:
            return None
        along = other[min(i + 4, len(other) - 1)] - other[max(i - 4, 0)]
        glancing = abs(along @ heading) > _GLANCING * np.linalg.norm(along)
        return (owner, i) if glancing else None


def _kinks(segment: Float64) -> list[int]:
    """Where a segment turns sharply, the sharpest place of each turn."""
    if len(segment) <= 2 * _KINK_REACH:
        return []
    steps = unit(segment[_KINK_REACH:] - segment[:-_KINK_REACH])
    cosine = (steps[:-_KINK_REACH] * steps[_KINK_REACH:]).sum(1)
    kinks = np.flatnonzero(
        (cosine < _KINK) & (cosine <= minimum_filter1d(cosine, 2 * _KINK_REACH + 1))
    )
    return (kinks + _KINK_REACH).tolist()


def _turns(segment: Float64, i: int) -> bool:
    """Whether a segment turns at its point `i` as much as a kink does."""
    if not _TURN_REACH <= i < len(segment) - _TURN_REACH:
        return False
    before = segment[i] - segment[i - _TURN_REACH]
    after = segment[i + _TURN_REACH] - segment[i]
    return bool(before @ after < _KINK * np.linalg.norm(before) * np.linalg.norm(after))


def _apart(cuts: list[int]) -> list[int]:
    return [c for i, c in enumerate(cuts) if i == 0 or c - cuts[i - 1] > _NEAR_PX]


def chain_tangents(pixels: Float64) -> Float64:
    """(k, 2) unit tangents of a chain with points one pixel apart."""
    ahead = pixels[np.minimum(np.arange(len(pixels)) + _CHORD, len(pixels) - 1)]
    behind = pixels[np.maximum(np.arange(len(pixels)) - _CHORD, 0)]
    return unit(ahead - behind)


def _sub_pixel(field: Float32, magnitude: Float32, pixels: Int64) -> Float64:
    """Moves (k, 2) pixels along the normal to the vertex of the parabola through three values of ||V||."""
    v = field[pixels[:, 1], pixels[:, 0]]
    centre = magnitude[pixels[:, 1], pixels[:, 0]].astype(float)
    normals = np.c_[-v[:, 1], v[:, 0]] / centre[:, None]
    before, after = (_bilinear(magnitude, pixels + side * normals) for side in (-1, 1))
    bend = before + after - 2 * centre
    shift = np.where(bend < 0, (before - after) / np.where(bend < 0, 2 * bend, 1), 0)
    return pixels + np.clip(shift, -1, 1)[:, None] * normals


def _bilinear(magnitude: Float32, pixels: Float64) -> Float64:
    """(k,) values at (k, 2) pixels, 0 outside."""
    if len(pixels) == 0:
        return np.empty(0)
    maps = np.asarray(pixels, np.float32).reshape(-1, 1, 2)
    pieces = [
        cv2.remap(magnitude, maps[i : i + _MOST_AT_ONCE], None, cv2.INTER_LINEAR)
        for i in range(0, len(maps), _MOST_AT_ONCE)
    ]
    return np.concatenate(pieces).ravel().astype(float)

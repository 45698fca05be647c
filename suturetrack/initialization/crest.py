"""Where the field shows the thread's centre beside a curve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.kernels import search
from suturetrack.kernels.widths import moments, single
from suturetrack.polylines import arc_lengths, polyline_tangents
from suturetrack.types import Bool, Float32, Float64

_OFFSETS = np.arange(-4.0, 4.01, 0.5)
"""Where the crest is looked for across the curve, px."""
_NEAR_PX = 2.0
"""How far the crest is expected from the curve, px (standard deviation)."""
_CENTROID_REACH = 4
"""Offsets on each side of the peak whose centroid is the crest."""
_ASIDE_PX = 5.0
"""Distance up to which another strand draws a crest aside."""
_DRAWN = 0.1
"""How much such a crest counts."""
_BLURRED_PX, _BESIDE_PX, _FARTHEST_PX = 2.5, 1.6, 8.0
"""How far a curve may be from a pixel that is blurred, and along and across itself from one that is told."""
_ALONG_PX = 100.0
"""How far off a place counts that is as near, but on another strand, the whole length of the thread away."""
_ITSELF_PX = 11.0
"""Length of a curve between two places that near, from which it comes back beside itself there."""


@dataclass(frozen=True, eq=False)
class View:
    """Where the crests of a thread are looked for, and near what they are not to be believed."""

    field: Float32
    """(H, W, 2)."""
    others: Float64
    """(k, 2) pixels on the ridges of other strands, about 1 px apart."""
    told: Float64
    """(k, 3) pixels of the thread beside other strands, or itself, as the flanks of the ridges tell them, and
    the share of its length that lies before them."""
    blurred: Float64
    """(k, 2) pixels near which the ridge may be that of several strands, and nothing tells them apart."""

    def clear(self, pixels: Float64) -> Float64:
        """(k,) in [0, 1]: low where another strand draws the crest at (k, 2) pixels aside."""
        aside = is_near(pixels, self.others, _ASIDE_PX) | is_near(pixels, self.blurred, _BLURRED_PX)
        return np.where(aside, _DRAWN, 1.0)

    @cached_property
    def _told(self) -> cKDTree:
        return cKDTree(self.told * (1, 1, _ALONG_PX))

    def told_beside(self, pixels: Float64, normals: Float64) -> Float64:
        """(k,) signed distance from (k, 2) pixels to where the thread is told along (k, 2) normals, px; NaN
        where it is not."""
        if not len(self.told):
            return np.full(len(pixels), np.nan)
        # What is told of one strand of the thread does not tell of another.
        here = np.c_[pixels, np.linspace(0, _ALONG_PX, len(pixels))]
        _, nearest = self._told.query(here)
        there = self.told[nearest, :2] - pixels
        across = (there * normals).sum(1)
        along = np.linalg.norm(there - across[:, None] * normals, axis=1)
        return np.where((along < _BESIDE_PX) & (np.abs(across) < _FARTHEST_PX), across, np.nan)


@dataclass(frozen=True, eq=False)
class Crest:
    """Where one view shows the crest beside the samples of a curve."""

    normals: Float64
    """(k, 2) unit normals of the projected curve."""
    offsets: Float64
    """(k,) signed distance from the curve to the crest along the normal, px; 0 where it is unseen."""
    response: Float64
    """(k,) eq. (4)'s integrand at the crest, in [0, 1]; 0 where it is unseen."""
    clear: Float64
    """(k,) in [0, 1]; low where the ridge is wider than elsewhere, or near that of another strand, or where
    the curve comes back beside itself, which draws the crest aside."""

    @property
    def trust(self) -> Float64:
        """(k,) weights of the offsets: crests far off are more often another's."""
        return self.clear * self.response / (1 + self.offsets**2)


def find_crest(view: View, pixels: Float64) -> Crest:
    """Looks for the crest across (k, 2) evenly spaced pixels of a projected curve."""
    tangents = polyline_tangents(pixels)
    profiles = search.normal_profiles(view.field, pixels, tangents, _OFFSETS, 0.0)
    expected = profiles * np.exp(-0.5 * (_OFFSETS / _NEAR_PX) ** 2)
    peak = np.argmax(expected, axis=1)
    around = np.arange(-_CENTROID_REACH, _CENTROID_REACH + 1)
    index = np.clip(peak[:, None] + around, 0, len(_OFFSETS) - 1)
    window = np.take_along_axis(profiles, index, 1)
    seen = (peak > 0) & (peak < len(_OFFSETS) - 1) & (np.ptp(window, axis=1) > 0)
    offsets, spread = moments(window, _OFFSETS[index])
    usual = float(np.median(spread[seen])) if seen.any() else 1.0
    heights = np.take_along_axis(profiles, peak[:, None], 1)[:, 0]
    normals = np.c_[-tangents[:, 1], tangents[:, 0]]
    clear = single(spread, usual) * np.minimum(view.clear(pixels), _clear_of_itself(pixels))
    told = view.told_beside(pixels, normals)
    is_told = np.isfinite(told)
    if is_told.any() and seen.any():
        offsets, clear = np.where(is_told, told, offsets), np.where(is_told, _DRAWN, clear)
        heights = np.where(is_told, np.median(heights[seen]), heights)
        seen |= is_told
    return Crest(normals, np.where(seen, offsets, 0.0), np.where(seen, heights, 0.0), clear)


def is_near(pixels: Float64, places: Float64, reach: float) -> Bool:
    """(k,) whether (k, 2) pixels are within reach of some of (m, 2) places."""
    if not len(places):
        return np.zeros(len(pixels), bool)
    return np.isfinite(cKDTree(places).query(pixels, distance_upper_bound=reach)[0])


def _clear_of_itself(pixels: Float64) -> Float64:
    """(k,) in [0, 1]: low where the curve through (k, 2) pixels comes back beside itself."""
    near = cKDTree(pixels).query_pairs(_ASIDE_PX, output_type="ndarray")
    travelled = arc_lengths(pixels)
    back = near[travelled[near[:, 1]] - travelled[near[:, 0]] > _ITSELF_PX]
    clear = np.ones(len(pixels))
    clear[back] = _DRAWN
    return clear

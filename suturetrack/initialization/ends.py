"""Where a thread ends: the step of the ridge response along its extension."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.kernels import search, widths
from suturetrack.polylines import arc_lengths, polyline_at, polyline_tangents
from suturetrack.types import Float32, Float64

_INSIDE_PX = 14.0
_OUTSIDE_PX = 8.0
_STEP_PX = 0.25
_END_LEVEL = 0.4
"""Share of the response inside at which the thread ends; measured on rendered threads of several
widths, where it lies within 0.4 px of the true end."""
_STAYS_PX = 3.0
"""How long the response has to stay below, so that a highlight does not end the thread."""
_BESIDE = np.arange(-1.0, 1.01, 0.5)
_ACROSS = np.arange(-4.0, 4.01, 0.5)
"""Where the ridge is looked at across itself, px."""
_ALONE_PX = (-24.0, -4.0)
"""Where the ridge is as wide as the thread alone, px beyond the end."""
_HOLE_PX = 4.0
"""How far a ridge may run on as something wider that the thread goes into."""
_BORDER_PX = 3.0


@dataclass(frozen=True)
class EndReading:
    """Where one view shows the end of a thread."""

    offset_px: float
    """How far the thread runs on past the end of the curve; negative where the curve is too long;
    nan where the view does not tell."""
    at_border: bool
    """Whether the image ends before the thread does."""


def read_end(field: Float32, pixels: Float64) -> EndReading:
    """Reads the end of a thread at the start of (k, 2) pixels that run inwards, about 1 px apart."""
    travelled = arc_lengths(pixels)
    outward = pixels[0] - pixels[np.searchsorted(travelled, min(4.0, travelled[-1] / 2))]
    outward /= max(float(np.linalg.norm(outward)), 1e-9)
    x = np.arange(-min(_INSIDE_PX, travelled[-1]), _OUTSIDE_PX, _STEP_PX)
    places = np.where(x[:, None] <= 0, polyline_at(pixels, -x), pixels[0] + x[:, None] * outward)
    tangents = polyline_tangents(places)
    response = search.normal_profiles(field, places, tangents, _BESIDE, 0.0).max(1)
    inside = response[x < -4]
    level = _END_LEVEL * float(np.median(inside)) if len(inside) else 0.0
    run = int(_STAYS_PX / _STEP_PX)
    later = np.convolve(response, np.ones(run) / run)[run - 1 :]
    below = np.flatnonzero((response < level) & (later < level) & (x > -_INSIDE_PX + 4))
    if level <= 0 or len(below) == 0:
        return EndReading(np.nan, _leaves(pixels[0] + _OUTSIDE_PX * outward, field))
    offset = _falls_below(x, response, int(below[0]), level)
    narrow = response * narrowness(field, places, tangents, x)
    offset = before_a_hole(widens_at(x, narrow, level), offset)
    if _leaves(pixels[0] + offset * outward, field):
        return EndReading(np.nan, True)
    return EndReading(offset, False)


def narrowness(field: Float32, pixels: Float64, tangents: Float64, x: Float64) -> Float64:
    """(k,) in [0, 1]: low where the ridge is wider than that of the thread.

    Args:
        field: (H, W, 2).
        pixels: (k, 2) along the thread and its extension.
        tangents: (k, 2), unit.
        x: (k,) px beyond the end.
    """
    inner, outer = _ALONE_PX
    return widths.narrowness(field, pixels, tangents, _ACROSS, (x >= inner) & (x < outer))


def widens_at(x: Float64, narrow: Float64, level: float) -> float:
    """Where the ridge becomes wider than the thread for good, or ends; infinite beyond `x`.

    Args:
        x: (k,) px along the thread and beyond it, evenly spaced.
        narrow: (k,) responses, low where the ridge is wider than the thread.
        level: response at which the thread ends.
    """
    shown = np.flatnonzero(narrow >= level)
    if len(shown) == 0:
        return -np.inf
    if shown[-1] + 1 == len(x):
        return np.inf
    return _falls_below(x, narrow, int(shown[-1]) + 1, level)


def before_a_hole(widens: float, end: float) -> float:
    """The end of all of the ridge, or where it `widens` just before: the thread goes into something."""
    return widens if end - _HOLE_PX <= widens < end else end


def _falls_below(x: Float64, response: Float64, k: int, level: float) -> float:
    """Where the response falls to the level, just before the place `k` of an even `x`."""
    drop = max(float(response[k - 1] - response[k]), 1e-9)
    return float(x[k] - (x[1] - x[0]) * (level - response[k]) / drop)


def move_end(pixels: Float64, offset_px: float) -> Float64:
    """The chain with its start moved outwards along itself.

    Args:
        pixels: (k, dim) of which the first two columns are pixels about 1 px apart.
        offset_px: how far; inwards where negative.
    """
    travelled = arc_lengths(pixels[:, :2])
    if offset_px <= 0:
        first = np.array([[np.interp(-offset_px, travelled, c) for c in pixels.T]])
        return np.r_[first, pixels[travelled > -offset_px + 0.5]]
    near = min(4, len(pixels) - 1)
    outward = (pixels[0] - pixels[near]) / max(float(travelled[near]), 1e-9)
    steps = np.arange(offset_px, 0.5, -1.0)
    return np.r_[pixels[0] + steps[:, None] * outward, pixels]


def _leaves(pixel: Float64, field: Float32) -> bool:
    height, width = field.shape[:2]
    inside = _BORDER_PX < pixel[0] < width - 1 - _BORDER_PX
    return not (inside and _BORDER_PX < pixel[1] < height - 1 - _BORDER_PX)

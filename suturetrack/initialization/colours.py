"""The colour of a thread, by which another one is told from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from suturetrack.types import Colours, Float64, Int64, UInt16

_AXES = np.array([[1, -0.5, -0.5], [0, -(0.75**0.5), 0.75**0.5], [3**-0.5] * 3])
"""Of the logarithms of blue, green and red: two differences, which the light leaves alone, and the
brightness."""
_DARK = 6.0
"""Grey levels by which darkness is lifted: its logarithm would be all noise."""
_WITHIN = np.array([0.08, 0.08, 0.35])
"""By how much the tints of two arms of one thread differ (standard deviation)."""
_COMMON = 8.0
"""Energy that differences within one thread hardly exceed: up to there they say nothing."""
_ALIKE = 0.16
"""Difference of each of the two that light leaves alone, up to which arms are alike."""
_SHORTEST_ARM = 8
"""Points that tell the tint of an arm, at least."""
_STEADY = np.array([0.04, 0.04, 0.15])
"""By how much the tint of a thread changes within a few points, at least."""
_WINDOW, _GAP = 22, 3
"""Points on each side of a change that tell it, and those about it that do not."""
_SURELY, _FEWEST = 4.4, 20
"""How large a change is, against those of the chain so far, of which there are so many at least."""
_APART = 6.75
"""Energy by which the parts before and behind a change differ at least: 4.2 to 5.7 in four views of a thread
over another ground, 7.9 in two of a vein behind its end, 25 and more where another thread goes on."""
_OTHER = 0.4
"""Share of a change by which all that follows is nearer to it than what came before."""
_SHORTEST, _LEAST_SHARE = 40, 0.13
"""Points, and share of the chain, that go on in another colour at least: a thread darkens where it goes into
a hole."""


@dataclass(frozen=True, eq=False)
class Tints:
    """The colours of a view's ridges as light and shade leave them alone, but for the last number."""

    _keys: Int64
    """(k,) of the pixels, in order."""
    _values: Float64
    """(k, 3)."""

    @classmethod
    def of(cls, colours: Colours) -> Tints:
        """Of all pixels that look like thread."""
        return cls(_key(colours.pixels), np.log(colours.bgr + _DARK) @ _AXES.T)

    def along(self, pixels: Float64) -> Float64:
        """(n, 3) at (n, 2) pixels; where nothing is known what is known before or, at the start, next.

        All nan where nothing is known at all.
        """
        wanted = _key(np.rint(np.maximum(pixels, 0)).astype(np.uint16))
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
        known = self._keys[at] == wanted if len(self._keys) else np.zeros(len(wanted), bool)
        if not known.any():
            return np.full((len(wanted), 3), np.nan)
        last = np.maximum.accumulate(np.where(known, np.arange(len(wanted)), -1))
        return self._values[at[np.where(last < 0, np.argmax(known), last)]]


def difference(one: Float64, other: Float64) -> float:
    """Energy of the difference between the tints of two arms, (k, 3) and (m, 3), beyond what is common in one
    thread; 0 where one is not known."""
    if min(len(one), len(other)) < _SHORTEST_ARM:
        return 0.0
    energy = _energy(one, other) - _COMMON
    return max(energy, 0.0) if np.isfinite(energy) else 0.0


def _energy(one: Float64, other: Float64) -> float:
    """Of the difference between tints (k, 3) and (m, 3); nan where one is not known."""
    step = (np.median(one, axis=0) - np.median(other, axis=0)) / _WITHIN
    return 0.5 * float(step @ step)


def darkening(one: Float64, other: Float64) -> float:
    """By how much the logarithm of the brightness is less in the second of two arms, tints (k, 3) and (m, 3);
    nan where it is not known, or the arms differ in more than that."""
    if min(len(one), len(other)) < _SHORTEST_ARM:
        return np.nan
    step = np.median(one, axis=0) - np.median(other, axis=0)
    return float(step[-1]) if np.all(abs(step[:-1]) < _ALIKE) else np.nan


def another_begins(tints: Float64, first: int) -> int:
    """Where behind the point `first` a chain, of tints (n, 3), goes on in another colour for good; n if
    nowhere."""
    count = len(tints)
    tail = max(_SHORTEST, round(_LEAST_SHARE * count))
    places = np.arange(_WINDOW + _GAP, count - tail)
    if len(places) == 0 or not np.isfinite(tints).all():
        return count
    middle = np.median(sliding_window_view(tints, _WINDOW, axis=0), axis=-1)
    steps = middle[places + _GAP] - middle[places - _GAP - _WINDOW]
    so_far = np.cumsum(steps[:, :, None] * steps[:, None], axis=0)
    so_far /= np.arange(1, len(places) + 1)[:, None, None]
    usual = np.arange(len(places)) - 2 * _WINDOW - 1
    told = np.flatnonzero((usual >= _FEWEST) & (places >= first + _WINDOW))
    precision = np.linalg.inv(so_far[usual[told]] + np.diag(_STEADY**2))
    size = np.einsum("ni,nij,nj->n", steps[told], precision, steps[told])
    for k in np.argsort(-size):
        if size[k] < _SURELY**2:
            break
        place, towards = int(places[told[k]]), precision[k] @ steps[told[k]] / size[k]
        if _is_for_good(tints, middle, place, towards):
            start = _where(tints, middle, place, towards)
            return start if _energy(tints[:start], tints[start:]) > _APART else count
    return count


def _is_for_good(tints: Float64, middle: Float64, place: int, towards: Float64) -> bool:
    """Whether all behind a place is like what begins there, and the whole before it is not."""
    before = middle[place - _GAP - _WINDOW]
    whole = float((np.median(tints[: place - _GAP], axis=0) - before) @ towards)
    behind = (middle[place + _GAP :] - before) @ towards
    return whole < _OTHER and float(behind.min()) > max(whole, 0.0) + _OTHER


def _where(tints: Float64, middle: Float64, place: int, towards: Float64) -> int:
    """The point near a place from which on most are nearer to what goes on."""
    start = place - _GAP - _WINDOW
    share = (tints[start : place + _GAP + _WINDOW] - middle[start]) @ towards
    return start + int(np.argmax(np.cumsum(0.5 - share))) + 1


def _key(pixels: UInt16) -> Int64:
    return pixels[:, 1].astype(np.int64) << 16 | pixels[:, 0]

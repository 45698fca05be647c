"""Bends that a thread never had: there the curve follows something else."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import binary_dilation, label, maximum_filter1d, median_filter

from suturetrack.camera import StereoRig
from suturetrack.tracking.reliability import EVENLY, Evidence
from suturetrack.tracking.sampling import length_of, values_at
from suturetrack.types import Bool, Float64, Nurbs

# Samples that a chord spans, and by how many a bend slides along the curve.
_CHORD, _SLIDES = 2, 3
# By how much more sharply than of late a thread bends, radians, and as a share.
_SHARPER, _TIGHTER = math.radians(7.0), 0.25
_OF_LATE_S = 1.0
# How near to it something is unseen, samples.
_NEAR = 4
# How many times more sharply it bends than either view shows, by so many standard deviations.
_IN_DEPTH, _SIGMAS = 2.0, 2.0
# Samples at an end, which a gripper may bend at once.
_TIP = 5
# Disparity by which a stretch springs aside between two fields, px and against what most of the curve does,
# and how far around it is looked, samples.
_SPRING_PX, _ABOVE_MOST, _MOST_PERCENT, _AROUND = 1.2, 6.0, 80, 8
# How much less its disparity bends if it springs back; and if it was held where it is before.
_BACK, _BACK_FROM_HELD = 0.85, 0.4


class Bends:
    """How sharply a thread has bent of late.

    A thread is stiff: it bends more sharply little by little, even as a knot is tightened. A curve that
    has got a kink at once where a part of it is hidden has been drawn aside by what hides it, such as
    the edge of a tool; one that no view shows comes of a wrong depth, as beside what crosses the thread.
    Of the 35,000 fields with curves called tracking by which the bounds were chosen, 45 % of the 364
    wrong ones have such a kink, and 0.2 % of the right ones.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._of_late: Float64 | None = None

    def step(self, curve: Nurbs, evidence: Evidence, seconds: float) -> bool:
        """Whether the curve has such a kink, so many seconds after the last one."""
        points = values_at(curve, EVENLY)
        bends, learned = _bends(points), 1.0 - math.exp(-max(seconds, 0.0) / _OF_LATE_S)
        last = bends if self._of_late is None else self._of_late
        self._of_late = last + learned * (bends - last)
        near = maximum_filter1d(self._of_late, 2 * _SLIDES + 1)
        sharper = bends - (1 + _TIGHTER) * near - _SHARPER
        inner = slice(_CHORD, -_CHORD)
        is_beside_hidden = binary_dilation(~evidence.evenly_seen, iterations=_NEAR)[inner]
        chord = length_of(curve) * _CHORD / (len(points) - 1)
        shown = np.maximum(*map(_bends, self._rig.project(points)))
        is_in_depth = (bends > _IN_DEPTH * shown) & (
            sharper > _SIGMAS * evidence.sigma[inner] / chord
        )
        is_false = (sharper > 0) & (is_beside_hidden | is_in_depth)
        return bool(is_false[_TIP - _CHORD : _CHORD - _TIP].any())


def sprung_in_depth(before: Nurbs, after: Nurbs, rig: StereoRig, held: Bool) -> Bool:
    """(K,) evenly spaced samples at which a curve has sprung aside in depth at once.

    A thread does not: there the two views show different things, such as another strand in one of
    them. A curve that was wrong and springs back bends less in depth than before. Of the steps of 15
    runs that sprang so, 19 led away from the thread and one towards it.

    Args:
        before, after: the curve, as it should be and as the views show it.
        rig: the cameras.
        held: (K,) samples at which the same was not believed in the last field.
    """
    was, now = (_disparities(rig, curve) for curve in (before, after))
    step = now - was
    away = np.abs(step - median_filter(step, len(step) // 2, mode="nearest"))
    bound = max(_SPRING_PX, _ABOVE_MOST * float(np.percentile(away, _MOST_PERCENT)))
    runs, count = label(away > bound / 2)
    sprung = np.zeros(len(away), bool)
    for run in (runs == place for place in range(1, count + 1)):
        around = binary_dilation(run, iterations=_AROUND)[_CHORD:-_CHORD]
        bent = [float(np.sum(_second_differences(line)[around] ** 2)) for line in (was, now)]
        springs_back = bent[1] < bent[0] * (_BACK_FROM_HELD if held[run].any() else _BACK)
        if (run & (away > bound))[_TIP:-_TIP].any() and not springs_back:
            sprung |= binary_dilation(run, iterations=_CHORD)
    return sprung


def _disparities(rig: StereoRig, curve: Nurbs) -> Float64:
    left, right = rig.project(values_at(curve, EVENLY))
    return left[:, 0] - right[:, 0]


def _second_differences(values: Float64) -> Float64:
    return values[2 * _CHORD :] - 2 * values[_CHORD:-_CHORD] + values[: -2 * _CHORD]


def _bends(points: Float64) -> Float64:
    """(K - 2 * _CHORD,) angles between successive chords of (K, d) points, radians."""
    chords = points[_CHORD:] - points[:-_CHORD]
    before, after = chords[:-_CHORD], chords[_CHORD:]
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return np.arccos(np.clip((before * after).sum(1) / np.maximum(lengths, 1e-12), -1.0, 1.0))

"""Where a thread ends: the step of the ridge response along it and beyond."""

from __future__ import annotations

import numba
import numpy as np

from suturetrack.kernels.search import solid
from suturetrack.types import Float64

# What eq. (1) leaves of the response at the very end of a ridge.
_AT_THE_END = 0.43
# Before and behind a plain end the response takes so far to fall from and to these parts; it takes
# longer behind an end at something dark, and so much is taken back at most.
_BEFORE, _BEHIND, _SYMMETRY = 0.7, 0.15, 1.12
_SOFTEST_PX = 2.0
# Responses below this part of a clear view are background.
_FAINT = 0.2
# What is shorter than this is a speck behind the end and not its continuation.
_SOLID_PX = 8.0
# Samples before the end, counted from it, that tell what the thread shows there.
_PLATEAU = (24, 6)


@numba.njit(cache=True, nogil=True)
def outer_boundary(x: Float64, mean: Float64, least: Float64) -> tuple[float, float]:
    """Where the outermost solid run that begins on the curve ends, and the response there.

    The thread may fade towards its end: the step is looked for at a part of what it shows there.

    Args:
        x: (k,) evenly spaced px along the curve, above 0 beyond its end.
        mean: (k,) responses, of a clear view of the thread, that are followed.
        least: (k,) responses that have to show what goes on beyond the end.

    Returns:
        The place, to a part of a pixel, and the response; nan where there is no such run.
    """
    step, count = x[1] - x[0], len(x)
    runs = solid((x <= 0) & (mean > _FAINT), np.full(count, step), _SOLID_PX)
    if not runs.any():
        return np.nan, np.nan
    last = np.flatnonzero(runs)[-1]
    plateau = np.median(mean[max(last - _PLATEAU[0], 0) : last - _PLATEAU[1]])
    threshold = _AT_THE_END * plateau
    while last > 0 and mean[last] < threshold:
        last -= 1
    beyond = max(threshold, _FAINT)
    while (
        last + 1 < count
        and mean[last + 1] >= threshold
        and (x[last + 1] <= 0 or least[last + 1] >= beyond)
    ):
        last += 1
    if last + 1 == count:
        return x[-1], threshold
    end = _crossing(x, mean, last, threshold)
    if mean[last + 1] < threshold:
        end -= _softness(x, mean / plateau, last, end)
    return end, threshold


@numba.njit(cache=True, nogil=True)
def _softness(x: Float64, mean: Float64, last: int, end: float) -> float:
    """How much further the response falls behind the end than before it, px.

    A hole that the thread comes out of, or a shadow that it casts, responds as well, and draws the end
    outward. Blur is the same on both sides.
    """
    before = behind = last
    while before > 0 and mean[before] < _BEFORE:
        before -= 1
    while behind + 2 < len(x) and mean[behind + 1] >= _BEHIND:
        behind += 1
    rise = end - _crossing(x, mean, before, _BEFORE)
    fall = _crossing(x, mean, behind, _BEHIND) - end
    return min(max(fall - _SYMMETRY * rise, 0.0), _SOFTEST_PX)


@numba.njit(cache=True, nogil=True)
def _crossing(x: Float64, mean: Float64, last: int, level: float) -> float:
    """Where the response falls to the level behind the sample `last`."""
    share = (mean[last] - level) / max(mean[last] - mean[last + 1], 1e-6)
    return x[last] + (x[1] - x[0]) * min(max(share, 0.0), 1.0)

"""Literal twins of the kernels that read where a thread, or a run of what is seen of it, ends."""

from __future__ import annotations

import numpy as np

from suturetrack.types import Bool, Float64


def outer_boundary(x: Float64, mean: Float64, least: Float64) -> tuple[float, float]:
    """See `suturetrack.kernels.boundary.outer_boundary`."""
    step = x[1] - x[0]
    places = np.flatnonzero(solid((x <= 0) & (mean > 0.2), np.full(len(x), step), 8.0))
    if not len(places):
        return np.nan, np.nan
    last = places[-1]
    plateau = float(np.median(mean[max(last - 24, 0) : last - 6]))
    level = 0.43 * plateau
    last = max(np.flatnonzero(mean[: last + 1] >= level), default=0)
    goes_on = (mean >= level) & ((x <= 0) | (least >= max(level, 0.2)))
    stops = np.flatnonzero(~goes_on[last + 1 :])
    if not len(stops):
        return x[-1], level
    last += int(stops[0])
    end = _crossing(x, mean, last, level)
    if mean[last + 1] < level:
        share = mean / plateau
        before = max(np.flatnonzero(share[: last + 1] >= 0.7), default=0)
        fallen = np.flatnonzero(share[last + 1 : -1] < 0.15)
        behind = last + int(fallen[0]) if len(fallen) else len(x) - 2
        rise = end - _crossing(x, share, before, 0.7)
        fall = _crossing(x, share, behind, 0.15) - end
        end -= np.clip(fall - 1.12 * rise, 0.0, 2.0)
    return end, level


def solid(flags: Bool, lengths: Float64, least: float) -> Bool:
    """See `suturetrack.kernels.search.solid`."""
    places, kept = np.flatnonzero(flags), np.zeros_like(flags)
    for run in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        kept[run] = lengths[run].sum() >= least
    return kept


def _crossing(x: Float64, values: Float64, last: int, level: float) -> float:
    """Where the line through the samples `last` and the next one has the level, between the two."""
    share = (values[last] - level) / max(values[last] - values[last + 1], 1e-6)
    return float(x[last] + (x[1] - x[0]) * np.clip(share, 0.0, 1.0))

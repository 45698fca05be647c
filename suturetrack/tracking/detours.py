"""Stretches of the curve that run along another thread for a while, led back to their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.interpolate import BSpline

from suturetrack.camera import StereoRig
from suturetrack.nurbs import curve_from
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.reliability import Evidence
from suturetrack.tracking.sampling import View, distinct, greville, length_of, views_at
from suturetrack.tracking.strands import Neighbour, Neighbours, Strand
from suturetrack.types import Float64, Nurbs

# A crowded stretch is widened by so much of itself and of the curve on either side; what is shorter is no
# detour, and what comes so near to an end is held on one side only.
_WIDER, _MARGIN = 0.1, 0.005
_SHORTEST_PX, _END = 15.0, 0.05
# How far away the thread has to run, what has to be seen of it there, and what may be less seen of the curve.
_AWAY_PX, _SEEN, _LOSS = 2.0, 0.9, 0.02
# How far a bridge leads away at once, at least: of 361 that did not, none did so later.
_LEAVES_PX = 1.0
# A thread changes its bending less than a curve that leaves it and comes back.
_CALMER = 0.4
_PLACES = 200

Stretch = tuple[float, float]
"""Parameters between which a curve may make a detour."""

Fitted = Callable[[Nurbs, Neighbours], Evidence]
"""Lays a curve on the field, clear of other threads."""


def led_back(
    curve: Nurbs, known: KnownLength, rig: StereoRig, others: Neighbours, fitted: Fitted
) -> Evidence | None:
    """The curve without its detours; None where it makes none.

    Where another thread crosses twice at a small angle, the curve may have changed over to it in
    between: seen all along, at a wrong depth, with its own thread beside it. A bridge over the stretch
    finds that, once the ridge that the curve is on is left to the other.

    Args:
        curve: as it follows the thread.
        known: what is known of the thread's length.
        rig: the cameras.
        others: other threads that the field shows.
        fitted: lays curves on the field.
    """
    found = None
    now = fitted(curve, others)
    for stretch in _crowded_stretches(now):
        bridge, beside = _bridged(now.fit.curve, stretch), _with_stretch(others, now, stretch, rig)
        if not _is_calmer(bridge, now.fit.curve, stretch):
            continue
        tried = fitted(bridge, beside)
        if _away(tried, now, stretch, rig) < _LEAVES_PX:
            continue
        tried = fitted(fitted(tried.fit.curve, beside).fit.curve, others)
        if _is_better(tried, now, stretch, known, rig):
            found = now = tried
    return found


def _crowded_stretches(evidence: Evidence) -> Iterator[Stretch]:
    """Where the curve runs beside other ridges, clear of its ends."""
    samples, crowded = evidence.fit.samples, evidence.fit.crowd.others
    along = np.cumsum(evidence.fit.both[0].speed * samples.share)
    edges = np.flatnonzero(np.diff(np.r_[False, crowded, False]))
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        margin = _WIDER * (samples.s[last] - samples.s[first]) + _MARGIN
        start, stop = float(samples.s[first] - margin), float(samples.s[last] + margin)
        if along[last] - along[first] >= _SHORTEST_PX and start > _END and stop < 1 - _END:
            yield start, stop


def _with_stretch(
    others: Neighbours, evidence: Evidence, stretch: Stretch, rig: StereoRig
) -> Neighbours:
    """Other threads, with the stretch of the curve as one of them."""
    left, right = _views(evidence, stretch, rig)
    everywhere = np.ones(_PLACES, bool)
    mine = Neighbour(Strand.other(left, everywhere), Strand.other(right, everywhere))
    return Neighbours((*others.threads, mine))


def _views(evidence: Evidence, stretch: Stretch, rig: StereoRig) -> tuple[View, View]:
    return views_at(rig, evidence.fit.curve, np.linspace(*stretch, _PLACES))


def _bridged(curve: Nurbs, stretch: Stretch) -> Nurbs:
    """The curve with the least change of bending along the stretch."""
    points, s = curve.control_points.copy(), greville(curve.knots)
    free = (stretch[0] < s) & (s < stretch[1])
    third = _third_derivatives(curve)
    points[free] = np.linalg.lstsq(third[:, free], -third[:, ~free] @ points[~free], rcond=None)[0]
    return curve_from(curve.degree, curve.knots, points)


def _third_derivatives(curve: Nurbs) -> Float64:
    """(spans, n + 1) of the basis, constant in each span; their squares are integrals over it."""
    edges = distinct(curve.knots)
    basis = BSpline(curve.knots, np.eye(len(curve.control_points)), curve.degree)
    return np.asarray(basis((edges[1:] + edges[:-1]) / 2, 3)) * np.sqrt(np.diff(edges))[:, None]


def _unrest(curve: Nurbs, stretch: Stretch) -> float:
    """How much its bending changes along the stretch: the integral of |f'''|^2."""
    edges = distinct(curve.knots)
    inside = (edges[1:] > stretch[0]) & (edges[:-1] < stretch[1])
    return float(np.sum((_third_derivatives(curve)[inside] @ curve.control_points) ** 2))


def _is_calmer(tried: Nurbs, now: Nurbs, stretch: Stretch) -> bool:
    return _unrest(tried, stretch) < _CALMER * _unrest(now, stretch)


def _is_better(
    tried: Evidence, now: Evidence, stretch: Stretch, known: KnownLength, rig: StereoRig
) -> bool:
    """Whether another course of the stretch is seen, elsewhere, and more likely that of the thread."""
    s = tried.fit.samples.s
    is_seen = tried.seen[(stretch[0] < s) & (s < stretch[1])].mean() >= _SEEN
    length, noise = length_of(tried.fit.curve), tried.length_noise
    return bool(
        is_seen
        and tried.share >= now.share - _LOSS
        and _is_calmer(tried.fit.curve, now.fit.curve, stretch)
        and _away(tried, now, stretch, rig) >= _AWAY_PX
        and not (known.is_exceeded(length, noise) or known.is_undercut(length, noise))
    )


def _away(tried: Evidence, now: Evidence, stretch: Stretch, rig: StereoRig) -> float:
    """How far the stretch has moved across itself somewhere, px."""
    both = zip(_views(tried, stretch, rig), _views(now, stretch, rig), strict=True)
    across = [((there.pixels - here.pixels) * here.normals).sum(axis=1) for there, here in both]
    return float(np.abs(across).max())

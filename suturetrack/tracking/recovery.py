"""Finds a thread again that was lost: from the last curve, then from the last seed, then anywhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationConfig,
    InitializationError,
    initialize,
)
from suturetrack.kernels import search
from suturetrack.nurbs import evaluate, reversed_curve, tangents
from suturetrack.polylines import polyline_distances, polyline_length
from suturetrack.tracking.clearness import clear
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.length import has_length, length_error
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import Neighbours, Strand
from suturetrack.tracking.sureness import SURE
from suturetrack.types import Bool, Float64, Nurbs, RidgeField, Seed

_PLACES = 24
_SEEDS = 2
# Threads that lie on one another do so for less of their length.
_SHARED = 0.3
# And one thread under two names does for almost all of it.
_SAME = 0.9
_EVENLY = np.linspace(0, 1, 4 * _PLACES)
# How near and for how long an end may run along another thread, and what more leaves of the confidence.
_BESIDE_PX, _LONGEST_PX, _DOUBTED = 5.0, 12.0, 0.3
# How closely its length is met elsewhere.
_CLOSELY = 0.01
# How near to a seed a thread passes that runs along the other one there, for a while.
_MEETS_PX = 25.0


@dataclass(frozen=True, eq=False)
class Setup:
    """What threads are looked for and followed with."""

    rig: StereoRig
    tracking: TrackingConfig
    initialization: InitializationConfig

    def look(self, field: RidgeField, seed: Seed) -> Initialization:
        """The thread through the seed; raises as `initialize`."""
        return initialize(field, self.rig, seed, self.initialization)

    def rig_of(self, found: Initialization) -> StereoRig:
        """With the rows on which the right view showed what was found."""
        return self.rig.with_row_offset(found.row_offset_px)

    def follower(
        self, found: Initialization, field: RidgeField, before: Follower | None = None
    ) -> Follower:
        """Follows what was found in the field; `before` is who followed it before."""
        follower = Follower(found.curve, field, self.rig_of(found), self.tracking)
        if before is not None:
            follower.remember(before, is_sure=found.confidence >= SURE)
        return follower


def find_again(
    last: Nurbs,
    known_lengths: tuple[float, ...],
    starts: Iterable[Seed],
    field: RidgeField,
    setup: Setup,
    *,
    is_brief: bool = False,
) -> Initialization | None:
    """The thread in the field, run in the direction of the last curve; None where it is not found.

    A curve counts as the thread if its length is a known one, or none is known. A brief search
    gives up with the first that does not.
    """
    for start in starts:
        try:
            found = setup.look(field, start)
        except InitializationError:
            continue
        if has_length(found.curve, known_lengths):
            return directed(found, last)
        if is_brief:
            break
    return None


def starts_on(last: Nurbs, seed: Seed, field: RidgeField, rig: StereoRig) -> list[Seed]:
    """Where the last curve still lies best on something that looks like thread, then the seed.

    Args:
        rig: with the rows on which the right view showed the last curve.
    """
    s = np.linspace(0.03, 0.97, _PLACES)
    points = evaluate(last, s)
    both = views(rig, points, tangents(last, s))
    shown = np.minimum(both[0].responses(field.left), both[1].responses(field.right))
    best = np.argsort(-shown)
    far = best[np.abs(best - best[0]) > _PLACES // 4]
    chosen = [best[0], *far[: _SEEDS - 1]]
    clear = points[chosen][shown[chosen] > 0]
    return [*(Seed(seed.thread, point=(float(x), float(y), float(z))) for x, y, z in clear), seed]


def find_elsewhere(
    last: Nurbs,
    known_lengths: tuple[float, ...],
    level: float,
    field: RidgeField,
    setup: Setup,
    name: str,
) -> Initialization | None:
    """The thread where neither its last curve nor its seed is, for it may have moved on while it was lost.

    It is looked for at one of the places that the left view shows as clearly, another one in each field.
    Nothing but its length tells that it is the thread, so that has to be known, and met closely by a
    look that is sure by itself.
    """
    places = np.argwhere(clear(field.left, level))[:, ::-1]
    if not (len(places) and known_lengths):
        return None
    place = places[np.random.default_rng(field.stamp.frame).integers(len(places))]
    u, v = (float(c) for c in setup.rig.raw_pixels(place))
    found = find_again(last, known_lengths, [Seed(name, pixel=(u, v))], field, setup)
    if found is None or found.confidence < SURE:
        return None
    return found if length_error(found.curve, known_lengths) < _CLOSELY else None


def lies_on(curve: Nurbs, others: Neighbours, rig: StereoRig) -> bool:
    """Whether much of the curve lies on the strands of other threads, in both images."""
    return bool(np.mean(_shared(curve, others, rig, search.APART_PX)) > _SHARED)


def known_as(found: Initialization, others: Neighbours, rig: StereoRig) -> str:
    """The name of the tracked thread on which what was found lies from end to end; empty for none."""
    for name, other in others.tracked.items():
        if _shared(found.curve, other, rig, _BESIDE_PX).mean() > _SAME:
            return name
    return ""


def means_no_other(found: Initialization, seed: Seed, others: Neighbours, rig: StereoRig) -> bool:
    """Whether the seed lies on two strands, of which the one that was not found is tracked: it has a name."""
    if not found.is_seed_shared:
        return False
    pixel = rig.locate(seed)[None]
    tracked = [other.both[0].pixels for other in others.tracked.values()]
    return any(polyline_distances(pixel, strand)[0] < _MEETS_PX for strand in tracked)


def doubting_ends(found: Initialization, others: Neighbours, rig: StereoRig) -> Initialization:
    """The look, which is not sure by itself where an end runs on along another thread that is as sure.

    What lies on others from end to end is one of them under another name.
    """
    shared = _shared(found.curve, others.as_sure_as(found.confidence), rig, _BESIDE_PX)
    if shared.mean() > _SAME:
        return found
    spacing = polyline_length(rig.project(evaluate(found.curve, _EVENLY))[0]) / len(_EVENLY)
    # The tips themselves are a little apart.
    shared[[0, -1]] |= shared[[1, -2]]
    runs = [np.argmin(np.r_[flags, False]) for flags in (shared, shared[::-1])]
    new = tuple(
        (abs(end - float(_EVENLY[run])), _DOUBTED)
        for end, run in enumerate(runs)
        if run * spacing > _LONGEST_PX
    )
    left, right = found.doubts
    confidence = found.confidence * _DOUBTED ** len(new)
    return replace(found, confidence=confidence, doubts=((*left, *new), (*right, *new)))


def _shared(curve: Nurbs, others: Neighbours, rig: StereoRig, near: float) -> Bool:
    """(k,) where the curve runs along the strands of other threads, in both images."""
    shared = np.ones(len(_EVENLY), bool)
    both = views(rig, evaluate(curve, _EVENLY), tangents(curve, _EVENLY))
    for view, strand in zip(both, others.both, strict=True):
        own = Strand(view.pixels, view.tangents, np.zeros(len(_EVENLY)))
        shared &= search.doubled(own.arrays, strand.arrays, 0.0, near)
    return shared


def directed(found: Initialization, last: Nurbs) -> Initialization:
    """What was found, run in the direction of the last curve."""

    def apart(a: Nurbs) -> float:
        s: Float64 = np.linspace(0, 1, 16)
        return float(np.linalg.norm(evaluate(a, s) - evaluate(last, s), axis=1).sum())

    other = reversed_curve(found.curve)
    if apart(other) >= apart(found.curve):
        return found
    left, right = (tuple((1 - s, rest) for s, rest in view) for view in found.doubts)
    return replace(found, curve=other, doubts=(left, right))

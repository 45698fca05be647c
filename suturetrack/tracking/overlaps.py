"""Where what a look found runs along other threads, which may be what was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization
from suturetrack.kernels import search
from suturetrack.nurbs import evaluate, tangents
from suturetrack.polylines import polyline_distances, polyline_length
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import Neighbours, Strand
from suturetrack.types import Bool, Nurbs, Seed

# Threads that lie on one another do so for less of their length.
_SHARED = 0.3
# And one thread under two names does for almost all of it.
_SAME = 0.9
_EVENLY = np.linspace(0, 1, 96)
# How near and for how long an end may run along another thread, and what more leaves of the confidence.
_BESIDE_PX, _LONGEST_PX, _DOUBTED = 5.0, 12.0, 0.3
# How near to a seed a thread passes that runs along the other one there, for a while.
_MEETS_PX = 25.0


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

"""Ends that are not plain to see, grown anew along the ridge from where the thread is."""

from __future__ import annotations

from collections.abc import Callable

from suturetrack import nurbs
from suturetrack.tracking.control_points import rearrange
from suturetrack.tracking.ends import find_ends, with_ends
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.reliability import RELIABILITY_SAMPLES, Evidence, loose_ends
from suturetrack.tracking.sampling import length_of
from suturetrack.types import Bool, Nurbs

# Samples that have to be unseen at an end, and that may be at most. One beside them may have left the
# thread as well.
_FEW, _MANY, _BESIDE = 2, 20, 1
# How often an end is drawn out, at most, and by how much at least to be drawn out once more.
_STEPS, _LEAST_PX = 8, 2.0
# By how much it is drawn out over what crosses the thread.
_LEAP_PX = 12.0


def loose_tails(plain: Bool) -> dict[int, int]:
    """By end, 0 or 1, how many of the evenly spaced samples there are not plainly on the thread, where it
    is a few."""
    counts = loose_ends(~plain)
    return {end: count for end, count in enumerate(counts) if _FEW <= count <= _MANY}


def regrown(
    curve: Nurbs,
    tails: dict[int, int],
    known: KnownLength,
    images: Images,
    fitted: Callable[[Nurbs], Evidence],
) -> Evidence | None:
    """The curve with an end elsewhere; None where what is not seen of its ends may be hidden.

    An end that is let go springs aside, and what is left of the curve there points nowhere, or lies on
    another strand of it. It is not hidden if the thread plainly goes on from where it is seen, with
    nothing beside it, and is as long as ever that way.

    Args:
        curve: as its ends are now.
        tails: of `loose_tails`.
        known: what is known of the thread's length.
        images: what shows the thread.
        fitted: lays a curve on the field.
    """
    found = None
    for end, loose in tails.items():
        other = _grown(_without(curve, end, loose + _BESIDE), end, images, fitted)
        if other is not None and _is_plain(other, end, loose, known):
            found, curve = other, other.fit.curve
    return found


def _without(curve: Nurbs, end: int, samples: int) -> Nurbs:
    part = samples / (RELIABILITY_SAMPLES - 1)
    return nurbs.part(curve, 0.0, 1.0 - part) if end else nurbs.part(curve, part, 1.0)


def _grown(
    curve: Nurbs, end: int, images: Images, fitted: Callable[[Nurbs], Evidence]
) -> Evidence | None:
    """The curve drawn out along the ridge at an end, and over what crosses it; None if there is none."""
    evidence = None
    step = find_ends(curve, images)[end]
    for _ in range(_STEPS):
        if step is None:
            break
        is_leap = step.offset_px < _LEAST_PX
        ahead = step.pixel * (_LEAP_PX if is_leap else step.offset_px)
        start, stop = (0.0, ahead) if end else (ahead, 0.0)
        longer = fitted(rearrange(with_ends(curve, -start, 1.0 + stop), images.rig)[0])
        step = find_ends(longer.fit.curve, images)[end]
        if is_leap and (step is None or step.offset_px < -_LEAST_PX):
            break
        evidence, curve = longer, longer.fit.curve
    return evidence


def _is_plain(evidence: Evidence, end: int, samples: int, known: KnownLength) -> bool:
    """Whether so many samples of the new end are seen and alone, and the thread has its length."""
    tail = slice(-samples, None) if end else slice(samples)
    is_seen = bool((evidence.evenly_seen & evidence.alone)[tail].all())
    return is_seen and known.is_met(length_of(evidence.fit.curve), evidence.length_noise)

"""Finds a thread again that was lost: from the last curve, then from the last seed, then anywhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationConfig,
    InitializationError,
    initialize,
)
from suturetrack.nurbs import evaluate, tangents
from suturetrack.tracking.clearness import clear
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.length import has_length, length_error
from suturetrack.tracking.sampling import views
from suturetrack.tracking.sureness import SURE
from suturetrack.types import Float64, InputError, Nurbs, RidgeField, Seed

# Places of the last curve that are looked at, and those of them from which the thread is looked for.
_PLACES, _SEEDS = 24, 2
# How closely its length is met elsewhere.
_CLOSELY = 0.01


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
        except (InitializationError, InputError):
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


def directed(found: Initialization, last: Nurbs) -> Initialization:
    """What was found, run in the direction of the last curve."""

    def apart(a: Nurbs) -> float:
        s: Float64 = np.linspace(0, 1, 16)
        return float(np.linalg.norm(evaluate(a, s) - evaluate(last, s), axis=1).sum())

    other = found.turned_round()
    return other if apart(other.curve) < apart(found.curve) else found

"""The curve laid on a field: from where it is predicted, and further away where less is seen than before."""

from __future__ import annotations

import numpy as np

from suturetrack.tracking import gauss_newton
from suturetrack.tracking.alignment import shifted
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.images import Images
from suturetrack.tracking.reliability import MOST, Evidence
from suturetrack.tracking.springs import sprung_in_depth
from suturetrack.tracking.strands import Neighbours
from suturetrack.types import Bool, Nurbs

# Searches, in units of the first: tried where less than the second is seen, taken if they show more.
_WIDER = ((2.5, 0.985, 0.01), (6.5, 0.8, 0.05))
_ENOUGH, _GAIN = 0.97, 0.02
_DROP = 0.01
# Fields after which what is hidden is looked for further away, too.
_RETRY = 5


def fit_widely(
    before: Nurbs,
    predicted: Nurbs,
    images: Images,
    share: float,
    config: TrackingConfig,
    neighbours: Neighbours,
    known_length: float | None,
    held: Bool,
) -> tuple[Evidence, Bool]:
    """The curve on the field, and (K,) where it is held in depth against what the views show.

    Looks further away for what was seen before, and now and then for what is hidden.

    Args:
        before: the curve in the last field.
        predicted: where it should be in this one.
        images: what shows it.
        share: what was seen of it in the last field.
        config: how far is looked.
        neighbours: other threads that the images show.
        known_length: of the thread, if it is known and all of it is in sight.
        held: (K,) where it was held in depth in the last field.
    """

    def fitted(start: Nurbs, reach_px: float, sprung: Bool | None = None) -> Evidence:
        how = images, reach_px, config, neighbours, known_length, sprung
        return Evidence.of(gauss_newton.fit(before, start, *how))

    best = fitted(predicted, config.search_px)
    usual = 1.0 if images.field.stamp.frame % _RETRY == 0 else share - _DROP
    if best.share < min(_ENOUGH, usual):
        jumped = fitted(shifted(predicted, images), config.search_px)
        if jumped.share > best.share + _GAIN:
            best = jumped
    for times, enough, gain in _WIDER:
        if best.share >= min(enough, usual):
            break
        tried = fitted(predicted, times * config.search_px)
        if tried.share > best.share + gain:
            best = tried
    sprung = sprung_in_depth(predicted, best.fit.curve, images.rig, held)
    if best.share < MOST or not sprung.any():
        return best, np.zeros_like(sprung)
    return fitted(predicted, config.search_px, sprung), sprung

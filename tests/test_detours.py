"""Curves that change over to another thread between two crossings with it."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.tracking import TrackingConfig, gauss_newton
from suturetrack.tracking.detours import Fitted, led_back
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.reliability import Evidence
from suturetrack.tracking.strands import NOBODY, Neighbours
from suturetrack.types import Nurbs
from tests.painting import curve_through, paint

THREAD = np.c_[np.linspace(-40, 40, 800), np.zeros(800), np.full(800, 200.0)]
BESIDE = (
    THREAD
    + np.c_[
        np.zeros(800), 1.6 - (THREAD[:, 0] / 12) ** 2, np.full(800, 3.0) - (THREAD[:, 0] / 12) ** 2
    ]
)
"""Crosses it twice in both images, 30 px to either side of its middle, and is deeper in between."""


def away(curve: Nurbs, points: np.ndarray) -> float:
    return metrics.curve_error(nurbs.evaluate(curve, np.linspace(0, 1, 400)), points).largest


@pytest.fixture
def fitted(rig: StereoRig) -> Fitted:
    images = Images(paint(rig, [THREAD, BESIDE], 0), rig, (0.8, 0.8))
    config = TrackingConfig()

    def fit(curve: Nurbs, others: Neighbours) -> Evidence:
        reach_px = config.search_px
        return Evidence.of(gauss_newton.fit(curve, curve, images, reach_px, config, others))

    return fit


def known(length: float) -> KnownLength:
    return KnownLength(length, is_established=True, was_established=True)


@pytest.fixture
def detour(fitted: Fitted) -> Nurbs:
    """The curve that changes over to the other thread between the crossings, as it settles there."""
    between = np.abs(THREAD[:, 0]) < 15.2
    evidence = fitted(curve_through(np.where(between[:, None], BESIDE, THREAD), 14), NOBODY)
    assert evidence.seen.all()
    assert away(evidence.fit.curve, THREAD) > 3.0
    return evidence.fit.curve


def test_a_curve_that_has_changed_over_to_another_thread_is_led_back(
    rig: StereoRig, detour: Nurbs, fitted: Fitted
) -> None:
    found = led_back(detour, known(80.0), rig, NOBODY, fitted)
    assert found is not None
    assert found.seen.all()
    assert away(found.fit.curve, THREAD) < 1.0


def test_a_curve_on_its_own_thread_stays_there(rig: StereoRig, fitted: Fitted) -> None:
    own = fitted(curve_through(THREAD, 14), NOBODY).fit.curve
    assert led_back(own, known(80.0), rig, NOBODY, fitted) is None


def test_no_curve_is_led_to_where_the_thread_would_have_another_length(
    rig: StereoRig, detour: Nurbs, fitted: Fitted
) -> None:
    for length in (79.0, 81.0):
        assert led_back(detour, known(length), rig, NOBODY, fitted) is None

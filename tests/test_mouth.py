"""An end at a place that the thread comes out of."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.tracking.ends import EndStep
from suturetrack.tracking.mouth import Mouth
from suturetrack.types import Nurbs

FIELD_NS = 33_333_333
HOLE = np.array([-20.0, 0.0, 150.0])


def drawn_out(stop: float) -> Nurbs:
    """A straight thread from the hole on."""
    points = HOLE + np.linspace(0, stop - HOLE[0], 4)[:, None] * np.array([1.0, 0.0, 0.0])
    return nurbs.curve_from(3, nurbs.clamped_knots(np.zeros(0), 3), points)


def follow(
    rig: StereoRig, stops: list[float], shown_px: list[float]
) -> tuple[list[float], tuple[Mouth, Mouth]]:
    """The steps of the end at the hole, px, while the images show it so far outside."""
    mouths, steps = (Mouth(), Mouth()), list[float]()
    for field, (stop, px) in enumerate(zip(stops, shown_px, strict=True)):
        curve = drawn_out(stop)
        pixel = 0.25 / nurbs.length(curve)
        for end, offset in enumerate((px, 0.0)):
            step = EndStep(offset, pixel, at_border=False)
            found = mouths[end].steady(step, curve, end, mouths[1 - end], rig, field * FIELD_NS)
            assert found is not None
            if end == 0:
                steps.append(found.offset_px)
    return steps, mouths


def test_an_end_that_stays_while_the_thread_slides_is_held_at_its_mean(rig: StereoRig) -> None:
    noise = np.random.default_rng(0).normal(0, 1.5, 120)
    steps, mouths = follow(rig, list(np.linspace(20, 60, 120)), list(noise))
    assert [mouth.is_open for mouth in mouths] == [True, False]
    assert np.abs(steps[60:]).max() < 0.7 < np.abs(noise[60:]).max()


def test_a_thread_that_keeps_its_length_has_no_mouth(rig: StereoRig) -> None:
    noise = list(np.random.default_rng(0).normal(0, 1.5, 120))
    steps, mouths = follow(rig, [20.0] * 120, noise)
    assert not any(mouth.is_open for mouth in mouths)
    assert steps == pytest.approx(noise)


def test_an_end_that_comes_free_is_let_go(rig: StereoRig) -> None:
    away = [0.0] * 60 + [-20.0] * 30
    steps, mouths = follow(rig, [*np.linspace(20, 40, 60), *[40.0] * 30], away)
    assert steps[61] == pytest.approx(0.0, abs=0.1)
    assert steps[-1] == -20.0
    assert not mouths[0].is_open


def test_a_length_that_one_field_shows_opens_no_mouth(rig: StereoRig) -> None:
    stops = [*[20.0] * 60, 26.0, *[20.0] * 60]
    _, mouths = follow(rig, stops, [0.0] * len(stops))
    assert not any(mouth.is_open for mouth in mouths)


def test_a_mouth_is_met_in_the_images_where_the_depth_of_the_end_is_in_doubt(
    rig: StereoRig,
) -> None:
    _, mouths = follow(rig, list(np.linspace(20, 60, 60)), [0.0] * 60)
    assert mouths[0].is_open
    middle = np.array([rig.baseline / 2, 0.0, 0.0])
    deeper = middle + (HOLE - middle) * (1 + 8.0 / HOLE[2])
    points = deeper + np.linspace(0, 1, 4)[:, None] * (np.array([60.0, 0.0, HOLE[2]]) - deeper)
    tilted = nurbs.curve_from(3, nurbs.clamped_knots(np.zeros(0), 3), points)
    step = EndStep(0.0, 0.25 / nurbs.length(tilted), at_border=False)
    found = mouths[0].steady(step, tilted, 0, mouths[1], rig, 60 * FIELD_NS)
    assert found is not None
    assert abs(found.offset_px) < 0.3

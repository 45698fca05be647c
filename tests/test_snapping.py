"""A rough place finds the thread that is meant."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig, InitializationError
from suturetrack.snapping import point_of_right_pixel, snap_area, snap_pixel, snap_point
from suturetrack.types import RidgeField
from tests.painting import paint, thread

CONFIG = InitializationConfig()


@pytest.fixture
def line() -> np.ndarray:
    return thread(0.3)


@pytest.fixture
def field(rig: StereoRig, line: np.ndarray) -> RidgeField:
    return paint(rig, [line], 0)


def off(line: np.ndarray, point: np.ndarray) -> float:
    return float(np.linalg.norm(line - point, axis=1).min())


def test_a_click_beside_the_thread_lands_on_it(
    rig: StereoRig, field: RidgeField, line: np.ndarray
) -> None:
    for view, pixels in zip((field.left, field.right), rig.project(line), strict=True):
        for at in (100, 300, 500):
            found, _ = snap_pixel(view, pixels[at] + [2.0, -3.0], CONFIG)
            assert found is not None
            assert off(pixels, found.pixel) < 0.6
            assert len(found.segment) > 50


def test_a_click_on_nothing_gives_what_is_near(
    rig: StereoRig, field: RidgeField, line: np.ndarray
) -> None:
    pixels, _ = rig.project(line)
    found, candidates = snap_pixel(field.left, np.array([600.0, 30.0]), CONFIG)
    assert found is None
    assert len(candidates) >= 1
    assert off(pixels, candidates[0]) < 1.0


def test_a_box_takes_the_thread_that_it_holds(
    rig: StereoRig, field: RidgeField, line: np.ndarray
) -> None:
    pixels, _ = rig.project(line)
    corners = pixels[300] + np.array([[25.0, 25.0], [-25.0, -25.0]])
    found = snap_area(field.left, corners, CONFIG)
    assert found is not None
    assert (abs(found.pixel - pixels[300]) <= 25).all()
    assert off(pixels, found.pixel) < 0.6
    assert snap_area(field.left, np.array([[0.0, 0.0], [30.0, 30.0]]), CONFIG) is None


def test_a_tool_tip_finds_the_thread_within_its_radius(
    rig: StereoRig, field: RidgeField, line: np.ndarray
) -> None:
    rng = np.random.default_rng(1)
    for at in rng.integers(20, 580, 10):
        away = rng.normal(size=3)
        tip = line[at] + 4.0 * away / np.linalg.norm(away)
        found = snap_point(field, rig, tip, 8.0)
        assert found is not None
        assert off(rig.project(line)[0], rig.project(found)[0]) < 1.5
        assert off(line, found) < 2.0  # along a row, one pixel of disparity is 1.25 mm
        assert np.linalg.norm(found - tip) <= 8.0
    assert snap_point(field, rig, line[300] + [0.0, 0.0, 30.0], 8.0) is None
    assert snap_point(field, rig, np.array([0.0, 0.0, -5.0]), 8.0) is None


def test_a_click_in_the_right_view_means_the_thread_that_shows_there(rig: StereoRig) -> None:
    """Two threads cross the row of the click in the left view."""
    lines = [thread(0.3), thread(1.1, depth=170.0) + np.array([25.0, 2.0, 0.0])]
    field = paint(rig, lines, 0)
    for line in lines:
        for at in (150, 420):
            pixel = rig.project(line)[1][at]
            point = point_of_right_pixel(field, rig, pixel + np.array([1.0, 2.0]), CONFIG)
            left, right = rig.project(point)
            assert off(rig.project(line)[1], right) < 3.0
            assert off(rig.project(line)[0], left) < 3.0
    with pytest.raises(InitializationError, match="no thread there"):
        point_of_right_pixel(field, rig, np.array([620.0, 20.0]), CONFIG)


def test_a_thread_in_the_right_view_alone_is_refused(rig: StereoRig) -> None:
    line = thread(0.3)
    both, none = paint(rig, [line], 0), paint(rig, [], 1)
    field = RidgeField(both.stamp, none.left, both.right)
    with pytest.raises(InitializationError, match="the left view shows no thread"):
        point_of_right_pixel(field, rig, rig.project(line)[1][300], CONFIG)

"""The paper's method on painted fields: its ends, and its control points."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_distances
from suturetrack.tracking import Tracker, TrackingConfig, paper
from suturetrack.tracking.config import PaperConfig
from suturetrack.tracking.spacing import evenly, respace
from suturetrack.types import Float64, Nurbs, RidgeField, Status
from tests.painting import curve_through, paint, seed_at, thread

PX_MM = 0.25
LEVEL = 0.8
CUTOFFS = (LEVEL / 2, LEVEL / 2)


def along(points: Float64, start_mm: float, stop_mm: float) -> Float64:
    """The points between two places along them, finely sampled."""
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    at = np.linspace(start_mm, stop_mm, 600)
    return np.stack([np.interp(at, travelled, column) for column in points.T], axis=1)


def fitted(curve: Nurbs, field: RidgeField, rig: StereoRig, times: int = 1) -> Nurbs:
    config = PaperConfig()
    for _ in range(times):
        curve = respace(paper.fit(curve, field, rig, CUTOFFS, config), rig, config.spacing_px)[0]
    return curve


def ends_mm(curve: Nurbs, truth: Float64) -> Float64:
    found = nurbs.evaluate(curve, np.array([0.0, 1.0]))
    return np.linalg.norm(found - truth[[0, -1]], axis=1)


@pytest.mark.parametrize("by_mm", [-1.0, -0.5, 0.5, 1.0])
def test_forces_bring_both_ends_to_the_thread(rig: StereoRig, by_mm: float) -> None:
    whole = thread(0.4)
    truth = along(whole, 10.0, 90.0)
    field = paint(rig, [truth], 0, strength=LEVEL)
    start = curve_through(along(whole, 10.0 - by_mm, 90.0 + by_mm), 20)
    assert ends_mm(start, truth).min() > 0.9 * abs(by_mm)
    assert ends_mm(fitted(start, field, rig, 2), truth).max() < 0.4


@pytest.mark.parametrize("by_mm", [-8.0, -4.0, 4.0, 7.0])
def test_ends_far_from_the_slope_are_searched_for(rig: StereoRig, by_mm: float) -> None:
    whole = thread(0.4)
    truth = along(whole, 10.0, 90.0)
    field = paint(rig, [truth], 0, strength=LEVEL)
    start = curve_through(along(whole, 10.0 - by_mm, 90.0 + by_mm), 20)
    blind = PaperConfig(flat_slope=0.0)
    stuck = paper.fit(start, field, rig, CUTOFFS, blind)
    assert ends_mm(stuck, truth).max() > 0.5 * abs(by_mm), "forces alone would do"
    curve = fitted(start, field, rig, 12)
    assert ends_mm(curve, truth).max() < 0.5
    error = metrics.curve_error(nurbs.evaluate(curve, np.linspace(0, 1, 500)), truth)
    assert error.rms < 0.2
    assert abs(error.length_percent) < 1.0


def test_an_end_along_the_epipolar_lines_mends_its_depth(rig: StereoRig) -> None:
    x = np.linspace(-30.0, 30.0, 600)
    bend = 10.0 * np.exp(-((x / 8.0) ** 2))
    truth = np.stack([x, bend, np.full_like(x, 200.0)], axis=1)
    off = truth.copy()
    off[:, 2] += 3.0 * np.clip((x - 15.0) / 15.0, 0.0, 1.0)
    curve = fitted(curve_through(off, 20), paint(rig, [truth], 0, strength=LEVEL), rig, 4)
    assert ends_mm(curve_through(off, 20), truth).max() > 2.9
    assert ends_mm(curve, truth).max() < 0.7


def test_a_thread_pulled_in_and_drawn_out_keeps_its_control_points_apart(rig: StereoRig) -> None:
    whole = thread(0.4)
    lengths = np.r_[np.linspace(90, 62, 35), np.linspace(62, 95, 25)]
    truths = [along(whole, 5.0, 5.0 + length) for length in lengths]
    tracker = Tracker(rig, TrackingConfig(method="paper"))
    tracker.seed(seed_at(rig, truths[0][200]))
    events, counts = set(), []
    least, most = PaperConfig().spacing_px
    for i, truth in enumerate(truths):
        state = tracker.step(paint(rig, [truth], i, strength=LEVEL)).states[0]
        assert state.status is Status.TRACKING
        assert state.curve is not None
        points = nurbs.evaluate(state.curve, np.linspace(0, 1, 500))
        error = metrics.curve_error(points, truth)
        assert error.rms < 0.3
        assert max(error.ends) < 1.0
        assert abs(error.length_percent) < 2.0
        gaps = np.linalg.norm(np.diff(rig.project(state.curve.control_points)[0], axis=0), axis=1)
        assert 0.6 * least < gaps[2:-2].min()
        assert gaps.max() < 1.5 * most
        assert gaps[[0, -1]].min() > 0.15 * least
        counts.append(len(state.curve.control_points))
        events |= {word for event in state.events for word in event.split()}
    assert min(counts) < 0.8 * counts[0]
    assert counts[-1] >= counts[0]
    assert {"inserted,", "removed"} <= events


def test_spacing_evenly_leaves_the_shape_and_the_ends(rig: StereoRig) -> None:
    curve = curve_through(thread(0.0), 20)
    crowded = curve
    for s in (0.01, 0.013, 0.5, 0.501, 0.99):
        crowded = nurbs.insert_knot(crowded, s)
    spaced, inserted, removed = respace(crowded, rig, PaperConfig().spacing_px)
    assert removed > 0
    assert inserted == 0
    at = np.linspace(0, 1, 400)
    apart = polyline_distances(nurbs.evaluate(spaced, at), nurbs.evaluate(curve, at))
    assert apart.max() < 0.1 * PX_MM
    ends = np.array([0.0, 1.0])
    np.testing.assert_allclose(nurbs.evaluate(spaced, ends), nurbs.evaluate(curve, ends), atol=1e-4)
    speed = np.linalg.norm(nurbs.derivative(spaced, at), axis=1)
    assert speed.max() < 1.1 * speed.min()
    assert respace(spaced, rig, PaperConfig().spacing_px) == (spaced, 0, 0)
    assert len(evenly(curve, 1).control_points) == 4

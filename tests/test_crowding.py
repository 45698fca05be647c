"""Where the thread is not alone, and what is made of it."""

from __future__ import annotations

import numpy as np

from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.tracking import Tracker
from suturetrack.tracking.crowding import crowded
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import NOBODY, Neighbours, Strand
from suturetrack.types import RidgeField, Seed, Status
from tests.painting import FPS, paint

LEVELS = (0.8, 0.8)


def line(start: tuple[float, float], stop: tuple[float, float], bulge: float = 0.0) -> np.ndarray:
    """(400, 3) points of a line or an arc, 200 away."""
    t = np.linspace(0, 1, 400)[:, None]
    flat = np.array(start) * (1 - t) + np.array(stop) * t
    flat[:, 1] += bulge * np.sin(np.pi * t[:, 0])
    return np.c_[flat, np.full(400, 200.0)]


def flags(
    rig: StereoRig, field: RidgeField, points: np.ndarray, others: Neighbours = NOBODY
) -> np.ndarray:
    points = points[::4]
    both = views(rig, points, np.gradient(points, axis=0) * len(points))
    return crowded(both, np.full(len(points), 1 / len(points)), field, LEVELS, others)


def test_a_thread_on_its_own_is_alone(rig: StereoRig) -> None:
    thread = line((-25, 0), (25, 3), 6.0)
    assert not flags(rig, paint(rig, [thread], 0), thread).any()


def test_a_ridge_that_crosses_at_a_shallow_angle_crowds_the_thread_where_both_are_near(
    rig: StereoRig,
) -> None:
    thread, stray = line((-25, 0), (25, 0)), line((-25, -6), (25, 6))
    found = flags(rig, paint(rig, [thread, stray], 0), thread)
    away = np.abs(rig.focal / 200.0 * (stray - thread)[::4, 1])
    assert found[away < 4.0].all()
    assert not found[away > 9.0].any()


def test_a_known_strand_crowds_the_thread_although_both_are_one_ridge(rig: StereoRig) -> None:
    thread = line((-25, 0), (25, 0))
    there = thread[200:].copy()
    there[:, 1] += 2.0 * 200.0 / rig.focal
    both = views(rig, there, np.gradient(there, axis=0))
    seen = np.ones(len(there), bool)
    others = Strand.other(both[0], seen), Strand.other(both[1], seen)
    found = flags(rig, paint(rig, [thread], 0), thread, others)
    assert found[55:].all()
    assert not found[:45].any()


def test_an_arc_does_not_slip_onto_the_line_that_cuts_it(rig: StereoRig) -> None:
    stray = line((-40, 1.0), (40, 2.0))
    stray[:, 2] = 204.0
    tracker, held = Tracker(rig), 0
    for i in range(60):
        truth = line((-25, -4.0), (25, -4.0), 6.5 + 0.5 * np.sin(3 * i / FPS))
        field = paint(rig, [truth, stray] if i else [truth], i)
        if i == 0:
            u, v = rig.project_raw(truth[60])[0]
            tracker.seed(Seed("0", pixel=(float(u), float(v))))
        state = tracker.step(field).states[0]
        assert state.curve is not None
        off = metrics.curve_error(nurbs.evaluate(state.curve, np.linspace(0, 1, 400)), truth)
        if state.status is Status.TRACKING:
            held += 1
            assert off.p95 < 1.0
    assert held > 50

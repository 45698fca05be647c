"""Where the thread is not alone, and what is made of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_offsets
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.tracking import Tracker, TrackingConfig, gauss_newton
from suturetrack.tracking.crowding import covered, crowded
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import NOBODY, Neighbour, Neighbours, Strand
from suturetrack.types import Seed, Stamp, Status, StereoFrame, ThreadState, Truth
from tests.painting import FPS, paint, seed_at

LEVELS = (0.8, 0.8)


def line(start: tuple[float, float], stop: tuple[float, float], bulge: float = 0.0) -> np.ndarray:
    """(400, 3) points of a line or an arc, 200 away."""
    t = np.linspace(0, 1, 400)[:, None]
    flat = np.array(start) * (1 - t) + np.array(stop) * t
    flat[:, 1] += bulge * np.sin(np.pi * t[:, 0])
    return np.c_[flat, np.full(400, 200.0)]


def images_of(rig: StereoRig, threads: list[np.ndarray]) -> Images:
    return Images(paint(rig, threads, 0), rig, LEVELS)


def flags(images: Images, points: np.ndarray, others: Neighbours = NOBODY) -> np.ndarray:
    points = points[::4]
    both = views(images.rig, points, np.gradient(points, axis=0) * len(points))
    return crowded(both, np.full(len(points), 1 / len(points)), images, others).others


def hook(radius: float, lift: float) -> np.ndarray:
    """(n, 3) points of a thread that turns back and crosses itself with its last stretch."""
    angle, t = np.linspace(-np.pi / 2, np.pi / 2, 120), np.linspace(0, 1, 300)
    out = np.c_[np.linspace(-30, 15, 240), np.zeros(240)]
    turn = radius * np.c_[np.cos(angle), 1 + np.sin(angle)] + [15, 0]
    back = np.c_[15 - 44 * t, 2 * radius - (2 * radius - lift) * t**2]
    flat = np.concatenate([out, turn[1:], back[1:]]) + np.array([5, -6])
    travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(flat, axis=0), axis=1))]
    at = np.arange(0, 44 + np.pi * radius + 44, 0.25)
    return np.c_[[np.interp(at, travelled, c) for c in flat.T]].T @ np.eye(2, 3) + [0, 0, 200]


def test_a_thread_on_its_own_is_alone(rig: StereoRig) -> None:
    thread = line((-25, 0), (25, 3), 6.0)
    assert not flags(images_of(rig, [thread]), thread).any()


def test_a_ridge_that_crosses_at_a_shallow_angle_crowds_the_thread_where_both_are_near(
    rig: StereoRig,
) -> None:
    thread, stray = line((-25, 0), (25, 0)), line((-25, -6), (25, 6))
    found = flags(images_of(rig, [thread, stray]), thread)
    away = np.abs(rig.focal / 200.0 * (stray - thread)[::4, 1])
    assert found[away < 4.0].all()
    assert not found[away > 9.0].any()


def test_a_known_strand_crowds_the_thread_although_both_are_one_ridge(rig: StereoRig) -> None:
    thread = line((-25, 0), (25, 0))
    there = thread[200:].copy()
    there[:, 1] += 2.0 * 200.0 / rig.focal
    both = views(rig, there, np.gradient(there, axis=0))
    seen = np.ones(len(there), bool)
    others = Neighbours((Neighbour(Strand.other(both[0], seen), Strand.other(both[1], seen)),))
    found = flags(images_of(rig, [thread]), thread, others)
    assert found[55:].all()
    assert not found[:45].any()


def test_a_known_strand_that_the_field_does_not_show_leaves_the_thread_alone(
    rig: StereoRig,
) -> None:
    thread, other = line((-25, 0), (25, 0)), line((-25, -6), (25, 6))
    both = views(rig, other, np.gradient(other, axis=0))
    strands = tuple(Strand.other(view, np.ones(len(other), bool)) for view in both)
    known = Neighbours((Neighbour(strands[0], strands[1]),))
    alone, beside = images_of(rig, [thread]), images_of(rig, [thread, other])
    assert known.shown_in(alone).threads == ()
    assert known.shown_in(beside).threads == known.threads
    assert flags(beside, thread, known.shown_in(beside)).any()
    assert not flags(alone, thread, known.shown_in(alone)).any()
    samples = views(rig, thread, np.gradient(thread, axis=0) * len(thread))
    hidden = covered(samples, known)
    away = np.abs(rig.focal / 200.0 * (other - thread)[:, 1])
    assert hidden[away < 3.0].all()
    assert not hidden[away > 6.0].any()


def test_an_arc_does_not_slip_onto_the_line_that_cuts_it(rig: StereoRig) -> None:
    stray = line((-40, 1.0), (40, 2.0))
    stray[:, 2] = 204.0
    tracker, held = Tracker(rig), 0
    for i in range(60):
        truth = line((-25, -4.0), (25, -4.0), 6.5 + 0.5 * np.sin(3 * i / FPS))
        field = paint(rig, [truth, stray] if i else [truth], i)
        if i == 0:
            tracker.seed(seed_at(rig, truth[60]))
        state = tracker.step(field).states[0]
        assert state.curve is not None
        off = metrics.curve_error(nurbs.evaluate(state.curve, np.linspace(0, 1, 400)), truth)
        if state.status is Status.TRACKING:
            held += 1
            assert off.p95 < 1.0
    assert held > 50


def test_a_tip_beside_its_own_thread_crowds_it_and_a_loop_does_not(rig: StereoRig) -> None:
    thread = hook(3.0, -1.0)
    found = flags(images_of(rig, [thread]), thread)
    away = rig.focal / 200.0 * np.abs(thread[::4, 1] - thread[0, 1])
    tip = np.flatnonzero((away > 4.5) & (np.arange(len(away)) > len(away) / 2))[-1]
    assert found[tip + 3 :].all()
    assert not found[:tip].any()


def test_what_the_views_show_differently_beside_another_thread_tells_no_depth(
    rig: StereoRig,
) -> None:
    thread = line((-15, -15), (15, 15))
    moved = thread + np.array([0.15, -0.15, 1.5])
    knots = nurbs.clamped_knots(np.linspace(0, 1, 12)[1:-1], 3)
    before = nurbs.fit(thread, np.linspace(0, 1, len(thread)), knots, 3)
    images = Images(paint(rig, [moved], 0, noise=0.0), rig, LEVELS)
    both = views(rig, thread, np.gradient(thread, axis=0))
    beside = (replace(view, pixels=view.pixels + view.normals) for view in both)
    left, right = (Strand.other(view, np.ones(len(thread), bool)) for view in beside)
    shares = []
    for others in (NOBODY, Neighbours((Neighbour(left, right),))):
        curve = before
        for _ in range(20):
            fit = gauss_newton.fit(curve, curve, images, 5.0, TrackingConfig(), others)
            assert fit.crowd.others.all() == bool(others.threads)
            curve = fit.curve
        step = nurbs.evaluate(curve, np.array([0.5])) - nurbs.evaluate(before, np.array([0.5]))
        across = (step[0, :2] @ [1, -1]) / 0.3
        shares.append((across, step[0, 2] / 1.5))
    np.testing.assert_allclose(shares[0], 1.0, atol=0.1)
    assert shares[1][0] > 0.7
    assert shares[1][1] < 0.3


def followed(scene: Scene, count: int) -> Iterator[tuple[ThreadState, Truth]]:
    """The states of a scene's first thread, which alone is seeded, and its truth, in so many fields."""
    segmenter, tracker, thread = Segmenter(scene.rig), Tracker(scene.rig), scene.threads[0]
    for i in range(count):
        frame = StereoFrame(Stamp(i, round(i * 1e9 / FPS), 0), *scene.render(i))
        if i == 0:
            seed = Seed(thread, pixel=scene.seed_pixel(0, thread))
            segmenter.learn(frame, seed)
            tracker.seed(seed)
        (state,) = tracker.step(segmenter.step(frame)).states
        yield state, scene.truth(i)[0]


def distances(state: ThreadState, truth: Truth) -> np.ndarray:
    """(200,) from points of the curve to the true thread, calibration's unit."""
    assert state.curve is not None
    curve = nurbs.evaluate(state.curve, np.linspace(0, 1, 200))
    return np.linalg.norm(polyline_offsets(curve, truth.points), axis=1)


def test_strands_that_make_one_ridge_do_not_bend_an_arm_that_shows_no_depth() -> None:
    """The arms of this knot run along one another, and one of them goes on along an epipolar line."""
    scene = open_scene("knot", 423, "endoscope")
    states = list(followed(scene, 45))
    apart = [distances(state, truth) for state, truth in states]
    assert np.percentile(apart, 95) * scene.rig.mm_per_unit < 1.5
    lengths = [state.length / truth.length for state, truth in states]
    np.testing.assert_allclose(lengths, 1.0, atol=0.025)


def test_a_thread_in_sight_is_not_found_again_as_another_one_of_its_length() -> None:
    """Another one as long, which is not seeded, moves over it, so that it is in doubt for a moment."""
    scene = open_scene("two-threads", 5267)
    tracked = [s for s in followed(scene, 132) if s[0].status is Status.TRACKING]
    assert len(tracked) > 40
    assert max(distances(*s).max() for s in tracked) * scene.rig.mm_per_unit < 2.0


@pytest.mark.parametrize(("radius", "depth"), [(6.0, 4.0), (4.0, 6.0), (3.0, 4.0)])
def test_a_tip_that_crosses_its_own_thread_at_a_shallow_angle_is_held(
    rig: StereoRig, radius: float, depth: float
) -> None:
    """By most draws of the noise: of 30, three lost it."""
    held = [_holds_the_tip(rig, radius, depth, draw) for draw in range(3)]
    assert sum(held) >= 2


def _holds_the_tip(rig: StereoRig, radius: float, depth: float, draw: int) -> bool:
    tracker, apart, held = Tracker(rig), [], 0
    for i in range(150):
        truth = hook(radius, 4.0 - 2 * depth * np.sin(np.pi * i / 150) ** 2)
        field = paint(rig, [truth], i + 1000 * draw)
        if i == 0:
            tracker.seed(seed_at(rig, truth[60]))
        state = tracker.step(field).states[0]
        assert state.curve is not None
        ends = nurbs.evaluate(state.curve, np.array([0.0, 1.0]))
        apart.append(np.linalg.norm(ends - truth[-1], axis=1).min())
        held += state.status is Status.TRACKING
    return max(apart) < 1.2 and held > 140

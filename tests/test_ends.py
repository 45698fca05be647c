from dataclasses import replace

import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.metrics import polyline_length
from suturetrack.segmentation import Segmenter
from suturetrack.stage import open_scene
from suturetrack.tracking.ends import EndStep, EndWatch, find_end
from suturetrack.tracking.follower import measure_levels
from suturetrack.types import Nurbs, Seed, Stamp, StereoFrame

FRAME_NS = 33_000_000
PIXEL = 0.0025


def curve_through(points: np.ndarray) -> Nurbs:
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    knots = nurbs.clamped_knots(np.linspace(0, 1, 25)[1:-1], 3)
    return nurbs.fit(points, travelled / polyline_length(points), knots, 3)


def step_at(offset_px: float) -> EndStep:
    return EndStep(offset_px, PIXEL, at_border=False)


def settled_watch(length: float) -> tuple[EndWatch, int]:
    watch, now = EndWatch(length, 0), 0
    for _ in range(40):
        now += FRAME_NS
        assert watch.moves(step_at(0.0), step_at(0.0), length, now) == (0.0, 0.0)
    assert watch.settled
    return watch, now


def test_ends_are_found_without_bias_in_what_the_filter_shows() -> None:
    offsets = []
    for seed in range(3):
        scene = open_scene("figure8-107", seed)
        segmenter = Segmenter(scene.rig)
        frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
        segmenter.learn(frame, Seed(pixel=scene.seed_pixel(0)))
        field = segmenter.step(frame)
        curve = curve_through(scene.truth(0)[0].points)
        levels = measure_levels(curve, field, scene.rig)
        for end in (0, 1):
            found = find_end(curve, end, field, scene.rig, levels)
            assert found is not None
            offsets.append(found.offset_px)
    assert np.abs(offsets).max() < 1.0
    assert abs(np.mean(offsets)) < 0.2


def test_an_end_beside_another_ridge_only_makes_good_what_is_lacking() -> None:
    watch, now = settled_watch(100.0)
    beside = replace(step_at(8.0), alone=False)
    assert watch.moves(step_at(0.0), beside, 100.0, now + FRAME_NS) == (0.0, 0.0)
    assert watch.seen == (True, False)
    start, stop = watch.moves(step_at(0.0), beside, 99.0, now + 2 * FRAME_NS)
    assert start == 0.0
    assert stop == pytest.approx(100 / 99 - 1)
    _, stop = watch.moves(step_at(0.0), beside, 90.0, now + 3 * FRAME_NS)
    assert stop == pytest.approx(8 * PIXEL)


def test_a_loop_that_is_drawn_shut_moves_no_end() -> None:
    watch, now = settled_watch(100.0)
    for _ in range(10):
        now += FRAME_NS
        assert watch.moves(step_at(0.2), step_at(-0.3), 88.0, now) == (
            0.2 * PIXEL,
            -0.3 * PIXEL,
        )
        assert watch.seen == (True, True)
    assert watch.length == pytest.approx(88.0, rel=1e-3)


def test_an_end_that_steps_off_is_held_where_it_was() -> None:
    watch, now = settled_watch(100.0)
    start, stop = watch.moves(step_at(0.0), step_at(-30.0), 100.0, now + FRAME_NS)
    assert start == 0.0
    assert stop == pytest.approx(0.0)
    assert watch.seen == (True, False)

"""How exact curves are said to be: of pictures that a camera has compressed, and of knots."""

from __future__ import annotations

import numpy as np
import pytest

from suturetrack.nurbs import evaluate
from suturetrack.polylines import polyline_distances
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.stage.appearance import Picture
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.types import Seed, Stamp, Status, StereoFrame


def learned(scene: Scene) -> Segmenter:
    segmenter, thread = Segmenter(scene.rig), scene.threads[0]
    segmenter.learn(frame(scene, 0), Seed(thread, pixel=scene.seed_pixel(0, thread)))
    return segmenter


def frame(scene: Scene, index: int) -> StereoFrame:
    return StereoFrame(Stamp(index, round(index * 1e9 / scene.fps), 0), *scene.render(index))


@pytest.mark.parametrize("jpeg", [None, 90, 80])
@pytest.mark.parametrize(
    ("rig", "name", "number"),
    [
        ("bench", "figure8-107", 5130),
        ("endoscope", "figure8-175", 5131),
        ("bench", "occlusion", 5132),
    ],
)
def test_the_stated_deviation_is_that_of_the_curve(
    rig: str, name: str, number: int, jpeg: int | None
) -> None:
    scene = open_scene(name, number, rig, picture=Picture(jpeg=jpeg))
    segmenter, tracker = learned(scene), Tracker(scene.rig, TrackingConfig())
    tracker.seed(Seed(scene.threads[0], pixel=scene.seed_pixel()))
    ratios = []
    for i in range(8):
        (state,) = tracker.step(segmenter.step(frame(scene, i))).states
        assert state.status is Status.TRACKING
        assert state.curve is not None
        points = evaluate(state.curve, np.linspace(0, 1, len(state.sigma)))
        away = polyline_distances(points, scene.truth(i)[0].points)
        inner = state.seen & (abs(np.linspace(-1, 1, len(away))) < 0.9)
        ratios.append(np.sqrt(np.mean((away / state.sigma)[inner] ** 2)))
    assert 0.15 < np.median(ratios) < 1.0


@pytest.mark.parametrize("number", [5241, 5242])
def test_strands_of_a_knot_that_draw_each_other_aside_are_no_noise(number: int) -> None:
    scene = open_scene("knot", number, "endoscope")
    segmenter, tracker = learned(scene), Tracker(scene.rig, TrackingConfig())
    tracker.seed(Seed(scene.threads[0], pixel=scene.seed_pixel()))
    (state,) = tracker.step(segmenter.step(frame(scene, 0))).states
    assert state.status is Status.TRACKING
    assert np.sqrt(np.mean(state.sigma**2)) * scene.rig.mm_per_unit < 1.0

"""Pictures that a camera has compressed: what is learned of their colours, and how sure curves are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from suturetrack.nurbs import evaluate
from suturetrack.polylines import polyline_distances, unit
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.stage.appearance import Picture
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.types import Bool, Float32, Float64, Seed, Stamp, Status, StereoFrame


def learned(scene: Scene) -> Segmenter:
    segmenter, thread = Segmenter(scene.rig), scene.threads[0]
    segmenter.learn(frame(scene, 0), Seed(thread, pixel=scene.seed_pixel(0, thread)))
    return segmenter


def frame(scene: Scene, index: int) -> StereoFrame:
    return StereoFrame(Stamp(index, round(index * 1e9 / scene.fps), 0), *scene.render(index))


def beside(field: Float32, pixels: Float64) -> tuple[Float64, Bool]:
    """By how much further right the response lies than the thread, px, and whether that is across."""
    normal = unit(np.gradient(pixels, axis=0))[:, ::-1] * (-1, 1)
    offsets = np.arange(-4, 4.1, 0.125)
    around = (pixels[:, None] + offsets[:, None] * normal[:, None]).astype(np.float32)
    profile = cv2.remap(np.linalg.norm(field, axis=-1), around, None, cv2.INTER_LINEAR)
    return offsets[profile.argmax(1)] * np.sign(normal[:, 0]), abs(normal[:, 0]) > 0.5


@pytest.mark.parametrize(
    ("rig", "name", "number", "most_px"),
    [
        ("endoscope", "occlusion", 5082, 0.45),
        ("bench", "occlusion", 5082, 0.39),
        ("bench", "figure8-175", 5083, 0.55),
        ("bench", "two-threads", 5081, 0.6),
    ],
)
def test_a_mix_is_learned_in_which_both_views_show_the_same(
    rig: str, name: str, number: int, most_px: float
) -> None:
    """Colours of half the resolution, coarsely quantised, are as distinct as before, and uneven."""
    scene = open_scene(name, number, rig, picture=Picture(jpeg=80))
    field = learned(scene).step(frame(scene, 0))
    views = scene.rig.project(scene.truth(0)[0].points)
    (left, across), (right, _) = map(beside, (field.left, field.right), views)
    assert np.sqrt(np.mean(np.minimum((left - right)[across] ** 2, 4))) < most_px


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
    assert 0.25 < np.median(ratios) < 1.25

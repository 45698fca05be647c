"""The bench top: the truth is exact, the images show it, and nothing is left to chance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from suturetrack.stage import RIGS, SCENARIOS, Picture, Scene, open_scene
from suturetrack.types import Float64, Image, InputError


def centre_offsets(image: Image, pixels: Float64) -> Float64:
    """Signed distances from (N, 2) pixels, across their path, to the dark line seen in the image.

    The middle between the two places where the profile has fallen halfway to its darkest value.
    """
    tangent = np.gradient(pixels, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    d = np.arange(-7, 7.01, 0.1)
    places = (pixels[:, None] + d[None, :, None] * normal[:, None]).astype(np.float32)
    red = image[..., 2].astype(np.float32)
    profile = cv2.remap(red, places, None, cv2.INTER_CUBIC).astype(float)
    ground = np.median(profile[:, np.abs(d) > 5], axis=1)
    dark = profile < ((ground + profile[:, np.abs(d) < 3].min(1)) / 2)[:, None]
    dark[:, np.abs(d) > 5] = False
    first, last = dark.argmax(1), dark.shape[1] - 1 - dark[:, ::-1].argmax(1)
    return (d[first] + d[last]) / 2


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_scene("figure8-175", seed=2)


@pytest.mark.parametrize("rig", RIGS)
def test_truth_lies_on_the_rendered_thread(rig: str) -> None:
    picture = Picture(thread="black", background="plain", shadow=0.0)
    errors = []
    for seed in range(4):
        scene = open_scene("figure8-107", seed, rig, picture=picture)
        truth = scene.truth(300)[0]
        views = zip(scene.render(300), scene.rig.project_raw(truth.points), strict=True)
        errors += [np.abs(centre_offsets(image, pixels)[8:-8]).mean() for image, pixels in views]
    assert np.mean(errors) < 0.1


@pytest.mark.parametrize("length", [107, 175, 200])
def test_length_is_exact_in_every_frame(length: int) -> None:
    scene = open_scene(f"figure8-{length}", seed=length)
    for i in range(0, scene.frame_count, 60):
        truth = scene.truth(i)[0]
        chords = np.linalg.norm(np.diff(truth.points, axis=0), axis=1)
        assert chords.sum() == pytest.approx(length, abs=1e-9)
        assert truth.length == pytest.approx(length, abs=1e-9)
        assert truth.visible.all()


def test_same_seed_gives_the_same_images_and_another_seed_others(scene: Scene) -> None:
    first = scene.render(5)
    scene.render(6)
    for again in (scene.render(5), open_scene("figure8-175", seed=2).render(5)):
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    other = open_scene("figure8-175", seed=3)
    assert np.abs(other.render(5)[0].astype(int) - first[0]).mean() > 10
    assert np.abs(other.truth(5)[0].points - scene.truth(5)[0].points).mean() > 1


def test_held_end_runs_no_faster_than_the_stage_and_the_other_stays(scene: Scene) -> None:
    ends = np.array([scene.truth(i)[0].points[[0, -1]] for i in range(0, scene.frame_count, 3)])
    speed = np.linalg.norm(np.diff(ends, axis=0), axis=2) * scene.fps / 3
    assert speed[:, 0].max() < 0.05
    assert 7 < speed[:, 1].max() < 11.1


def test_thread_stands_out_of_the_plane(scene: Scene) -> None:
    points = scene.truth(0)[0].points
    centred = points - points.mean(0)
    assert np.ptp(centred @ np.linalg.svd(centred)[2][2]) > 2


def test_seed_pixel_is_on_the_thread(scene: Scene) -> None:
    pixels = scene.rig.project_raw(scene.truth(40)[0].points)[0]
    assert np.linalg.norm(pixels - scene.seed_pixel(40), axis=1).min() < 1e-9


def test_unknown_names_are_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=f"no scenario 'figure9'.*{', '.join(SCENARIOS)}"):
        open_scene("figure9")
    with pytest.raises(InputError, match=f"no rig 'desk'.*{', '.join(RIGS)}"):
        open_scene("figure8-107", rig="desk")
    with pytest.raises(InputError, match="seed -1"):
        open_scene("figure8-107", seed=-1)
    with pytest.raises(InputError, match=r"no look 'green'.*violet"):
        open_scene("figure8-107", picture=Picture(thread="green"))
    with pytest.raises(InputError, match="no thread 'b'; use one of 0"):
        open_scene("figure8-107").seed_pixel(0, "b")

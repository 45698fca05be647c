"""The bench top: the truth is exact, the images show it, and nothing is left to chance."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from suturetrack.stage import RIGS, SCENARIOS, Picture, Scene, contact_sheet, open_scene
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


def test_seed_pixel_is_on_the_thread_and_clear_of_other_strands() -> None:
    scene = open_scene("two-threads", 5)
    lines = {t.thread: scene.rig.project_raw(t.points)[0] for t in scene.truth(40)}
    for own, other in (("0", "1"), ("1", "0")):
        seed = scene.seed_pixel(40, own)
        assert np.linalg.norm(lines[own] - seed, axis=1).min() < 1e-9
        assert np.linalg.norm(lines[other] - seed, axis=1).min() > 9


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


@pytest.mark.parametrize("size", [(63, 64), (9000, 64), (64, 100_000)])
def test_images_that_no_message_can_carry_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(
        InputError, match=f"images of {size[0]}x{size[1]} .*: use sides of 64 to 8192"
    ):
        open_scene("figure8-107", picture=Picture(size=size))


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_shows_its_threads(name: str, rig: str) -> None:
    scene = open_scene(name, 1, rig)
    assert scene.frame_count == 600
    for i in (0, 450):
        images = scene.render(i)
        assert all(image.shape == (480, 640, 3) and image.std() > 10 for image in images)
        for truth, model in zip(scene.truth(i), SCENARIOS[name].threads, strict=True):
            assert truth.points[:, 2].min() > 50
            assert truth.visible.mean() > (0.3 if SCENARIOS[name].end_leaves else 0.6)
            if model.length is not None:
                assert truth.length == pytest.approx(model.length, abs=1e-9)
    u, v = scene.seed_pixel(0)
    assert 0 <= u < 640
    assert 0 <= v < 480


def test_gripper_hides_the_middle_then_the_moving_end() -> None:
    scene = open_scene("occlusion", seed=3)
    hidden = np.array([~scene.truth(i)[0].visible for i in range(0, 600, 15)])
    count = hidden.shape[1]
    middle = hidden[:, int(0.4 * count) : int(0.6 * count)].any(axis=1)
    end = hidden[:, -3:].all(axis=1)
    assert 2 <= middle.sum() < 12
    assert 2 <= end.sum() < 12
    assert np.flatnonzero(middle)[0] < np.flatnonzero(end)[0]
    assert not hidden[0].any()


def test_hidden_points_look_like_the_gripper() -> None:
    scene = open_scene("occlusion", 3, picture=Picture(thread="violet", background="marbled"))
    truth, (left, _) = scene.truth(165)[0], scene.render(165)
    u, v = scene.rig.project_raw(truth.points)[0].round().astype(int).T
    saturation = np.ptp(left[v, u].astype(int), axis=1)
    core = np.convolve(~truth.visible, np.ones(9), mode="same") == 9
    assert core.sum() > 3
    assert saturation[core].mean() < 40 < saturation[truth.visible].mean()


def test_thread_comes_out_of_the_hole() -> None:
    scene = open_scene("pull-through", seed=1)
    truths = [scene.truth(i)[0] for i in range(0, 600, 30)]
    lengths = np.array([t.length for t in truths])
    assert lengths[-1] > lengths[0] + 10
    starts = np.array([t.points[0] for t in truths])
    assert np.ptp(starts, axis=0).max() < 2.5


def test_end_leaves_the_images_and_comes_back() -> None:
    scene = open_scene("leaves-view", seed=0)
    seen = np.array([scene.truth(i)[0].visible[-1] for i in range(0, 600, 10)])
    assert seen[0]
    assert 5 < (~seen).sum() < 50
    assert seen[np.flatnonzero(~seen)[0] :].any()


def test_fast_thread_is_blurred_along_its_way() -> None:
    still, moving = (
        open_scene("fast", 0, picture=Picture(thread="black", shutter=shutter, noise=0.0))
        for shutter in (0.0, 0.5)
    )
    i = max(range(60, 240), key=lambda k: speed_px(still, k))
    assert speed_px(still, i) > 15
    end = still.rig.project_raw(still.truth(i)[0].points)[0][-40:].round().astype(int)
    sharp, blurred = (s.render(i)[0][end[:, 1], end[:, 0]].mean() for s in (still, moving))
    assert blurred > sharp + 10


def speed_px(scene: Scene, i: int) -> float:
    ends = [scene.rig.project_raw(scene.truth(k)[0].points)[0][-1] for k in (i, i + 1)]
    return float(np.linalg.norm(ends[1] - ends[0]))


def test_pictures_follow_their_settings() -> None:
    def left(**settings: object) -> Image:
        scene = open_scene("figure8-107", 4, picture=Picture(**settings))  # type: ignore[arg-type]
        return scene.render(10)[0].astype(int)

    plain = {"background": "plain", "noise": 0.0, "drift": 0.0, "vignetting": 0.0, "shadow": 0.0}
    clean = left(**plain)
    corner = (slice(0, 40), slice(0, 40))
    assert clean[corner].std(axis=(0, 1)).max() < 0.5
    assert left(**plain | {"noise": 4.0})[corner].std(axis=(0, 1)) == pytest.approx(4.0, rel=0.1)
    assert left(**plain | {"vignetting": 0.4})[0, 0].mean() < 0.65 * clean[0, 0].mean()
    compressed = left(**plain | {"jpeg": 30})
    assert 0 < np.abs(compressed - clean).mean() < 3
    dark = {name: left(**plain | {"thread": name}).min() for name in ("black", "undyed")}
    assert dark["black"] < 60 < dark["undyed"]


def test_size_and_rate_change_the_sampling_not_the_scene(scene: Scene) -> None:
    large = open_scene("figure8-175", seed=2, fps=60.0, picture=Picture(size=(1280, 720)))
    assert large.render(20)[1].shape == (720, 1280, 3)
    assert large.frame_count == 1200
    assert large.rig.focal == pytest.approx(1600)
    assert large.truth(20)[0].points[-1] == pytest.approx(scene.truth(10)[0].points[-1], abs=30)


def test_miscalibrated_cameras_show_the_thread_beside_the_projection() -> None:
    look = Picture(thread="black", background="plain", shadow=0.0)

    def error(**settings: float) -> float:
        scene = open_scene("figure8-107", 2, picture=replace(look, **settings))  # type: ignore[arg-type]
        pixels = scene.rig.project_raw(scene.truth(0)[0].points)[0]
        return float(np.abs(centre_offsets(scene.render(0)[0], pixels)[8:-8]).mean())

    assert error() < 0.1
    assert 0.25 < error(half_pixel=True) < 0.75
    assert 0.15 < error(calibration_error_px=1.0) < 4


def test_distorted_lenses_show_the_thread_where_the_calibration_says() -> None:
    look = Picture(thread="black", background="plain", shadow=0.0, distortion=-0.3)
    scene = open_scene("figure8-107", 2, picture=look)
    straight = open_scene("figure8-107", 2, picture=replace(look, distortion=0.0))
    pixels = scene.rig.project_raw(scene.truth(0)[0].points)[0]
    assert np.abs(centre_offsets(scene.render(0)[0], pixels)[8:-8]).mean() < 0.1
    assert np.abs(centre_offsets(straight.render(0)[0], pixels)[8:-8]).max() > 1
    with pytest.raises(InputError, match=r"picture.distortion 3: use -0\.5 to 0\.5"):
        open_scene("figure8-107", picture=replace(look, distortion=3))


def test_a_gripper_beside_the_view_is_not_folded_into_it_by_a_barrel_lens() -> None:
    """Steel that shines would cover a thirtieth of the picture."""
    scene = open_scene("grasped", 6311, picture=Picture(distortion=-0.25))
    for view in scene.render(0):
        assert (view.min(axis=2) > 200).mean() < 0.01
    assert scene.truth(0)[0].visible.all()


def test_contact_sheet_has_a_row_for_each_scenario() -> None:
    sheet = contact_sheet(["figure8-107"], "endoscope", 1)
    assert sheet.shape == (240, 1280, 3)
    assert sheet[:, :320].std() > 10
    assert np.abs(sheet[:, :320].astype(int) - sheet[:, 320:640]).mean() > 1

"""Threads that move fast: where they are looked for, and what is taken for their smears."""

from __future__ import annotations

import numpy as np
import pytest

from services.adaptation import follow
from services.bench.tracking import Case, run_case
from suturetrack import nurbs
from suturetrack.kernels import smears
from suturetrack.segmentation import Segmenter
from suturetrack.segmentation.shutter import SLOWEST_PX, Shutter
from suturetrack.segmentation.smear import Band, Course
from suturetrack.stage import Scene, open_scene
from suturetrack.types import (
    Energies,
    Float64,
    Image,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
)
from tests.conftest import make_rig
from tests.reference import segmentation as reference

FRAME_NS = 33_333_333
PLACES = 64
WATCHED = 30
"""Frames for which a segmenter has looked at a thread."""


@pytest.mark.parametrize("size", [(12, 16), (13, 17)])
def test_the_longer_vectors_of_half_the_size_are_their_literal_twins(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    height, width = size
    half = rng.normal(0, 0.3, ((height + 1) // 2, (width + 1) // 2, 2)).astype(np.float32)
    field = rng.normal(0, 0.1, (height, width, 2)).astype(np.float32)
    mask = (rng.random(size) < 0.7).astype(np.uint8)
    dark = (rng.random(half.shape[:2]) < 0.2).astype(np.uint8)
    before, asked = field.copy(), np.count_nonzero(mask)
    twin, left = reference.keep_longer_of_half(half, dark, (0.24, 0.36), mask, field)
    smears.keep_longer_of_half(half, dark, (0.24, 0.36), mask, field)
    np.testing.assert_allclose(field, twin, atol=1e-5)
    np.testing.assert_array_equal(mask, left)
    assert 0 < np.count_nonzero((field != before).any(-1)) < np.count_nonzero(left) < asked


def test_long_vectors_are_found() -> None:
    vectors = np.random.default_rng(4).normal(0, 0.3, (7, 9, 2)).astype(np.float32)
    found = np.full((7, 9), 7, np.uint8)
    smears.find_longer_than(0.4, vectors, found)
    np.testing.assert_array_equal(found, np.linalg.norm(vectors, axis=2) > 0.4)
    assert 0 < found.mean() < 1


def line(u: float) -> Float64:
    """A thread straight down the image, at a depth of 100."""
    rig = make_rig()
    z, v = 100.0, np.linspace(100, 300, PLACES)
    cx, cy = rig.left.projection[0, 2], rig.left.projection[1, 2]
    points = [(u - cx) * z / rig.focal + 0 * v, (v - cy) * z / rig.focal, z + 0 * v]
    return np.stack(points, axis=1)


def course(*steps: float) -> Course:
    """A thread that moves to the right by so many px from frame to frame."""
    moving = Course()
    for frame, u in enumerate(200 + np.cumsum(steps)):
        moving.learn(frame * FRAME_NS, line(u))
    return moving


def test_a_band_goes_where_the_thread_is_going() -> None:
    bands = course(0, 10, 10, 10).bands(5 * FRAME_NS, make_rig())
    assert bands is not None
    left, right = bands
    np.testing.assert_allclose(left.pixels[:, 0], 250, atol=1e-6)
    np.testing.assert_allclose(left.steps, 10, atol=1e-6)
    np.testing.assert_allclose(right.steps, 10, atol=1e-6)


def test_what_was_fast_a_moment_ago_may_be_so_again() -> None:
    bands = course(0, 12, 3, 0).bands(5 * FRAME_NS, make_rig())
    assert bands is not None
    np.testing.assert_allclose(bands[0].steps, 12, atol=1e-6)
    assert course(0, 12, 3, 0).bands(20 * FRAME_NS, make_rig()) is None


def test_a_curve_that_may_have_come_late_does_not_count() -> None:
    """Else the same frames would not always give the same fields."""
    rig = make_rig()
    early, late = (course(*steps).bands(4 * FRAME_NS, rig) for steps in ((0, 5, 5), (0, 5, 5, 30)))
    assert early is not None
    assert late is not None
    np.testing.assert_array_equal(early[0].pixels, late[0].pixels)
    np.testing.assert_array_equal(early[0].steps, late[0].steps)


def test_time_that_jumps_back_begins_a_new_course() -> None:
    moving = course(0, 10, 10, 10)
    moving.learn(FRAME_NS, line(200))
    assert moving.bands(4 * FRAME_NS, make_rig()) is None


def upright(u: float = 100.0) -> Float64:
    """(PLACES, 2) pixels straight down an image."""
    return np.stack([np.full(PLACES, u), np.linspace(20, 180, PLACES)], axis=1)


def test_a_band_is_empty_where_nothing_runs_along_it() -> None:
    pixels = upright()
    band = Band.of(pixels, pixels[None] - (8.0, 0.0), clear=5.0)
    field = np.zeros((200, 200, 2), np.float32)
    assert band.look_at(field).all()
    field[:, 120] = 0.4, 0.0
    assert band.look_at(field).all()
    field[:100, 120] = 0.0, 0.4
    assert list(np.flatnonzero(np.diff(band.look_at(field)))) == [
        int(np.searchsorted(pixels[:, 1], 99.5)) - 1
    ]
    mask = np.ones((200, 200), np.uint8)
    band.paint(np.zeros(PLACES, bool), mask)
    assert not mask.any()
    band.paint(pixels[:, 1] < 100, mask)
    assert mask[50, 80:120].all()
    assert not mask[50, :75].any()
    assert not mask[130:].any()


def test_only_what_is_faster_than_what_is_seen_is_smeared() -> None:
    pixels, nothing = upright(), np.zeros((200, 200, 2), np.float32)
    growing = pixels - np.linspace(0, 12, PLACES)[:, None] * (1.0, 0.0)
    for clear in (5.0, 9.0, np.inf):
        band = Band.of(pixels, growing[None], clear)
        np.testing.assert_array_equal(band.look_at(nothing), np.linspace(0, 12, PLACES) > clear)


def test_a_shutter_tells_smears_from_what_is_in_the_way() -> None:
    rng = np.random.default_rng(1)
    steps = rng.uniform(0, 20, 2000)
    hidden = rng.random(2000) < 0.3
    exposed, short = Shutter(), Shutter()
    assert exposed.fastest_clear == np.inf
    for some in np.split(np.arange(2000), 50):
        exposed.learn(steps[some], (steps[some] < 11.2) & ~hidden[some])
        short.learn(steps[some], ~hidden[some])
    assert exposed.fastest_clear == pytest.approx(11.2, abs=0.5)
    assert short.fastest_clear == np.inf


def test_a_shutter_forgets() -> None:
    """What was exposed longer a while ago may be exposed shorter by now."""
    shutter, steps = Shutter(), np.full(PLACES, 9.0)
    for _ in range(60):
        shutter.learn(steps, np.zeros(PLACES, bool))
    assert shutter.fastest_clear == SLOWEST_PX
    for _ in range(120):
        shutter.learn(steps, np.ones(PLACES, bool))
    assert shutter.fastest_clear == np.inf


def test_what_is_slow_says_nothing_of_the_shutter() -> None:
    shutter = Shutter()
    for _ in range(60):
        shutter.learn(np.full(PLACES, 4.0), np.zeros(PLACES, bool))
    assert shutter.fastest_clear == np.inf


@pytest.mark.parametrize("is_shown", [True, False])
def test_a_course_learns_from_what_was_shown_at_which_step(is_shown: bool) -> None:
    """Two curves later, when it is known how the thread really moved."""
    rig, moving = make_rig(), Course()
    field = np.zeros((rig.image_size[1], rig.image_size[0], 2), np.float32)
    field[..., 1] = 0.4 * is_shown
    smeared = []
    for frame in range(12):
        bands = moving.bands(frame * FRAME_NS, rig)
        if bands is not None:
            smeared.append([band.look_at(field).any() for band in bands])
        moving.learn(frame * FRAME_NS, line(200 + 10 * frame))
    assert not np.any(smeared[0])
    assert np.all(smeared[-1]) == np.any(smeared[-1]) == (not is_shown)


@pytest.fixture(scope="module")
def shaken() -> Scene:
    return open_scene("fast", 300)


def fields(
    scene: Scene, frame: int, told: bool, images: tuple[Image, Image] | None = None
) -> RidgeField:
    """The field of a frame, with or without knowing how the thread moved until then."""
    segmenter = Segmenter(scene.rig)
    segmenter.learn(frame_of(scene, 0), Seed(pixel=scene.seed_pixel()))
    for before in range(frame - WATCHED, frame) if told else ():
        segmenter.step(frame_of(scene, before))
        truth = scene.truth(before)[0].points
        places = np.linspace(0, len(truth) - 1, PLACES).astype(int)
        segmenter.follow(before * FRAME_NS, truth[places])
    return segmenter.step(frame_of(scene, frame, images))


def frame_of(scene: Scene, frame: int, images: tuple[Image, Image] | None = None) -> StereoFrame:
    return StereoFrame(Stamp(frame, frame * FRAME_NS, 0), *(images or scene.render(frame)))


def shown(scene: Scene, field: RidgeField, frame: int) -> tuple[Float64, Float64]:
    """Length of the vectors along the true thread, and everywhere."""
    length = np.linalg.norm(field.left, axis=2)
    u, v = np.rint(scene.rig.project(scene.truth(frame)[0].points)[0]).astype(int).T
    return length[v, u], length


def test_a_thread_that_moves_fast_shows_as_a_smear(shaken: Scene) -> None:
    frame = 119
    plain, told = (shown(shaken, fields(shaken, frame, told), frame) for told in (False, True))
    gained = (told[0] > 0.1) & (told[0] > 2 * plain[0])
    assert gained.mean() > 0.05
    changed = told[1] != plain[1]
    assert 0 < changed.mean() < 0.15


def test_a_thread_at_rest_is_seen_as_before() -> None:
    scene = open_scene("figure8-107", 3)
    plain, told = (fields(scene, 60, told) for told in (False, True))
    np.testing.assert_array_equal(plain.left, told.left)
    np.testing.assert_array_equal(plain.right, told.right)


def band_at(u: float, frame: int, width: float, halo: float, smear: int) -> StereoFrame:
    """A dark band straight down both images through `line(u)`, `halo` of whose depth reaches to 4.5 px from
    its middle, as shadows do, smeared by so many px."""
    rig, images = make_rig(), list[Image]()
    for pixels in rig.project(line(u)):
        beside = abs(np.arange(rig.image_size[0]) - pixels[0, 0])
        cover = (np.clip(half + 0.5 - beside, 0, 1) for half in (width / 2, 4.5))
        depth = np.maximum(*(share * c for share, c in zip((1, halo), cover, strict=True)))
        row = np.rint(160 - 100 * np.convolve(depth, np.ones(smear) / smear, "same"))
        images.append(np.tile(row.astype(np.uint8), (rig.image_size[1], 1)))
    return StereoFrame(Stamp(frame, frame * FRAME_NS, 0), images[0], images[1])


@pytest.mark.parametrize("width", [2.0, 3.0, 4.0, 5.0])
@pytest.mark.parametrize("halo", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("smear", [7, 9, 11])
def test_a_smear_shows_in_its_middle(width: float, halo: float, smear: int) -> None:
    """However wide the thread and the shadow beside it are."""
    segmenter, rows = Segmenter(make_rig()), slice(150, 250)
    for frame, u in enumerate(np.arange(180.0, 500.0, 2 * smear)):
        images = band_at(u, frame, width, halo, smear if frame else 1)
        if frame == 0:
            segmenter.learn(images, Seed(pixel=(u, 200.0)))
        field = segmenter.step(images)
        segmenter.follow(frame * FRAME_NS, line(u))
    across = np.linalg.norm(field.left[rows], axis=2).mean(axis=0)
    assert across.max() > 0.05
    assert abs(across.argmax() - u) <= 1


@pytest.mark.parametrize("width", [8, 10])
def test_what_is_dark_and_wide_is_no_smear(shaken: Scene, width: int) -> None:
    """A beam in the thread's way, of the colour of the thread: away from the thread it looks the same."""
    frame, first = 119, shaken.render(0)[0]
    u, v = np.rint(shaken.seed_pixel()).astype(int)
    ground = np.median(first[v - 30 : v + 30, u - 30 : u + 30].reshape(-1, 3), axis=0)
    place = shaken.rig.project(shaken.truth(frame)[0].points)[0]
    across, down = np.rint(place[9 * len(place) // 10]).astype(int)
    images = shaken.render(frame)
    for image in images:
        image[:, across - 40 : across + 40] = ground
        image[:, across - width // 2 : across + width // 2] = first[v, u]
    field = fields(shaken, frame, told=True, images=images)
    beam = np.linalg.norm(field.left[:, across - width // 2 : across + width // 2], axis=2)
    assert beam[down - 10 : down + 10].max() < beam[20:60].max() + 0.1


def test_a_shaken_thread_is_held() -> None:
    row = run_case(Case("fast", 300, seconds=6.0))[0]
    assert row.tracked_percent > 90
    assert row.false_percent < 1
    assert row.rms < 0.2


@pytest.mark.parametrize(
    ("status", "is_told"), [(Status.TRACKING, True), (Status.OCCLUDED, True), (Status.LOST, False)]
)
def test_only_what_is_held_tells_how_it_moves(shaken: Scene, status: Status, is_told: bool) -> None:
    frame, nothing = 119, np.zeros(PLACES)
    segmenter = Segmenter(shaken.rig)
    segmenter.learn(frame_of(shaken, 0), Seed(pixel=shaken.seed_pixel()))
    for before in range(frame - WATCHED, frame):
        segmenter.step(frame_of(shaken, before))
        truth = shaken.truth(before)[0].points
        knots = nurbs.clamped_knots(np.linspace(0, 1, 20)[1:-1], 3)
        curve = nurbs.fit(truth, np.linspace(0, 1, len(truth)), knots, 3)
        stamp, seen = Stamp(before, before * FRAME_NS, 0), np.ones(PLACES, bool)
        follow(segmenter, ThreadState(stamp, "0", status, curve, 1.0, Energies(), nothing, seen))
    field = segmenter.step(frame_of(shaken, frame))
    plain = fields(shaken, frame, told=False)
    assert np.any(field.left != plain.left) == is_told

"""A rough place finds the thread that is meant."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig, InitializationError
from suturetrack.snapping import (
    laser_spot,
    pixel_in_area,
    point_of_right_pixel,
    snap_area,
    snap_pixel,
    snap_point,
)
from suturetrack.stage import Picture, open_scene
from suturetrack.types import Image, InputError, RidgeField
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


def test_a_tool_tip_reaches_as_far_away_from_the_axis(rig: StereoRig) -> None:
    """Where a place in front of it is further aside in the images than one beside it."""
    upright = np.c_[np.full(601, 60.0), np.linspace(-40, 40, 601), np.full(601, 170.0)]
    field = paint(rig, [upright], 0)
    for angle in np.radians([0, 20, 40, 60]):
        tip = np.array([60.0 - 9.5 * np.cos(angle), 0.0, 170.0 + 9.5 * np.sin(angle)])
        found = snap_point(field, rig, tip, 10.0)
        assert found is not None
        assert off(upright, found) < 0.5


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


@pytest.mark.parametrize("wrong", ["nan", "-3", "641"])
def test_the_wrong_number_of_an_area_is_named(rig: StereoRig, wrong: str) -> None:
    area = (10.0, 20.0, float(wrong), 40.0)
    said = f"area 10 20 {wrong} 40: {wrong} is not within the 640x480 image"
    with pytest.raises(InputError, match=said):
        pixel_in_area(paint(rig, [], 0), rig, area)


def test_an_area_of_a_raw_image_gives_a_raw_pixel_on_the_thread(line: np.ndarray) -> None:
    """A rig whose raw images are distorted."""
    rig = open_scene("figure8-107", 0, picture=Picture(distortion=-0.2)).rig
    line = line - line.mean(axis=0) + [0.0, 0.0, 300.0]
    field = paint(rig, [line], 0)
    for right, pixels in enumerate(rig.project_raw(line)):
        (u, v), (x, y) = pixels[300] - 25, pixels[300] + 25
        found = pixel_in_area(field, rig, (u, y, x, v), right=bool(right))
        assert off(pixels, np.array(found)) < 0.6
        assert abs(np.array(found) - pixels[300]).max() < 26
    with pytest.raises(InputError, match="nothing in the area looks like thread"):
        pixel_in_area(field, rig, (0, 0, 30, 30))


RED, GREEN = (0.1, 0.15, 1.0), (0.15, 1.0, 0.1)


def lit(
    image: Image, at: tuple[float, float], colour: tuple[float, ...], power: float = 1500
) -> Image:
    """The image with a laser's spot, clipped in its core, with a halo; dark things reflect less."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    away = (u - at[0]) ** 2 + (v - at[1]) ** 2
    light = power * (np.exp(-away / 8) + 0.06 * np.exp(-away / 128))
    if image.ndim == 3:
        light = light[..., None] * np.array(colour)
    return np.clip(image + np.minimum(image / 160 + 0.1, 1) * light, 0, 255).astype(np.uint8)


def table(colour: bool = True) -> Image:
    """A rough gray ground with a dark thread, a bright wire, and a glossy plate."""
    noise = np.random.default_rng(0).normal(110, 12, (480, 640))
    image = cv2.GaussianBlur(noise, (0, 0), 1).astype(np.uint8)
    cv2.line(image, (0, 100), (639, 380), 40, 4, cv2.LINE_AA)
    cv2.line(image, (50, 470), (600, 430), 255, 3, cv2.LINE_AA)
    cv2.rectangle(image, (20, 20), (160, 90), 255, -1)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if colour else image


@pytest.mark.parametrize("colour", [RED, GREEN, None])
@pytest.mark.parametrize("at", [(250.3, 300.7), (320.0, 240.0), (600.0, 362.0), (5.0, 200.0)])
def test_a_laser_spot_is_found_on_the_thread_and_beside_it(
    colour: tuple[float, ...] | None, at: tuple[float, float]
) -> None:
    image = lit(table(colour is not None), at, colour or RED)
    assert np.linalg.norm(np.subtract(laser_spot(image), at)) < 1.0


def test_wires_plates_and_glossy_scenes_are_no_laser_spots() -> None:
    with pytest.raises(InputError, match="no laser spot in the image"):
        laser_spot(table())
    for name in ("figure8-175", "clutter", "pull-through", "two-threads"):
        with pytest.raises(InputError, match="laser"):
            laser_spot(open_scene(name, 100).render(0)[0])


@pytest.mark.parametrize(("name", "rig"), [("figure8-107", "bench"), ("figure8-175", "endoscope")])
def test_a_laser_spot_is_found_on_a_rendered_thread(name: str, rig: str) -> None:
    scene = open_scene(name, 101, rig)
    left, at = scene.render(0)[0], scene.seed_pixel(0)
    with pytest.raises(InputError, match="no laser spot in the image"):
        laser_spot(left)
    assert np.linalg.norm(np.subtract(laser_spot(lit(left, at, GREEN)), at)) < 1.5


def test_of_two_spots_alike_neither_is_taken() -> None:
    one = lit(table(), (250.0, 300.0), GREEN)
    with pytest.raises(InputError, match=r"2 spots .*: (250 300, 420 80|420 80, 250 300); "):
        laser_spot(lit(one, (420.0, 80.0), GREEN))
    glint = lit(one, (420.0, 80.0), GREEN, power=200)
    assert np.linalg.norm(np.subtract(laser_spot(glint), (250, 300))) < 1.0

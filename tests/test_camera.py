"""The rig: projections round-trip, rectified rows agree, units do not matter."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from suturetrack.camera import StereoRig
from suturetrack.types import InputError
from tests.conftest import make_rig

RNG = np.random.default_rng(3)
POINTS = np.c_[RNG.uniform(-40, 40, (50, 2)), RNG.uniform(150, 260, 50)]


def test_projecting_and_triangulating_are_inverse(rig: StereoRig, distorted_rig: StereoRig) -> None:
    for camera in (rig, distorted_rig):
        left, right = camera.project(POINTS)
        assert np.allclose(left[:, 1], right[:, 1], atol=1e-9)
        assert np.allclose(camera.triangulate(left, right), POINTS, atol=1e-7)


@given(st.floats(1e-3, 1e3))
def test_the_unit_of_the_calibration_does_not_matter(scale: float) -> None:
    left, right = make_rig(40.0).project(POINTS)
    scaled = make_rig(40.0 * scale)
    assert np.allclose(scaled.triangulate(left, right), scale * POINTS, rtol=1e-9)
    assert np.allclose(scaled.project(scale * POINTS)[1], right)


def test_raw_pixels_rectify_to_the_projections(distorted_rig: StereoRig) -> None:
    left, right = distorted_rig.project(POINTS)
    raw_left, raw_right = distorted_rig.project_raw(POINTS)
    assert np.abs(raw_left - left).max() > 2
    assert np.allclose(distorted_rig.rectify_pixels(raw_left), left, atol=0.02)
    assert np.allclose(distorted_rig.rectify_pixels(raw_right, right=True), right, atol=0.02)


@pytest.mark.parametrize("shape", [(0,), (0, 4), (3, 0), (1,), (5,), (2, 3), ()])
@pytest.mark.parametrize("fisheye", [False, True])
def test_as_many_pixels_come_back_as_went_in(
    distorted_rig: StereoRig, shape: tuple[int, ...], fisheye: bool
) -> None:
    if fisheye:
        left, right = (
            replace(camera, distortion=camera.distortion[:4], fisheye=True)
            for camera in (distorted_rig.left, distorted_rig.right)
        )
        distorted_rig = replace(distorted_rig, left=left, right=right)
    points = np.broadcast_to(POINTS[0], (*shape, 3))
    for right_view, pixels in enumerate(distorted_rig.project(points)):
        raw = distorted_rig.raw_pixels(pixels, right=bool(right_view))
        assert raw.shape == (*shape, 2)
        np.testing.assert_array_equal(raw, distorted_rig.project_raw(points)[right_view])
        back = distorted_rig.rectify_pixels(raw, right=bool(right_view))
        np.testing.assert_allclose(back, pixels, atol=0.02)


def test_raw_projection_is_the_camera_model(distorted_rig: StereoRig) -> None:
    in_left = POINTS @ distorted_rig.left.rectification
    expected, _ = cv2.projectPoints(
        in_left, np.zeros(3), np.zeros(3), distorted_rig.left.matrix, distorted_rig.left.distortion
    )
    assert np.allclose(distorted_rig.project_raw(POINTS)[0], expected[:, 0], atol=1e-9)


def test_rectified_images_show_points_where_project_puts_them(distorted_rig: StereoRig) -> None:
    raw = distorted_rig.project_raw(POINTS[:12])
    images = [np.zeros((480, 640), np.uint8) for _ in raw]
    for image, pixels in zip(images, raw, strict=True):
        for u, v in pixels:
            cv2.circle(image, (round(u * 16), round(v * 16)), 32, 255, -1, cv2.LINE_AA, 4)
    left, right = distorted_rig.rectify(*images)
    for image, pixels in zip((left, right), distorted_rig.project(POINTS[:12]), strict=True):
        for u, v in pixels:
            window = image[round(v) - 6 : round(v) + 7, round(u) - 6 : round(u) + 7].astype(float)
            rows, columns = np.mgrid[-6:7, -6:7]
            centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
            assert np.allclose([round(u) + centre[0], round(v) + centre[1]], [u, v], atol=0.5)


def test_rectified_images_are_left_alone(rig: StereoRig) -> None:
    image = np.zeros((480, 640), np.uint8)
    left, right = rig.rectify(image, image)
    assert left is image
    assert right is image
    assert rig.is_rectified
    assert np.array_equal(rig.project(POINTS)[0], rig.project_raw(POINTS)[0])


def test_the_jacobian_agrees_with_differences(rig: StereoRig) -> None:
    analytic = rig.projection_jacobian(POINTS)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-4
        for view in (0, 1):
            ahead, behind = rig.project(POINTS + step)[view], rig.project(POINTS - step)[view]
            assert np.allclose(analytic[view][..., axis], (ahead - behind) / 2e-4, atol=1e-5)


def test_no_disparity_is_a_point_at_infinity(rig: StereoRig) -> None:
    pixel = np.array([[100.0, 100.0]])
    assert np.isinf(rig.triangulate(pixel, pixel)[0, 2])


def test_cameras_that_are_not_left_and_right_are_refused() -> None:
    with pytest.raises(InputError, match="swap left and right"):
        make_rig(baseline=-40.0)
    k, none = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5)
    with pytest.raises(InputError, match="side by side"):
        StereoRig.from_calibration(
            (640, 480), (k, none), (k, none), np.eye(3), np.array([0.0, -40, 0]), 1e-3
        )


@pytest.mark.parametrize("signs", [(-1.0, -1, 1), (-1.0, 1, -1), (1.0, -1, -1)])
def test_cameras_that_look_different_ways_are_refused(signs: tuple[float, ...]) -> None:
    k, none = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), np.zeros(5)
    with pytest.raises(InputError, match=r"R turns the right camera away .* by 180 degrees"):
        StereoRig.from_calibration(
            (640, 480), (k, none), (k, none), np.diag(signs), np.array([-40.0, 0, 0]), 1e-3
        )


@pytest.mark.parametrize("factor", [0.5, 2.0, 1.5])
def test_a_resized_rig_sees_the_same_points_in_resized_images(
    distorted_rig: StereoRig, factor: float
) -> None:
    resized = distorted_rig.resized(factor)
    assert resized.image_size == (640 * factor, 480 * factor)
    # OpenCV's resize keeps the image's edges, half a pixel outside of the corner pixel's centre.
    raw, expected = resized.project_raw(POINTS), distorted_rig.project_raw(POINTS)
    for mine, first in zip(raw, expected, strict=True):
        np.testing.assert_allclose(mine + 0.5, factor * (first + 0.5), atol=1e-9)
    np.testing.assert_allclose(resized.triangulate(*resized.project(POINTS)), POINTS, atol=1e-7)


def test_a_resized_image_fits_the_resized_rig(distorted_rig: StereoRig) -> None:
    dot = np.zeros((480, 640), np.float32)
    u, v = distorted_rig.project_raw(POINTS[0])[0]
    cv2.circle(dot, (round(u * 16), round(v * 16)), 80, 255, -1, cv2.LINE_AA, 4)
    half = cv2.resize(dot, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    rows, columns = np.mgrid[:240, :320]
    centre = np.array([(half * columns).sum(), (half * rows).sum()]) / half.sum()
    np.testing.assert_allclose(
        centre, distorted_rig.resized(0.5).project_raw(POINTS[0])[0], atol=0.1
    )


def test_a_rig_for_rectified_images_keeps_its_frame_and_its_projections(
    distorted_rig: StereoRig,
) -> None:
    rectified = distorted_rig.for_rectified_images()
    assert rectified.is_rectified
    assert rectified.baseline == distorted_rig.baseline
    np.testing.assert_array_equal(rectified.project(POINTS), distorted_rig.project(POINTS))
    np.testing.assert_array_equal(rectified.project_raw(POINTS), distorted_rig.project(POINTS))


def test_the_pose_between_the_cameras_is_told_as_it_was_given(distorted_rig: StereoRig) -> None:
    rotation, translation = distorted_rig.right_from_left
    np.testing.assert_allclose(translation, [-40.0, 0.6, 0.9], atol=1e-9)
    np.testing.assert_allclose(cv2.Rodrigues(rotation)[0].ravel(), [0, np.radians(3), 0], atol=1e-9)

"""`suturetrack calibration check`: figures, doubts and verdicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.calibration import CalibrationConfig, run
from services.calibration_check import (
    depth_step,
    doubts,
    epipolar_error,
    field_of_view,
    pixel_convention,
)
from suturetrack.calibration import save_calibration
from suturetrack.camera import StereoRig
from suturetrack.stage import open_scene
from suturetrack.types import Image, InputError
from tests.conftest import make_rig

DISPARITY = 32


def texture() -> Image:
    noise = np.random.default_rng(5).integers(0, 256, (120, 180)).astype(np.uint8)
    return cv2.resize(noise, (720, 480), interpolation=cv2.INTER_CUBIC)


def views(shift_px: float = 0.0, roll_deg: float = 0.0) -> tuple[Image, Image]:
    """A textured wall at a disparity of 32 px, the right image moved down and rolled."""
    wall = texture()
    turn = cv2.getRotationMatrix2D((319.5, 239.5), roll_deg, 1.0)
    turn[1, 2] += shift_px
    right = cv2.warpAffine(
        np.ascontiguousarray(wall[:, DISPARITY : DISPARITY + 640]), turn, (640, 480)
    )
    return np.ascontiguousarray(wall[:, :640]), right


def check(
    tmp_path: Path, rig: StereoRig, images: tuple[Image, Image] | None, **options: object
) -> None:
    save_calibration(tmp_path / "rig.yaml", rig)
    paths = (tmp_path / "left.png", tmp_path / "right.png") if images is not None else None
    for path, image in zip(paths or (), images or (), strict=True):
        cv2.imwrite(str(path), image)
    run(CalibrationConfig("check", tmp_path / "rig.yaml", paths, **options))  # type: ignore[arg-type]


def test_figures_of_a_plain_rig(rig: StereoRig) -> None:
    assert depth_step(rig, 200.0) == pytest.approx(200**2 / (800 * 40))
    expected = [np.degrees(2 * np.arctan(side / 2 / 800)) for side in (640, 480)]
    assert field_of_view(rig) == pytest.approx(expected)
    assert doubts(rig) == []


def test_rows_of_good_images_agree(rig: StereoRig) -> None:
    found = epipolar_error(rig, *views())
    assert found is not None
    assert found.matches > 100
    assert found.p95_px < 0.3
    assert not found.swapped
    assert found.distance == pytest.approx(800 * 40 / DISPARITY, rel=0.02)


@pytest.mark.parametrize("shift_px", [0.5, -3.0, 15.0])
def test_a_vertical_shift_is_measured(rig: StereoRig, shift_px: float) -> None:
    found = epipolar_error(rig, *views(shift_px))
    assert found is not None
    assert found.shift_px == pytest.approx(-shift_px, abs=0.15)
    assert found.median_px == pytest.approx(abs(shift_px), abs=0.15)


def test_a_roll_is_seen_though_it_shifts_nothing_on_average(rig: StereoRig) -> None:
    found = epipolar_error(rig, *views(roll_deg=2.0))
    assert found is not None
    assert abs(found.shift_px) < 1
    assert found.median_px == pytest.approx(
        np.median(abs(np.linspace(-320, 320))) * 0.035, rel=0.25
    )


def test_unrelated_images_prove_nothing(rig: StereoRig) -> None:
    rng = np.random.default_rng(1)
    left, right = (rng.integers(0, 256, (480, 640)).astype(np.uint8) for _ in range(2))
    assert epipolar_error(rig, left, right) is None
    assert epipolar_error(rig, np.zeros_like(left), np.zeros_like(left)) is None


def test_a_good_calibration_passes(
    tmp_path: Path, rig: StereoRig, capsys: pytest.CaptureFixture[str]
) -> None:
    check(tmp_path, rig, views())
    said = capsys.readouterr().out
    assert "40.000 mm" in said
    assert "43.6 x 33.4 deg" in said
    assert "Nothing looks wrong" in said


@pytest.mark.parametrize(
    ("images", "words"),
    [
        (views()[::-1], "swap left and right"),
        (views(shift_px=6), r"rows of matched features differ by 6\.\d px"),
    ],
    ids=["swapped", "shifted"],
)
def test_images_that_contradict_the_calibration_fail_it(
    tmp_path: Path, rig: StereoRig, images: tuple[Image, Image], words: str
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        check(tmp_path, rig, images)
    assert "\n" not in str(caught.value)


def test_a_thread_tells_swapped_images_where_features_do_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both sensors have the same fixed pattern, which has no disparity."""
    scene = open_scene("figure8-107", seed=3)
    pattern = cv2.resize(texture(), (640, 480))
    left, right = (
        np.where(image.mean(axis=2) < 80, image.mean(axis=2), 150 + pattern / 8).astype(np.uint8)
        for image in scene.render(0)
    )
    check(tmp_path, scene.rig, (left, right))
    assert "no disparity" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(InputError, match="the thread lies where only swapped cameras see it"):
        check(tmp_path, scene.rig, (right, left))


def test_images_of_another_size_need_a_scale(tmp_path: Path, rig: StereoRig) -> None:
    left, right = (cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA) for image in views())
    with pytest.raises(InputError, match=r"320x240, but .* is for 640x480; .*--scale 0\.5"):
        check(tmp_path, rig, (left, right))
    check(tmp_path, rig, (left, right), scale=0.5)
    with pytest.raises(InputError, match=r"is its image size \[width, height\]"):
        check(tmp_path, rig, (np.ascontiguousarray(views()[0].T),) * 2)
    with pytest.raises(InputError, match="scale 0: use the width"):
        check(tmp_path, rig, None, scale=0.0)


def test_a_blank_scene_is_only_a_warning(
    tmp_path: Path, rig: StereoRig, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = np.full((480, 640), 128, np.uint8)
    check(tmp_path, rig, (blank, blank))
    assert "too few features match" in capsys.readouterr().out


def test_doubts_are_told(rig: StereoRig, distorted_rig: StereoRig) -> None:
    assert doubts(distorted_rig) == []
    assert "is the unit mm?" in doubts(make_rig(40.0, 1.0))[0]
    assert "is the unit m?" in doubts(make_rig(0.04, 1e-3))[0]
    matrix = rig.left.matrix.copy()
    matrix[0, 2] = 700
    assert "lies outside" in doubts(replace(rig, left=replace(rig.left, matrix=matrix)))[0]
    matrix[0, 2] = 500
    assert "far from the centre" in doubts(replace(rig, left=replace(rig.left, matrix=matrix)))[0]
    turned = doubts(replace(rig, image_size=rig.image_size[::-1]))
    assert len(turned) == 2
    assert all("middle of 640x480, not of the 480x640 image" in line for line in turned)
    matrix = np.diag([1.2, 1, 1]) @ rig.left.matrix
    told = doubts(replace(rig, left=replace(rig.left, matrix=matrix)))
    assert any("not square" in line for line in told)
    bent = replace(distorted_rig.left, distortion=np.array([-2.5, 1.0, 0, 0, 0]))
    assert any("folds" in line for line in doubts(replace(distorted_rig, left=bent)))


@pytest.mark.parametrize(
    ("centre", "words"),
    [
        ((319.5, 239.5), "as here"),
        ((320.0, 240.0), "subtract 0.5"),
        ((320.5, 240.5), "subtract 1"),
        ((311.3, 250.9), "unknown"),
    ],
)
def test_the_way_of_counting_pixels_is_guessed(
    rig: StereoRig, centre: tuple[float, float], words: str
) -> None:
    matrix = rig.left.matrix.copy()
    matrix[:2, 2] = centre
    other = replace(rig.left, matrix=matrix)
    assert words in pixel_convention(replace(rig, left=other, right=other))

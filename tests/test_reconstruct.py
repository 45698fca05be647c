"""`reconstruct`: a stereo pair on disk to a curve in JSON, and what it refuses."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.reconstruct import ReconstructConfig, run
from suturetrack import nurbs
from suturetrack.calibration import save_calibration
from suturetrack.camera import StereoRig
from suturetrack.metrics import curve_error
from suturetrack.types import Image, InputError, Nurbs
from tests.test_initialization import dense, draw
from tests.test_snapping import GREEN, lit


@pytest.fixture
def pair(rig: StereoRig, curve: Nurbs, tmp_path: Path) -> tuple[Image, Image, ReconstructConfig]:
    """Both images, and the configuration for the files that hold them."""
    left, right = rig.project(dense(curve))
    images = draw(left, rig), draw(right, rig)
    save_calibration(tmp_path / "rig.yaml", rig)
    u, v = left[700]
    config = ReconstructConfig(
        tmp_path / "left.png",
        tmp_path / "right.png",
        calibration=tmp_path / "rig.yaml",
        seed=(float(u), float(v)),
        output=tmp_path / "thread.json",
    )
    write(config, *images)
    return *images, config


def write(config: ReconstructConfig, left: Image, right: Image) -> None:
    assert config.right is not None
    cv2.imwrite(str(config.left), left)
    cv2.imwrite(str(config.right), right)


def curve_in(path: Path) -> Nurbs:
    o = json.loads(path.read_text())
    return Nurbs(o["degree"], *(np.array(o[k]) for k in ("knots", "control_points", "weights")))


def test_a_pair_becomes_one_object(
    pair: tuple[Image, Image, ReconstructConfig], curve: Nurbs, capsys: pytest.CaptureFixture[str]
) -> None:
    config = pair[2]
    run(config)
    said = capsys.readouterr().out
    written = json.loads(config.output.read_text())
    found = curve_in(config.output)
    assert curve_error(dense(found), dense(curve)).mean < 0.3
    assert written["length"] == pytest.approx(nurbs.length(found))
    assert 0 < written["reprojection_px"] < 0.2
    assert 0.5 < written["confidence"] <= 1
    millimetres, confidence = f"{written['length']:.1f} mm", f"{written['confidence']:.2f}"
    words = f"Curve in {config.output}: {millimetres} long, confidence {confidence}"
    assert said == "; ".join([words, *written["reasons"]]) + "\n"


def test_what_goes_elsewhere_than_to_a_file_is_the_object_alone(
    pair: tuple[Image, Image, ReconstructConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    run(replace(pair[2], output=None))
    object_ = capsys.readouterr().out
    assert json.loads(object_)["degree"] == 3
    reading, writing = os.pipe()
    run(replace(pair[2], output=Path(f"/dev/fd/{writing}")))
    os.close(writing)
    with os.fdopen(reading) as pipe:
        assert pipe.read() == object_
    assert capsys.readouterr().out == ""


def test_side_by_side_is_the_same(pair: tuple[Image, Image, ReconstructConfig]) -> None:
    left, right, config = pair
    run(config)
    both = config.left.with_name("both.png")
    cv2.imwrite(str(both), np.hstack([left, right]))
    other = ReconstructConfig(
        both,
        calibration=config.calibration,
        seed=config.seed,
        output=config.output.with_name("other.json"),
        layout="side-by-side",
    )
    run(other)
    assert other.output.read_text() == config.output.read_text()


def test_an_area_and_a_laser_spot_give_the_same_curve(
    pair: tuple[Image, Image, ReconstructConfig], rig: StereoRig, curve: Nurbs
) -> None:
    left, right, config = pair
    assert config.seed is not None
    u, v = config.seed
    run(replace(config, seed=None, area=(u - 30, v - 20, u + 30, v + 40)))
    assert curve_error(dense(curve_in(config.output)), dense(curve)).mean < 0.3
    with pytest.raises(InputError, match="no laser spot"):
        run(replace(config, seed=None, laser=True))
    dimmed = [(image * 0.5).astype(np.uint8) for image in (left, right)]
    places = (p[700] for p in rig.project(dense(curve)))
    write(
        config, *(lit(image, (p[0], p[1]), GREEN) for image, p in zip(dimmed, places, strict=True))
    )
    run(replace(config, seed=None, laser=True))
    assert curve_error(dense(curve_in(config.output)), dense(curve)).mean < 0.3


def test_a_wide_thread_is_found_in_enlarged_images(
    pair: tuple[Image, Image, ReconstructConfig], curve: Nurbs
) -> None:
    left, right, config = pair
    assert config.seed is not None
    for times in (3, 5):
        size = 640 * times, 480 * times
        write(config, *(cv2.resize(i, size, interpolation=cv2.INTER_CUBIC) for i in (left, right)))
        u, v = ((x + 0.5) * times - 0.5 for x in config.seed)
        run(replace(config, scale=float(times), seed=(u, v)))
        assert curve_error(dense(curve_in(config.output)), dense(curve)).mean < 0.3


def test_a_seed_is_given_in_one_way(pair: tuple[Image, Image, ReconstructConfig]) -> None:
    config = pair[2]
    for wrong in (replace(config, seed=None), replace(config, laser=True)):
        with pytest.raises(InputError, match="exactly one of --seed U V"):
            run(wrong)


def halved(image: Image) -> Image:
    return cv2.resize(image, None, fx=0.5, fy=0.5)


def coloured(image: Image) -> Image:
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def washed_out(image: Image) -> Image:
    return np.where(np.arange(len(image))[:, None] < 20, image, 255).astype(np.uint8)


def without_thread(image: Image) -> Image:
    noise = np.random.default_rng(0).normal(190, 2, image.shape)
    return cv2.GaussianBlur(noise, (0, 0), 1).astype(np.uint8)


@pytest.mark.parametrize(
    ("change_left", "change_right", "message"),
    [
        (None, halved, "left is 640x480 gray, right is 320x240 gray; both must have one size"),
        (halved, halved, "the calibration is for 640x480"),
        (coloured, None, "left is 640x480 in colour, right is 640x480 gray; both must"),
        (lambda i: i.astype(np.uint16) * 257, None, "uint16; convert it to 8 bit"),
        (lambda i: np.full_like(i, 90), None, "left image is empty"),
        (None, lambda i: np.full_like(i, 255), "right image is empty"),
        (washed_out, None, "left image is saturated: 9[0-9]% .*; lower the exposure"),
        (lambda i: i // 25, None, "left image is black"),
        (None, lambda i: i.astype(np.uint16) * 257, r"right.png is uint16; convert it to 8 bit"),
        (None, coloured, "left is 640x480 gray, right is 640x480 in colour; both must"),
        (None, without_thread, "right view shows no thread"),
        (without_thread, None, "no thread within 8 px of the seed"),
        (None, lambda i: i[::-1], "right view"),
    ],
)
def test_bad_images_are_refused(
    pair: tuple[Image, Image, ReconstructConfig], change_left, change_right, message: str
) -> None:
    left, right, config = pair
    write(
        config,
        change_left(left) if change_left else left,
        change_right(right) if change_right else right,
    )
    with pytest.raises(InputError, match=message) as refusal:
        run(config)
    assert "\n" not in str(refusal.value)
    assert not config.output.exists()
    assert {p.suffix for p in config.output.parent.iterdir()} == {".png", ".yaml"}


def test_a_thread_cut_out_on_white_is_not_saturated(
    pair: tuple[Image, Image, ReconstructConfig], curve: Nurbs
) -> None:
    left, right, config = pair
    write(config, *(np.where(image < 120, image, 255).astype(np.uint8) for image in (left, right)))
    run(config)
    assert curve_error(dense(curve_in(config.output)), dense(curve)).mean < 0.3


def test_swapped_views_are_named(pair: tuple[Image, Image, ReconstructConfig]) -> None:
    left, right, config = pair
    columns = np.flatnonzero((right < 150).any(0))
    column = int(columns[len(columns) // 2])
    row = int(np.argmin(right[:, column]))
    write(config, right, left)
    swapped = ReconstructConfig(
        config.left,
        config.right,
        calibration=config.calibration,
        seed=(float(column), float(row)),
        output=config.output,
    )
    with pytest.raises(InputError, match="swapped"):
        run(swapped)
    assert not config.output.exists()


def test_a_missing_image_is_named(pair: tuple[Image, Image, ReconstructConfig]) -> None:
    config = pair[2]
    config.left.unlink()
    with pytest.raises(InputError, match=r"no image .*left\.png"):
        run(config)


def test_an_unreadable_image_is_named(pair: tuple[Image, Image, ReconstructConfig]) -> None:
    config = pair[2]
    config.left.write_bytes(b"no image at all")
    with pytest.raises(InputError, match=r"left\.png"):
        run(config)


def test_an_output_that_cannot_be_written_is_named(
    pair: tuple[Image, Image, ReconstructConfig], tmp_path: Path
) -> None:
    config = pair[2]
    impossible = ReconstructConfig(
        config.left,
        config.right,
        calibration=config.calibration,
        seed=config.seed,
        output=tmp_path / "nowhere" / "thread.json",
    )
    with pytest.raises(InputError, match="cannot write"):
        run(impossible)

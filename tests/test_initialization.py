"""From one seed to the whole thread, on drawn scenes with an exact truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError, initialize
from suturetrack.metrics import curve_error
from suturetrack.segmentation import Segmenter
from suturetrack.types import (
    Float64,
    Image,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
)

STAMP = Stamp(0, 0, 0)


def draw(pixels: Float64, rig: StereoRig, image: Image | None = None, width: int = 3) -> Image:
    """A dark thread through (k, 2) pixels, drawn four times as large and reduced."""
    scale = 4
    columns, rows = rig.image_size
    if image is None:
        image = np.full((rows, columns), 190, np.uint8)
    large = np.zeros((rows * scale, columns * scale), np.uint8)
    at = np.round(((pixels + 0.5) * scale - 0.5) * 16).astype(np.int32)
    cv2.polylines(large, [at], False, 255, width * scale * 3 // 4, cv2.LINE_AA, 4)
    share = cv2.resize(large, (columns, rows), interpolation=cv2.INTER_AREA) / 255
    return np.rint(image * (1 - share) + 70 * share).astype(np.uint8)


def field_of(left: Image, right: Image, rig: StereoRig) -> RidgeField:
    return Segmenter(rig).step(StereoFrame(STAMP, left, right))


def dense(curve: Nurbs, count: int = 1500) -> Float64:
    return nurbs.evaluate(curve, nurbs.evenly_spaced(curve, count))


def field_of_curve(curve: Nurbs, rig: StereoRig) -> RidgeField:
    left, right = rig.project(dense(curve))
    return field_of(draw(left, rig), draw(right, rig), rig)


def test_the_whole_thread_is_found_from_its_middle(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    found = initialize(
        field_of_curve(curve, rig), rig, Seed(pixel=tuple(rig.project(truth[700])[0]))
    )
    error = curve_error(dense(found.curve), truth)
    assert error.mean < 0.3
    assert max(error.ends) < 1.5
    assert abs(error.length_percent) < 2
    assert found.reprojection_px < 0.2


def test_a_seed_on_nothing_is_refused_with_the_nearest_ridge(rig: StereoRig, curve: Nurbs) -> None:
    field = field_of_curve(curve, rig)
    with pytest.raises(InitializationError, match="no thread within 8 px") as refusal:
        initialize(field, rig, Seed(pixel=(20.0, 20.0)))
    left = rig.project(dense(curve))[0]
    nearest = np.linalg.norm(left[:, None] - refusal.value.candidates, axis=2).min(0)
    assert len(nearest) >= 1
    assert nearest.max() < 2


def test_a_seed_outside_the_image_is_refused(rig: StereoRig, curve: Nurbs) -> None:
    with pytest.raises(InputError, match="outside the 640x480 left image"):
        initialize(field_of_curve(curve, rig), rig, Seed(pixel=(700.0, 20.0)))


def test_a_right_view_without_the_thread_is_refused(rig: StereoRig, curve: Nurbs) -> None:
    left, _ = rig.project(dense(curve))
    blank = np.full((480, 640), 190, np.uint8)
    with pytest.raises(InitializationError, match="right view"):
        initialize(field_of(draw(left, rig), blank, rig), rig, Seed(pixel=tuple(left[700])))


def test_growth_tells_what_was_reached_and_marked(rig: StereoRig, curve: Nurbs) -> None:
    truth = dense(curve)
    seed = rig.project(truth[700])[0]
    found: Initialization = initialize(field_of_curve(curve, rig), rig, Seed(pixel=tuple(seed)))
    left = found.growth.left
    u, v = np.rint(seed).astype(int)
    assert left.cost[v, u] < 5
    assert np.isfinite(left.cost).sum() > 1000
    spacing = np.linalg.norm(np.diff(found.growth.marks[:, 0], axis=0), axis=1)
    assert abs(np.median(spacing) - 6) < 0.5

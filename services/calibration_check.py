"""What can be told of a calibration by itself, and by a pair of images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationError, initialize
from suturetrack.segmentation import Segmenter
from suturetrack.snapping import pixel_in_area
from suturetrack.types import Bool, Float64, Image, InputError, Seed, Stamp, StereoFrame

FEWEST_MATCHES = 20
_LARGEST_RATIO = 0.75
"""Of the distances to the nearest and to the second nearest descriptor (Lowe's test)."""
_FEWEST_AGREEING = 0.5
"""Share of the matches that must agree before they are believed."""
_AGREEING_PX = 2.0
_LEAST_DISPARITY_PX = 0.5
"""Features with less belong to the images, as compression and dirt do, or lie too far away to tell."""
_FEATURES = 2000
"""The strongest ones of each image are matched."""
_TRIALS = 300


@dataclass(frozen=True)
class Epipolar:
    """How the rows of two rectified images agree, by matched features."""

    matches: int
    shift_px: float
    """Median of left row minus right row, px."""
    median_px: float
    """Of the distance between the rows, px."""
    p95_px: float
    swapped: bool
    """Whether most features lie on the side on which only the other camera could see them."""
    distance: float
    """Median distance of the features from the cameras, calibration's unit; nan when swapped, infinite
    without a disparity."""


def epipolar_error(rig: StereoRig, left: Image, right: Image) -> Epipolar | None:
    """Compares the rows of matched features; None where too few of them agree with one another.

    Wrong matches are told by the others: the rows of a badly calibrated pair differ by an amount that
    changes linearly over the image, to first order, and those of wrong matches by anything.

    Args:
        rig: the rig of these images.
        left: (H, W) or (H, W, 3) raw image.
        right: as `left`.
    """
    p, q = _matches(*rig.rectify(left, right))
    if len(p) < FEWEST_MATCHES:
        return None
    rows = (p[:, 1] - rig.left.projection[1, 2]) - (q[:, 1] - rig.right.projection[1, 2])
    good = _consensus(p, rows)
    if good.sum() < max(FEWEST_MATCHES, _FEWEST_AGREEING * len(p)):
        return None
    p, q, rows = p[good], q[good], rows[good]
    disparity = (p[:, 0] - rig.left.projection[0, 2]) - (q[:, 0] - rig.right.projection[0, 2])
    middle = float(np.median(disparity))
    distance = np.nan if middle < -_LEAST_DISPARITY_PX else np.inf
    if middle > _LEAST_DISPARITY_PX:
        distance = float(np.median(rig.triangulate(p, q)[:, 2]))
    return Epipolar(
        matches=len(rows),
        shift_px=float(np.median(rows)),
        median_px=float(np.median(np.abs(rows))),
        p95_px=float(np.percentile(np.abs(rows), 95)),
        swapped=middle < -_LEAST_DISPARITY_PX,
        distance=distance,
    )


def thread_is_swapped(rig: StereoRig, left: Image, right: Image) -> bool:
    """Whether the right image shows the clearest thread of the left one where only swapped cameras would.

    Args:
        rig, left, right: as `epipolar_error`.
    """
    frame, segmenter = StereoFrame(Stamp(0, 0, 0), left, right), Segmenter(rig)
    try:
        seed = Seed(pixel=pixel_in_area(segmenter.step(frame), rig, (0.0, 0.0, *rig.image_size)))
        segmenter.learn(frame, seed)
        initialize(segmenter.step(frame), rig, seed)
    except InitializationError as error:
        return error.swapped
    except InputError:  # Nothing looks like thread.
        pass
    return False


def depth_step(rig: StereoRig, distance: float) -> float:
    """How much further a point at a distance lies when its disparity is one pixel less."""
    return distance**2 / (rig.focal * rig.baseline)


def field_of_view(rig: StereoRig) -> tuple[float, float]:
    """Horizontal and vertical angle of the rectified left view, degrees."""
    p = rig.left.projection
    angles = [
        np.degrees(
            np.arctan((size - 0.5 - p[i, 2]) / p[i, i]) + np.arctan((p[i, 2] + 0.5) / p[i, i])
        )
        for i, size in enumerate(rig.image_size)
    ]
    return float(angles[0]), float(angles[1])


def pixel_convention(rig: StereoRig) -> str:
    """From where the calibration seems to count pixels, as far as its principal points tell."""
    size = np.array(rig.image_size)
    centres = [c.matrix[:2, 2] for c in (rig.left, rig.right)]
    for shift, meaning in (
        (-0.5, "from the corner pixel's centre, as here"),
        (0.0, "from the image's corner? subtract 0.5 from cx, cy"),
        (0.5, "from 1 (MATLAB)? subtract 1 from cx, cy"),
    ):
        if all(np.allclose(centre, size / 2 + shift, atol=1e-6) for centre in centres):
            return meaning
    return "unknown; must be from the corner pixel's centre"


def doubts(rig: StereoRig) -> list[str]:
    """What looks wrong in a calibration, each in one line."""
    found = []
    baseline_mm = rig.baseline * rig.mm_per_unit
    if not 1 <= baseline_mm <= 500:
        other = "mm" if rig.unit == "m" else "m"
        found.append(
            f"a baseline of {baseline_mm:.6g} mm is unusual; is the unit {other}? (--unit)"
        )
    size = np.array(rig.image_size)
    for side, camera in (("left", rig.left), ("right", rig.right)):
        centre = camera.matrix[:2, 2]
        told = f"the {side} principal point {centre.round(1).tolist()}"
        if np.any(centre < 0) or np.any(centre > size):
            found.append(
                f"{told} lies outside the {size[0]}x{size[1]} image; is it for another size?"
            )
        elif _is_turned(centre, size):
            found.append(
                f"{told} is in the middle of {size[1]}x{size[0]}, not of the {size[0]}x{size[1]} image; "
                "is its height given before its width?"
            )
        elif np.any(np.abs(centre - size / 2) > 0.2 * size):
            found.append(f"{told} is far from the centre of the {size[0]}x{size[1]} image")
        fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
        if not 0.95 < fx / fy < 1.05:
            found.append(f"the {side} pixels are not square: fx {fx:.1f}, fy {fy:.1f}")
        if _folding_px(rig, right=side == "right") > 1:
            found.append(
                f"the {side} lens model folds the image over within its borders; calibrate with "
                "pictures that reach the corners, or with fewer coefficients"
            )
    return found


def _is_turned(centre: Float64, size: Float64) -> bool:
    """Whether a principal point is in the middle of the image when its sides are exchanged, and only then."""
    away, away_turned = (np.linalg.norm(centre - s / 2) for s in (size, size[::-1]))
    return bool(away > 0.1 * size.max() and away_turned < away / 4)


def _folding_px(rig: StereoRig, *, right: bool) -> float:
    """The largest error of undistorting and distorting again, over the raw image."""
    width, height = rig.image_size
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25)), -1)
    there = rig.rectify_pixels(grid, right=right)
    back = rig.raw_pixels(there, right=right)
    error = np.linalg.norm(back - grid, axis=-1)
    return float(np.nanmax(np.where(np.isfinite(error), error, np.inf)))


def _consensus(pixels: Float64, rows: Float64) -> Bool:
    """(n,) the matches whose row difference is one affine function of the pixel (RANSAC)."""
    rng = np.random.default_rng(0)
    design = np.column_stack([pixels, np.ones(len(pixels))])
    best = np.zeros(len(pixels), bool)
    for _ in range(_TRIALS):
        chosen = rng.choice(len(pixels), 3, replace=False)
        if np.linalg.cond(design[chosen]) > 1e6:
            continue
        plane = np.linalg.solve(design[chosen], rows[chosen])
        agreeing = np.abs(design @ plane - rows) <= _AGREEING_PX
        if agreeing.sum() > best.sum():
            best = agreeing
    return best


def _matches(left: Image, right: Image) -> tuple[Float64, Float64]:
    """(n, 2) pixels of features in both images, each the other's nearest."""
    sift = cv2.SIFT_create(nfeatures=_FEATURES, contrastThreshold=0.0)  # type: ignore[attr-defined]
    found = [sift.detectAndCompute(_gray(image), None) for image in (left, right)]
    (points, descriptors), (other_points, other_descriptors) = found
    none = np.empty((0, 2)), np.empty((0, 2))
    if descriptors is None or other_descriptors is None or len(other_descriptors) < 2:
        return none
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {(m.trainIdx, m.queryIdx) for m in matcher.match(other_descriptors, descriptors)}
    kept = [
        (points[m.queryIdx].pt, other_points[m.trainIdx].pt)
        for m, second in matcher.knnMatch(descriptors, other_descriptors, k=2)
        if m.distance < _LARGEST_RATIO * second.distance and (m.queryIdx, m.trainIdx) in back
    ]
    if not kept:
        return none
    pairs = np.array(kept, dtype=np.float64)
    return pairs[:, 0], pairs[:, 1]


def _gray(image: Image) -> Image:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

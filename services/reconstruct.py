"""`suturetrack reconstruct`: one stereo pair and one seed to one curve, as JSON."""

from __future__ import annotations

import json
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from services.output import opened
from services.sources.exposure import exposure_fault
from services.sources.footage import check_pair, halves, read_image, size_of
from services.sources.rig import check_size, open_rig
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationConfig,
    InitializationError,
    initialize,
)
from suturetrack.segmentation import SegmentationConfig, Segmenter
from suturetrack.snapping import laser_spot, pixel_in_area
from suturetrack.types import Image, InputError, Seed, Stamp, StereoFrame


@dataclass(frozen=True)
class ReconstructConfig:
    """Finds the thread of one stereo pair and writes it as one JSON object.

    Members: degree, knots, control_points (x y z in the calibration's unit, rectified left frame),
    weights, length (the same unit), reprojection_px (mean distance from the ridge, both views),
    confidence (0 to 1; not to be relied on below 0.5) and reasons.
    """

    left: Annotated[Path, tyro.conf.Positional]
    """Left image, or the side-by-side image."""
    right: Annotated[Path | None, tyro.conf.Positional] = None
    """Right image; left out with --layout side-by-side."""
    _: KW_ONLY
    calibration: Path
    """Calibration of the rig."""
    output: Path | None = None
    """The file to write; standard output when not given."""
    seed: tuple[float, float] | None = None
    """U V: a pixel on the thread in the raw left image."""
    area: tuple[float, float, float, float] | None = None
    """U V U V of two opposite corners of a box instead: the clearest thread between them."""
    laser: bool = False
    """Instead, the bright spot of a laser in the left image."""
    layout: Literal["pair", "side-by-side"] = "pair"
    """Two images, or one whose left half is the left view."""
    unit: Literal["m", "mm"] | None = None
    """Unit of the calibration; guessed from the baseline when not given."""
    scale: float = 1.0
    """How many times as wide and high the images are as those that were calibrated."""
    rectified: bool = False
    """The images are rectified already, with the projections of this calibration."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)


def run(config: ReconstructConfig) -> None:
    """Reconstructs the thread, writes the object, and tells of a file in one line.

    Raises:
        InputError: the images, the calibration or the seed are at fault, or no thread is found;
            nothing is written.
    """
    if sum((config.seed is not None, config.area is not None, config.laser)) != 1:
        raise InputError("give exactly one of --seed U V, --area U V U V and --laser")
    left, right = _load(config)
    rig = open_rig(config.calibration, config.unit, config.scale, rectified=config.rectified)
    _check(left, right, rig)
    frame = StereoFrame(Stamp(0, 0, 0), left, right)
    segmenter = Segmenter(rig, config.segmentation)
    seed = Seed(pixel=_pixel(config, frame, segmenter, rig))
    segmenter.learn(frame, seed)
    try:
        found = initialize(segmenter.step(frame), rig, seed, config.initialization)
    except InitializationError as error:
        raise InputError(error.reason) from error
    with opened(config.output) as file:
        file.write(json.dumps(record(found), indent=1, allow_nan=False) + "\n")
    if config.output is not None and config.output.is_file():
        length_mm = nurbs.length(found.curve) * rig.mm_per_unit
        words = f"{length_mm:.1f} mm long, confidence {found.confidence:.2f}"
        print(f"Curve in {config.output}: {'; '.join([words, *found.reasons])}")


def _pixel(
    config: ReconstructConfig, frame: StereoFrame, segmenter: Segmenter, rig: StereoRig
) -> tuple[float, float]:
    """The seed in the raw left image."""
    if config.laser:
        return laser_spot(frame.left)
    if config.area is not None:
        field = segmenter.step(frame)
        return pixel_in_area(field, rig, config.area, config=config.initialization)
    assert config.seed is not None
    return config.seed


def record(found: Initialization) -> dict[str, Any]:
    """The JSON object of an initialisation."""
    curve = found.curve
    return {
        "degree": curve.degree,
        "knots": curve.knots.tolist(),
        "control_points": curve.control_points.tolist(),
        "weights": curve.weights.tolist(),
        "length": nurbs.length(curve),
        "reprojection_px": found.reprojection_px,
        "confidence": found.confidence,
        "reasons": list(found.reasons),
    }


def _load(config: ReconstructConfig) -> tuple[Image, Image]:
    if config.layout == "side-by-side":
        if config.right is not None:
            raise InputError("--layout side-by-side takes one image; leave the right one out")
        left, right = halves(read_image(config.left), str(config.left))
        return np.ascontiguousarray(left), np.ascontiguousarray(right)
    if config.right is None:
        raise InputError("give LEFT and RIGHT, or one image and --layout side-by-side")
    return read_image(config.left), read_image(config.right)


def _check(left: Image, right: Image, rig: StereoRig) -> None:
    check_pair(left, right, "the images")
    check_size(size_of(left), rig, "the images", "the calibration")
    for name, image in (("left", left), ("right", right)):
        fault = exposure_fault(image)
        if fault:
            raise InputError(f"the {name} image is {fault}")

"""`suturetrack calibration check`: what a calibration says, and whether images agree with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from services.calibration_check import (
    Epipolar,
    depth_step,
    doubts,
    epipolar_error,
    field_of_view,
    pixel_convention,
    thread_is_swapped,
)
from services.sources.footage import read_image, size_of
from services.sources.rig import check_size, open_rig
from services.tables import new_table, report_console
from suturetrack.camera import StereoRig
from suturetrack.types import Image, InputError

_GOOD_PX, _BAD_PX = 0.5, 2.0
"""Median distance between matched rows that is fine, and that nothing can be tracked with."""


@dataclass(frozen=True)
class CalibrationConfig:
    """Tells what a calibration says and warns of what looks wrong; exit status 1 if it is unusable.

    With --images, features of both images are matched, and must lie in the same rows once rectified.
    """

    action: Annotated[Literal["check"], tyro.conf.Positional]
    """What to do."""
    file: Annotated[Path, tyro.conf.Positional]
    """OpenCV FileStorage file, Kalibr camchain, folder with ROS's left.yaml and right.yaml, or
    LEFT,RIGHT."""
    images: tuple[Path, Path] | None = None
    """LEFT RIGHT: two raw images of one moment, of a scene with texture."""
    unit: Literal["m", "mm"] | None = None
    """Unit of the calibration; guessed from the baseline without it."""
    scale: float = 1.0
    """How many times as wide and high the images are as those that were calibrated."""
    rectified: bool = False
    """The images are rectified already, with the projections of this calibration."""
    distances: tuple[float, ...] = (50.0, 100.0, 150.0, 200.0)
    """Working distances for the depth resolution, mm."""


def run(config: CalibrationConfig) -> None:
    """Prints the tables and the warnings.

    Raises:
        InputError: the calibration cannot be used, or an image cannot be read.
    """
    if not all(distance > 0 for distance in config.distances):
        raise InputError("distances: use millimetres above 0")
    rig = open_rig(config.file, config.unit, config.scale, rectified=config.rectified)
    console = report_console()
    _describe(rig, config.unit, console)
    _depths(rig, config.distances, console)
    warnings = doubts(rig)
    failure = None
    if config.images is not None:
        left, right = _read(config.images, config.file, rig)
        found = epipolar_error(rig, left, right)
        _rows(found, rig, console)
        failure, more = _judge(found, rig)
        if _is_blind(found) and thread_is_swapped(rig, left, right):
            failure = "the thread lies where only swapped cameras see it; swap left and right"
        warnings += more
    for warning in warnings:
        console.print(f"[yellow]warning:[/] {escape(warning)}", soft_wrap=True, highlight=False)
    if failure is not None:
        raise InputError(f"calibration {config.file} cannot be used: {failure}")
    if not warnings:
        console.print("Nothing looks wrong.")


def _read(paths: tuple[Path, Path], calibration: Path, rig: StereoRig) -> tuple[Image, Image]:
    left, right = (read_image(path) for path in paths)
    for path, image in zip(paths, (left, right), strict=True):
        check_size(size_of(image), rig, f"image {path}", f"calibration {calibration}")
    return left, right


def _describe(rig: StereoRig, unit: str | None, console: Console) -> None:
    table = new_table("calibration", "", "")
    table.show_header = False
    rotation, _ = rig.right_from_left
    turn = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    horizontal, vertical = field_of_view(rig)
    table.add_row("image", f"{rig.image_size[0]}x{rig.image_size[1]} px")
    table.add_row("unit", f"{rig.unit} ({'given' if unit else 'guessed from the baseline'})")
    table.add_row("baseline", f"{rig.baseline * rig.mm_per_unit:.3f} mm")
    table.add_row("angle between the cameras", f"{turn:.2f} deg")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        k = camera.matrix
        table.add_row(f"{side} focal length fx, fy", f"{k[0, 0]:.2f}, {k[1, 1]:.2f} px")
        table.add_row(f"{side} principal point", f"{k[0, 2]:.2f}, {k[1, 2]:.2f} px")
        model = "equidistant" if camera.fisheye else "radial"
        bent = camera.distortion.any() or camera.fisheye
        table.add_row(f"{side} distortion", model if bent else "none")
    table.add_row("rectified focal length", f"{rig.focal:.2f} px")
    table.add_row("rectified field of view", f"{horizontal:.1f} x {vertical:.1f} deg")
    table.add_row("images need rectifying", "no" if rig.is_rectified else "yes")
    table.add_row("pixels seem to be counted", pixel_convention(rig))
    console.print(table)


def _depths(rig: StereoRig, distances_mm: tuple[float, ...], console: Console) -> None:
    table = new_table("resolution", "distance mm", "disparity px", "depth mm/px", "across mm/px")
    per_mm = 0.001 / rig.metres_per_unit
    for distance_mm in distances_mm:
        distance = distance_mm * per_mm
        table.add_row(
            f"{distance_mm:g}",
            f"{rig.focal * rig.baseline / distance:.1f}",
            f"{depth_step(rig, distance) / per_mm:.3f}",
            f"{distance_mm / rig.focal:.3f}",
        )
    console.print(table)


def _rows(found: Epipolar | None, rig: StereoRig, console: Console) -> None:
    if found is None:
        return
    table = new_table("rows of matched features, rectified", "", "")
    table.show_header = False
    table.add_row("matches", f"{found.matches}")
    table.add_row("vertical error, median", f"{found.median_px:.2f} px")
    table.add_row("vertical error, 95 %", f"{found.p95_px:.2f} px")
    table.add_row("vertical shift (left - right)", f"{found.shift_px:+.2f} px")
    if np.isfinite(found.distance):
        distance_mm = found.distance * rig.mm_per_unit
        table.add_row("distance of the features, median", f"{distance_mm:.4g} mm")
    console.print(table)


def _is_blind(found: Epipolar | None) -> bool:
    """Whether features tell nothing of the side on which the cameras are."""
    return found is None or bool(np.isinf(found.distance))


def _judge(found: Epipolar | None, rig: StereoRig) -> tuple[str | None, list[str]]:
    """Why the images rule the calibration out, and what else they make doubtful."""
    if found is None:
        return None, [
            "too few features match to measure the rows; take images of a scene with more texture"
        ]
    if found.swapped:
        return "features lie where only swapped cameras see them; swap left and right", []
    if found.median_px > _BAD_PX:
        return (
            f"the rows of matched features differ by {found.median_px:.1f} px; has the rig or its "
            "focus been moved since, or are the images of other cameras?"
        ), []
    doubtful = []
    if found.median_px > _GOOD_PX:
        doubtful.append(
            f"rows differ by {found.median_px:.2f} px, good is below {_GOOD_PX:g}; a constant shift of "
            f"half a pixel ({found.shift_px:+.2f} here) comes from another way of counting pixels"
        )
    if _is_blind(found):
        doubtful.append(
            "the matched features have no disparity: they are dirt or compression, or far away; take "
            "images of a near scene with more texture"
        )
    distance_mm = found.distance * rig.mm_per_unit
    if np.isfinite(distance_mm) and not 5 <= distance_mm <= 5000:
        doubtful.append(f"the scene seems {distance_mm:.3g} mm away; is the unit right? (--unit)")
    return None, doubtful

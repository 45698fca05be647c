"""The rig that belongs to the frames."""

from __future__ import annotations

from pathlib import Path

from suturetrack.calibration import load_calibration
from suturetrack.camera import StereoRig
from suturetrack.types import InputError


def open_rig(
    calibration: Path, unit: str | None, scale: float = 1.0, *, rectified: bool = False
) -> StereoRig:
    """Reads a calibration; see `adapt`."""
    return adapt(load_calibration(calibration, unit), scale, rectified=rectified)


def adapt(rig: StereoRig, scale: float = 1.0, *, rectified: bool = False) -> StereoRig:
    """The rig for images unlike those that were calibrated.

    Args:
        rig: as it was calibrated.
        scale: how many times as wide and high the images are.
        rectified: whether somebody has rectified them already.

    Raises:
        InputError: the scale makes no size.
    """
    if not 0.01 <= scale <= 100:
        raise InputError(f"scale {scale:g}: use the width of the images over the calibration's")
    if rectified:
        rig = rig.for_rectified_images()
    return rig if scale == 1 else rig.resized(scale)


def check_size(size: tuple[int, int], rig: StereoRig, images: str, calibration: str) -> None:
    """Raises InputError when views of a size (width, height) are not what the rig is for."""
    if size == rig.image_size:
        return
    (width, height), (for_width, for_height) = size, rig.image_size
    advice = "give the calibration of these images"
    if (height, width) == rig.image_size:
        advice = "is its image size [width, height]?"
    elif abs(width * for_height - height * for_width) <= max(size):
        advice += f", or --scale {width / for_width:.6g} if they were resized after the camera"
    raise InputError(
        f"{images}: views are {width}x{height}, but {calibration} is for "
        f"{for_width}x{for_height}; {advice}"
    )

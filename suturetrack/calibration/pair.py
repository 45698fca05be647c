"""Two lenses and the pose between them -> StereoRig; what every format has to fulfil."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from suturetrack.camera import LARGEST_SIDE, StereoRig
from suturetrack.types import Float64, InputError

METRES_PER_UNIT = {"m": 1.0, "mm": 0.001}
_LARGEST_BASELINE_IN_METRES = 0.5
"""A stereo camera whose number of baseline units is below this is calibrated in metres."""
_LARGEST_SKEW = 1e-6
"""Over the focal length: no more than what rounding leaves of none."""


@dataclass(frozen=True, eq=False)
class Lens:
    """The model of one raw image."""

    matrix: Float64
    """(3, 3) K, px."""
    distortion: Float64
    """OpenCV's coefficients, in OpenCV's order."""
    fisheye: bool
    """Whether they are those of the equidistant model."""
    names: tuple[str, str]
    """What the file calls matrix and distortion."""


def rig_of_pair(
    image_size: tuple[int, int],
    left: Lens,
    right: Lens,
    pose: tuple[Float64, Float64],
    unit: str | None,
    where: str,
) -> StereoRig:
    """The rig of a raw pair.

    Args:
        image_size: (width, height), px.
        left: the left camera.
        right: the right camera.
        pose: R and T of `right_from_left`.
        unit: "m" or "mm"; guessed from T when None.
        where: which file, for messages.

    Raises:
        InputError: impossible values.
    """
    for lens in (left, right):
        check_lens(lens, image_size, where)
    rotation, translation = pose
    if not is_rotation(rotation):
        raise InputError(f"{where}: R is not a rotation matrix (orthonormal, determinant 1)")
    if translation.size != 3 or np.linalg.norm(translation) == 0:
        raise InputError(f"{where}: T must have three entries, not all zero (it is the baseline)")
    if left.fisheye != right.fisheye:
        raise InputError(f"{where}: one camera is equidistant and the other is not; use one model")
    try:
        return StereoRig.from_calibration(
            image_size,
            (left.matrix, left.distortion),
            (right.matrix, right.distortion),
            rotation,
            translation,
            metres_per_unit(unit, float(np.linalg.norm(translation))),
            fisheye=left.fisheye,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def metres_per_unit(unit: str | None, baseline: float) -> float:
    """Length of the unit that was given, or that the baseline suggests."""
    guess = "m" if baseline < _LARGEST_BASELINE_IN_METRES else "mm"
    return METRES_PER_UNIT[unit or guess]


def check_lens(lens: Lens, image_size: tuple[int, int], where: str) -> None:
    """Raises InputError, naming the entry, for a camera that cannot be."""
    if min(image_size) < 16 or max(image_size) > LARGEST_SIDE:
        raise InputError(
            f"{where}: ImageSize {list(image_size)} must be [width, height], 16 to {LARGEST_SIDE} px"
        )
    (name, distortion_name), k, size = lens.names, lens.matrix, np.array(image_size)
    if k[0, 0] <= 0 or k[1, 1] <= 0:
        raise InputError(f"{where}: {name} has a focal length that is not positive")
    if not np.allclose(k[2], [0, 0, 1]) or k[1, 0] != 0:
        raise InputError(f"{where}: {name} is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]")
    if abs(k[0, 1]) > _LARGEST_SKEW * k[0, 0]:
        raise InputError(
            f"{where}: {name} has a skew of {k[0, 1]:g} px; calibrate without skew, as the cameras' "
            "model has none"
        )
    if np.any(k[:2, 2] < -0.5 * size) or np.any(k[:2, 2] > 1.5 * size):
        raise InputError(
            f"{where}: {name} has its principal point {k[:2, 2].round(1).tolist()} far outside "
            f"the image {size.tolist()}; is ImageSize [width, height]?"
        )
    allowed = (4,) if lens.fisheye else (4, 5, 8, 12, 14)
    if lens.distortion.size not in allowed:
        *others, last = map(str, allowed)
        counts = f"{', '.join(others)} or {last}" if others else last
        model = "equidistant " if lens.fisheye else ""
        raise InputError(
            f"{where}: {distortion_name} has {lens.distortion.size} {model}coefficients, not {counts}"
        )


def is_rotation(matrix: Float64) -> bool:
    """Whether a (3, 3) matrix is a rotation, to what files write."""
    orthogonal = np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3)
    return bool(orthogonal and np.linalg.det(matrix) > 0)


def numbers(value: Any, shape: tuple[int, ...], name: str, where: str) -> Float64:
    """A list of numbers as an array of a shape (-1: any); raises InputError."""
    try:
        # YAML takes 1e-05 for a word; NumPy does not.
        array = np.array(value, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {name} must be {_spell(shape)} numbers") from error
    if not np.isfinite(array).all():
        raise InputError(f"{where}: {name} holds values that are not finite")
    return array


def _spell(shape: tuple[int, ...]) -> str:
    return "a list of" if shape == (-1,) else "x".join(map(str, shape))

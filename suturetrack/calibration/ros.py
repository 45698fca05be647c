"""ROS's camera_info, from files or from messages: the rectification is the one it states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from suturetrack.calibration.pair import Lens, check_lens, is_rotation, metres_per_unit, numbers
from suturetrack.camera import Camera, StereoRig
from suturetrack.types import Float64, InputError

_MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "")


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """What ROS tells about one camera of a pair."""

    image_size: tuple[int, int]
    """(width, height), px."""
    model: str
    """plumb_bob, rational_polynomial, equidistant, or empty without distortion."""
    distortion: Float64
    """(n,) in OpenCV's order."""
    matrix: Float64
    """(3, 3) K of the raw image, px."""
    rectification: Float64
    """(3, 3) R, from the camera's own axes to the rectified ones."""
    projection: Float64
    """(3, 4) P; P[0, 3] of the right camera is minus the focal length times the baseline."""


def camera_info(document: dict[str, Any], where: str) -> CameraInfo:
    """The content of a camera_info file; raises InputError."""
    if "camera_matrix" not in document:
        raise InputError(f"{where}: no camera_matrix; it must be a ROS camera_info file")

    def data(name: str, shape: tuple[int, ...]) -> Float64:
        entry = document.get(name)
        if not isinstance(entry, dict) or "data" not in entry:
            raise InputError(f"{where}: no {name} with data")
        rows, columns = (entry.get(key) for key in ("rows", "cols"))
        if len(shape) == 2 and None not in (rows, columns) and (rows, columns) != shape:
            raise InputError(
                f"{where}: {name} is {rows}x{columns}, it must be {shape[0]}x{shape[1]}"
            )
        return numbers(entry["data"], shape, name, where)

    size = [document.get("image_width"), document.get("image_height")]
    width, height = numbers(size, (2,), "image_width, image_height", where)
    return CameraInfo(
        (int(width), int(height)),
        str(document.get("distortion_model", "")),
        data("distortion_coefficients", (-1,)),
        data("camera_matrix", (3, 3)),
        data("rectification_matrix", (3, 3)),
        data("projection_matrix", (3, 4)),
    )


def rig_from_camera_infos(
    left: CameraInfo, right: CameraInfo, unit: str | None, where: str
) -> StereoRig:
    """The rig of a pair, in ROS's rectified left frame.

    Args:
        left: the left camera.
        right: the right camera.
        unit: "m" or "mm", the unit of P; guessed from the baseline when None.
        where: which files or topics, for messages.

    Raises:
        InputError: impossible values, or the two are no pair.
    """
    if left.image_size != right.image_size:
        raise InputError(
            f"{where}: left is for {left.image_size} px, right is for {right.image_size}"
        )
    cameras = [
        _camera(info, f"{where}: {side}") for info, side in ((left, "left"), (right, "right"))
    ]
    p, q = left.projection, right.projection
    if p[0, 3] != 0 and q[0, 3] == 0:
        raise InputError(f"{where}: the baseline P[3] is in the left camera; swap left and right")
    if q[0, 3] == 0:
        raise InputError(
            f"{where}: P[3] of the right camera is 0, so there is no baseline; calibrate the two "
            "cameras as a stereo pair"
        )
    if abs(q[1, 3]) > abs(q[0, 3]):
        raise InputError(f"{where}: the baseline runs along y; the cameras must stand side by side")
    if q[0, 3] > 0:
        raise InputError(
            f"{where}: P[3] of the right camera is positive, so it stands left of the left one; swap "
            "left and right"
        )
    rows = [0, 1, 1], [0, 1, 2]
    if p[0, 3] != 0 or not np.allclose(p[rows], q[rows], rtol=1e-4):
        raise InputError(f"{where}: the projections P are not those of one stereo calibration")
    baseline = float(-q[0, 3] / q[0, 0])
    return StereoRig(left.image_size, cameras[0], cameras[1], metres_per_unit(unit, baseline))


def _camera(info: CameraInfo, where: str) -> Camera:
    if not info.matrix.any():
        raise InputError(f"{where} is not calibrated: its camera matrix K is all zeros")
    if info.model not in _MODELS:
        known = ", ".join(_MODELS[:-1])
        raise InputError(f"{where} has the distortion model {info.model!r}; use {known}")
    distortion = info.distortion if info.distortion.size else np.zeros(4)
    fisheye = info.model == "equidistant"
    lens = Lens(info.matrix, distortion, fisheye, ("camera_matrix", "distortion_coefficients"))
    check_lens(lens, info.image_size, where)
    if not is_rotation(info.rectification):
        raise InputError(f"{where} rectification_matrix is not a rotation matrix")
    if min(info.projection[0, 0], info.projection[1, 1]) <= 0:
        raise InputError(f"{where} projection_matrix has a focal length that is not positive")
    # Files give it to some six digits.
    u, _, vt = np.linalg.svd(info.rectification)
    return Camera(info.matrix, distortion, u @ vt, info.projection, fisheye)

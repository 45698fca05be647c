"""Kalibr's camchain: two pinhole cameras; cam0 is the left one."""

from __future__ import annotations

from typing import Any

import numpy as np

from suturetrack.calibration.pair import Lens, numbers, rig_of_pair
from suturetrack.camera import StereoRig
from suturetrack.types import Float64, InputError

_MODELS = {"radtan": 4, "equidistant": 4, "none": 0}
"""Distortion models and how many coefficients they have, in OpenCV's order."""


def rig_of_camchain(document: dict[str, Any], unit: str | None, where: str) -> StereoRig:
    """The rig of the first two cameras of a camchain; raises InputError."""
    first, second = document.get("cam0"), document.get("cam1")
    if not isinstance(first, dict) or not isinstance(second, dict):
        raise InputError(f"{where}: a camchain of two cameras is needed, cam0 and cam1")
    sizes = [_resolution(first, "cam0", where), _resolution(second, "cam1", where)]
    if sizes[0] != sizes[1]:
        raise InputError(f"{where}: cam0 and cam1 differ in resolution")
    left, right = _lens(first, "cam0", where), _lens(second, "cam1", where)
    pose = numbers(second.get("T_cn_cnm1"), (4, 4), "cam1 T_cn_cnm1", where)
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise InputError(
            f"{where}: the last row of cam1 T_cn_cnm1 must be 0 0 0 1; is it transposed?"
        )
    return rig_of_pair(sizes[0], left, right, (pose[:3, :3], pose[:3, 3]), unit, where)


def _resolution(camera: dict[str, Any], name: str, where: str) -> tuple[int, int]:
    width, height = numbers(camera.get("resolution"), (2,), f"{name} resolution", where)
    return int(width), int(height)


def _lens(camera: dict[str, Any], name: str, where: str) -> Lens:
    if camera.get("camera_model") != "pinhole":
        raise InputError(
            f"{where}: {name} has the camera model {camera.get('camera_model')!r}; use pinhole"
        )
    model = camera.get("distortion_model")
    if not isinstance(model, str) or model not in _MODELS:
        raise InputError(
            f"{where}: {name} has the distortion model {model!r}; use {', '.join(_MODELS)}"
        )
    fu, fv, pu, pv = numbers(camera.get("intrinsics"), (4,), f"{name} intrinsics", where)
    matrix: Float64 = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
    given = camera.get("distortion_coeffs") or []
    coefficients = numbers(given, (_MODELS[model],), f"{name} distortion_coeffs", where)
    distortion = coefficients if coefficients.size else np.zeros(4)
    names = f"{name} intrinsics", f"{name} distortion_coeffs"
    return Lens(matrix, distortion, model == "equidistant", names)

"""Calibration files -> StereoRig.

Formats: OpenCV FileStorage (YAML, XML or JSON) with K1 D1 K2 D2 R T and ImageSize as (width, height).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.types import Float64, InputError

METRES_PER_UNIT = {"m": 1.0, "mm": 0.001}
_SHAPES = {"K1": (3, 3), "K2": (3, 3), "R": (3, 3), "D1": None, "D2": None, "T": None}
# A stereo camera whose number of baseline units is below this is calibrated in metres.
_LARGEST_BASELINE_IN_METRES = 0.5


def load_calibration(path: Path | str, unit: str | None = None) -> StereoRig:
    """Reads the rig from an OpenCV FileStorage file.

    Args:
        path: the file.
        unit: "m" or "mm", the unit of T; guessed from the baseline when None.

    Raises:
        InputError: the file is missing, is no calibration, or holds impossible values; the message
            names the file and the entry.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"calibration: no file {path}")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise InputError(f"calibration {path}: not an OpenCV FileStorage file") from error
    try:
        entries = {name: _matrix(storage, name, path, shape) for name, shape in _SHAPES.items()}
        size = _matrix(storage, "ImageSize", path, None).ravel()
    finally:
        storage.release()
    _check(entries, size, path)
    translation = entries["T"].ravel()
    if unit is None:
        unit = "m" if np.linalg.norm(translation) < _LARGEST_BASELINE_IN_METRES else "mm"
    if unit not in METRES_PER_UNIT:
        raise InputError(f"unit {unit!r}: use one of {', '.join(METRES_PER_UNIT)}")
    try:
        return StereoRig.from_calibration(
            (int(size[0]), int(size[1])),
            (entries["K1"], entries["D1"].ravel()),
            (entries["K2"], entries["D2"].ravel()),
            entries["R"],
            translation,
            METRES_PER_UNIT[unit],
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def save_calibration(path: Path | str, rig: StereoRig) -> None:
    """Writes the rectified rig as an OpenCV FileStorage file that `load_calibration` reads back."""
    left, right = rig.left.projection, rig.right.projection
    entries = {
        "K1": left[:, :3],
        "D1": np.zeros((1, 5)),
        "K2": right[:, :3],
        "D2": np.zeros((1, 5)),
        "R": np.eye(3),
        "T": np.array([[-rig.baseline], [0.0], [0.0]]),
        "ImageSize": np.array([rig.image_size], dtype=float),
    }
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.ascontiguousarray(value))
    storage.release()


def _matrix(
    storage: cv2.FileStorage, name: str, path: Path, shape: tuple[int, int] | None
) -> Float64:
    node = storage.getNode(name)
    value = None if node.empty() else node.mat()
    if value is None:
        raise InputError(
            f"calibration {path}: no matrix {name}; it needs K1 D1 K2 D2 R T ImageSize"
        )
    if not np.isfinite(value).all():
        raise InputError(f"calibration {path}: {name} holds values that are not finite")
    if shape is not None and value.shape != shape:
        raise InputError(f"calibration {path}: {name} is {value.shape}, it must be {shape}")
    return np.asarray(value, dtype=np.float64)


def _check(entries: dict[str, Float64], size: Float64, path: Path) -> None:
    where = f"calibration {path}"
    if size.size != 2 or size.min() < 16 or size.max() > 16384:
        raise InputError(f"{where}: ImageSize {size.tolist()} must be [width, height] in pixels")
    for name in ("K1", "K2"):
        k = entries[name]
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise InputError(f"{where}: {name} has a focal length that is not positive")
        if not np.allclose(k[2], [0, 0, 1]) or k[1, 0] != 0:
            raise InputError(f"{where}: {name} is not a camera matrix [fx 0 cx; 0 fy cy; 0 0 1]")
        if np.any(k[:2, 2] < -0.5 * size) or np.any(k[:2, 2] > 1.5 * size):
            raise InputError(
                f"{where}: {name} has its principal point {k[:2, 2].round(1).tolist()} far outside "
                f"the image {size.astype(int).tolist()}; is ImageSize [width, height]?"
            )
    for name in ("D1", "D2"):
        if entries[name].size not in (4, 5, 8, 12, 14):
            raise InputError(
                f"{where}: {name} has {entries[name].size} coefficients, not 4, 5, 8, 12 or 14"
            )
    rotation, translation = entries["R"], entries["T"]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: R is not a rotation matrix")
    if translation.size != 3 or np.linalg.norm(translation) == 0:
        raise InputError(f"{where}: T must have three entries, not all zero (it is the baseline)")

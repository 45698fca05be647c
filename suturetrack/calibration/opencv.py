"""OpenCV FileStorage."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from suturetrack.calibration.pair import Lens, rig_of_pair
from suturetrack.camera import StereoRig
from suturetrack.types import Float64, InputError

_SHAPES = {"K1": (3, 3), "K2": (3, 3), "R": (3, 3), "D1": None, "D2": None, "T": None}
_MODEL = "distortion_model"
"""An entry of our own: which functions of OpenCV D1 and D2 belong to."""
_IS_FISHEYE = {"equidistant": True, "plumb_bob": False, "rational_polynomial": False}
"""By ROS's names of the models; without the entry it is none of `cv2.fisheye`."""


def read(path: Path, unit: str | None, where: str) -> StereoRig:
    """The rig of a FileStorage file; raises InputError."""
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise InputError(f"{where}: not an OpenCV FileStorage file") from error
    try:
        entries = {name: _matrix(storage, name, where, shape) for name, shape in _SHAPES.items()}
        size = _image_size(storage, where)
        fisheye = _is_fisheye(storage, where)
    finally:
        storage.release()
    if size.size != 2 or (size != np.rint(size)).any():
        raise InputError(
            f"{where}: ImageSize {size.tolist()} must be [width, height] in whole pixels"
        )
    left, right = (
        Lens(entries[k], entries[d].ravel(), fisheye, (k, d))
        for k, d in (("K1", "D1"), ("K2", "D2"))
    )
    pose = entries["R"], entries["T"].ravel()
    return rig_of_pair((int(size[0]), int(size[1])), left, right, pose, unit, where)


def save_calibration(path: Path | str, rig: StereoRig) -> None:
    """Writes the rig as an OpenCV FileStorage file that `load_calibration` reads back.

    The rectified frame of what is read back is the one that OpenCV chooses; R1 R2 P1 P2 tell that
    of this rig.
    """
    rotation, translation = rig.right_from_left
    entries: dict[str, Float64] = {"R": rotation, "T": translation.reshape(3, 1)}
    for number, camera in ((1, rig.left), (2, rig.right)):
        entries[f"K{number}"] = camera.matrix
        entries[f"D{number}"] = camera.distortion.reshape(1, -1)
        entries[f"R{number}"] = camera.rectification
        entries[f"P{number}"] = camera.projection
    entries["ImageSize"] = np.array([rig.image_size], dtype=float)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.ascontiguousarray(value))
    if rig.left.fisheye:
        storage.write(_MODEL, "equidistant")
    storage.release()


def _is_fisheye(storage: cv2.FileStorage, where: str) -> bool:
    node = storage.getNode(_MODEL)
    if node.empty():
        return False
    model = node.string() if node.isString() else "no word"
    if model not in _IS_FISHEYE:
        raise InputError(
            f"{where}: {_MODEL} is {model}; use equidistant where D1 and D2 are of cv2.fisheye, "
            "else plumb_bob or rational_polynomial"
        )
    return _IS_FISHEYE[model]


def _image_size(storage: cv2.FileStorage, where: str) -> Float64:
    """A matrix, or a plain list, as C++ writes a `cv::Size`."""
    node = storage.getNode("ImageSize")
    if not node.isSeq():
        return _matrix(storage, "ImageSize", where, None).ravel()
    entries = [node.at(i) for i in range(node.size())]
    if not all(entry.isInt() or entry.isReal() for entry in entries):
        raise InputError(f"{where}: ImageSize must be [width, height] in pixels")
    return np.array([entry.real() for entry in entries])


def _matrix(
    storage: cv2.FileStorage, name: str, where: str, shape: tuple[int, int] | None
) -> Float64:
    node = storage.getNode(name)
    try:
        value = node.mat() if node.isMap() else None
    except cv2.error:
        value = None
    if value is None:
        raise InputError(f"{where}: no matrix {name}; it needs K1 D1 K2 D2 R T ImageSize")
    if not np.isfinite(value).all():
        raise InputError(f"{where}: {name} holds values that are not finite")
    if shape is not None and value.shape != shape:
        raise InputError(f"{where}: {name} is {value.shape}, it must be {shape}")
    return np.asarray(value, dtype=np.float64)

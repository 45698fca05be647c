"""Calibration files -> StereoRig, in the three formats that people bring; told apart by content.

- OpenCV FileStorage (YAML, XML or JSON): K1 D1 K2 D2 R T, and ImageSize as (width, height).
- ROS: a camera_info file for each camera, given as their folder or as `LEFT,RIGHT`.
- Kalibr: a camchain of two pinhole cameras.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from suturetrack.calibration import kalibr, opencv, ros
from suturetrack.calibration.opencv import save_calibration
from suturetrack.calibration.pair import METRES_PER_UNIT
from suturetrack.calibration.ros import CameraInfo, rig_from_camera_infos
from suturetrack.camera import StereoRig
from suturetrack.types import InputError

_NEEDED = (
    "it needs K1 D1 K2 D2 R T ImageSize (OpenCV), cam0 and cam1 (Kalibr), or camera_matrix in each "
    "of two files (ROS)"
)


def load_calibration(path: Path | str, unit: str | None = None) -> StereoRig:
    """Reads the rig from a file, from a folder with left.yaml and right.yaml, or from `LEFT,RIGHT`.

    Args:
        path: where the calibration is.
        unit: "m" or "mm", the unit of its lengths; guessed from the baseline when None.

    Raises:
        InputError: something is missing, is no calibration, or holds impossible values; the message
            names the file and the entry.
    """
    if unit is not None and unit not in METRES_PER_UNIT:
        raise InputError(f"unit {unit!r}: use one of {', '.join(METRES_PER_UNIT)}")
    path = Path(path)
    pair = _ros_pair(path)
    if pair is not None:
        infos = [ros.camera_info(_document(part), f"calibration {part}") for part in pair]
        return rig_from_camera_infos(infos[0], infos[1], unit, f"calibration {path}")
    where = f"calibration {path}"
    if b"opencv-matrix" in _content(path):
        return opencv.read(path, unit, where)
    document = _document(path)
    if "cam0" in document:
        return kalibr.rig_of_camchain(document, unit, where)
    if "camera_matrix" in document:
        raise InputError(f"{where}: one camera of a ROS pair; give both files as LEFT,RIGHT")
    raise InputError(f"{where}: no calibration; {_NEEDED}")


def _ros_pair(path: Path) -> list[Path] | None:
    if path.is_dir():
        pair = [sorted(path.glob(f"{side}.y*ml")) for side in ("left", "right")]
        if not all(pair):
            raise InputError(f"calibration {path}: a folder needs left.yaml and right.yaml (ROS)")
        return [found[0] for found in pair]
    if path.exists() or "," not in str(path):
        return None
    parts = [Path(part) for part in str(path).split(",")]
    if len(parts) != 2:
        raise InputError(f"calibration {path}: at most two files, LEFT,RIGHT")
    return parts


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"calibration: no file {path}") from error
    except OSError as error:
        raise InputError(f"calibration {path}: {error.strerror}") from error


def _document(path: Path) -> dict[str, Any]:
    try:
        document = yaml.safe_load(_content(path).decode())
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"calibration {path}: not a calibration; {_NEEDED}") from error
    if not isinstance(document, dict):
        raise InputError(f"calibration {path}: no calibration; {_NEEDED}")
    return document


__all__ = [
    "METRES_PER_UNIT",
    "CameraInfo",
    "load_calibration",
    "rig_from_camera_infos",
    "save_calibration",
]

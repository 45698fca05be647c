"""Calibration files: what is read, what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from suturetrack.calibration import load_calibration, save_calibration
from suturetrack.camera import StereoRig
from suturetrack.types import InputError

K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
GOOD = {
    "K1": K,
    "D1": np.zeros((1, 5)),
    "K2": K,
    "D2": np.zeros((1, 5)),
    "R": np.eye(3),
    "T": np.array([[-40.0], [0], [0]]),
    "ImageSize": np.array([[640.0, 480.0]]),
}


def write(path: Path, **changes: np.ndarray | None) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (GOOD | changes).items():
        if value is not None:
            storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_opencv_file_storage_is_read(tmp_path: Path, suffix: str) -> None:
    rig = load_calibration(write(tmp_path / f"rig{suffix}"))
    assert rig.image_size == (640, 480)
    assert rig.baseline == pytest.approx(40)
    assert rig.focal == pytest.approx(800)
    assert rig.is_rectified


@pytest.mark.parametrize(
    ("baseline", "unit", "metres"),
    [(40.0, None, 0.001), (0.04, None, 1.0), (0.4, "mm", 0.001), (40.0, "m", 1.0)],
)
def test_the_unit_is_guessed_from_the_baseline_or_given(
    tmp_path: Path, baseline: float, unit: str | None, metres: float
) -> None:
    path = write(tmp_path / "rig.yaml", T=np.array([[-baseline], [0], [0]]))
    assert load_calibration(path, unit).metres_per_unit == metres


def test_a_saved_rig_is_read_back(tmp_path: Path, rig: StereoRig) -> None:
    save_calibration(tmp_path / "rig.yaml", rig)
    again = load_calibration(tmp_path / "rig.yaml")
    assert again.image_size == rig.image_size
    assert np.allclose(again.left.projection, rig.left.projection)
    assert np.allclose(again.right.projection, rig.right.projection)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"K1": None}, "no matrix K1"),
        ({"ImageSize": None}, "no matrix ImageSize"),
        ({"T": np.zeros((3, 1))}, "T must have three entries, not all zero"),
        ({"T": np.array([[40.0], [0], [0]])}, "swap left and right"),
        ({"R": np.diag([1.0, 1, -1])}, "R is not a rotation"),
        ({"R": 2 * np.eye(3)}, "R is not a rotation"),
        ({"K2": np.diag([-800.0, 800, 1])}, "K2 has a focal length that is not positive"),
        ({"K1": np.eye(2)}, r"K1 is \(2, 2\), it must be \(3, 3\)"),
        ({"K1": K * np.nan}, "K1 holds values that are not finite"),
        ({"K1": K.T.copy()}, "K1 is not a camera matrix"),
        ({"D2": np.zeros((1, 3))}, "D2 has 3 coefficients"),
        ({"ImageSize": np.array([[0.0, 480]])}, "ImageSize"),
        ({"ImageSize": np.array([[100.0, 100.0]])}, "principal point"),
    ],
)
def test_impossible_values_are_refused_by_name(
    tmp_path: Path, changes: dict[str, np.ndarray | None], words: str
) -> None:
    path = write(tmp_path / "rig.yaml", **changes)
    with pytest.raises(InputError, match=words) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)
    assert "rig.yaml" in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"not a calibration", b"\x00\xff" * 99, b"%YAML 1.2\n---\n"]
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "rig.yaml").write_bytes(content)
    with pytest.raises(InputError, match=r"rig\.yaml"):
        load_calibration(tmp_path / "rig.yaml")


def test_a_missing_file_and_an_unknown_unit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        load_calibration(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="use one of m, mm"):
        load_calibration(write(tmp_path / "rig.yaml"), "cm")

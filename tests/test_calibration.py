"""Calibration files: what is read, what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

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


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_an_image_size_may_be_a_plain_list_as_cpp_writes_it(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"rig{suffix}", ImageSize=None)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_APPEND)
    storage.startWriteStruct("ImageSize", cv2.FileNode_SEQ)
    storage.write("", 640)
    storage.write("", 480)
    storage.endWriteStruct()
    storage.release()
    assert load_calibration(path).image_size == (640, 480)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("ImageSize: [ 640, wide ]", "ImageSize must be"),
        ("ImageSize: [ 640 ]", r"ImageSize \[640.0\] must be"),
        ("ImageSize: 640", "no matrix ImageSize"),
        ("ImageSize:\n   width: 640\n   height: 480", "no matrix ImageSize"),
    ],
)
def test_another_image_size_is_refused(tmp_path: Path, entry: str, words: str) -> None:
    path = write(tmp_path / "rig.yaml", ImageSize=None)
    path.write_text(f"{path.read_text()}{entry}\n")
    with pytest.raises(InputError, match=words):
        load_calibration(path)


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
        ({"T": np.array([[40.0], [0], [0]])}, "rig.yaml: the right camera .* swap left and right"),
        ({"T": np.array([[0.0], [0], [-40]])}, r"T \[0.0, 0.0, -40.0\] must run along x"),
        ({"R": np.diag([1.0, 1, -1])}, "R is not a rotation"),
        ({"R": 2 * np.eye(3)}, "R is not a rotation"),
        ({"K2": np.diag([-800.0, 800, 1])}, "K2 has a focal length that is not positive"),
        ({"K1": np.eye(2)}, r"K1 is \(2, 2\), it must be \(3, 3\)"),
        ({"K1": K * np.nan}, "K1 holds values that are not finite"),
        ({"K1": K.T.copy()}, "K1 is not a camera matrix"),
        ({"K2": K + 2 * np.eye(3, k=1) * [0, 1, 0]}, "K2 has a skew of 2 px; calibrate without"),
        ({"D2": np.zeros((1, 3))}, "D2 has 3 coefficients"),
        ({"ImageSize": np.array([[0.0, 480]])}, "ImageSize"),
        ({"ImageSize": np.array([[640.5, 480.0]])}, r"ImageSize \[640.5, 480.0\] .* whole pixels"),
        ({"ImageSize": np.array([[9216.0, 480]])}, "16 to 8192 px"),
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


@pytest.mark.parametrize("entry", ["fisheye", "Equidistant", "4"])
def test_an_unknown_lens_model_is_not_taken_for_a_radial_one(tmp_path: Path, entry: str) -> None:
    four = np.zeros((1, 4))
    path = write(tmp_path / "rig.yaml", D1=four, D2=four)
    path.write_text(f"{path.read_text()}distortion_model: {entry}\n")
    with pytest.raises(InputError, match=r"rig\.yaml: distortion_model is .* use equidistant"):
        load_calibration(path)


def test_a_missing_file_and_an_unknown_unit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        load_calibration(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="use one of m, mm"):
        load_calibration(write(tmp_path / "rig.yaml"), "cm")


SIZE = (640, 480)
LEFT = np.array([[610.0, 0, 331], [0, 612, 236], [0, 0, 1]])
RIGHT = np.array([[603.0, 0, 309], [0, 601, 247], [0, 0, 1]])
ROTATION = cv2.Rodrigues(np.array([0.004, -0.05, 0.008]))[0]
TRANSLATION = np.array([-40.0, 0.6, 0.9])
RADIAL = np.array([-0.21, 0.05, 0.001, -0.002])
RATIONAL = np.array([0.9, 0.2, 0.001, -0.002, 0.01, 1.1, 0.3, 0.02])
EQUIDISTANT = np.array([0.05, -0.01, 0.002, -0.001])
POINTS = np.c_[
    np.random.default_rng(3).uniform(-50, 50, (50, 2)),
    np.random.default_rng(4).uniform(150, 260, 50),
]
"""In the raw left camera's axes, in front of both cameras."""


def seen(distortion: np.ndarray, *, fisheye: bool) -> tuple[np.ndarray, np.ndarray]:
    """Raw pixels of POINTS in both cameras, by OpenCV alone."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    points = POINTS.reshape(-1, 1, 3)
    rotation = cv2.Rodrigues(ROTATION)[0]
    left = project(points, np.zeros(3), np.zeros(3), LEFT, distortion)[0]
    right = project(points, rotation, TRANSLATION, RIGHT, distortion)[0]
    return left.reshape(-1, 2), right.reshape(-1, 2)


def camera_info(
    k: np.ndarray,
    d: np.ndarray,
    model: str,
    r: np.ndarray,
    p: np.ndarray,
    size: tuple[int, int] = SIZE,
) -> dict[str, Any]:
    def matrix(value: np.ndarray) -> dict[str, Any]:
        rows, columns = np.atleast_2d(value).shape
        return {"rows": rows, "cols": columns, "data": value.ravel().tolist()}

    return {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": "endoscope",
        "camera_matrix": matrix(k),
        "distortion_model": model,
        "distortion_coefficients": matrix(d),
        "rectification_matrix": matrix(r),
        "projection_matrix": matrix(p),
    }


def ros_pair(d: np.ndarray, model: str, scale: float = 1.0) -> tuple[dict[str, Any], ...]:
    """What ROS's calibrator writes; `scale` units in a millimetre."""
    rectify = cv2.fisheye.stereoRectify if model == "equidistant" else cv2.stereoRectify
    shift = scale * TRANSLATION.reshape(3, 1)
    r1, r2, p1, p2, *_ = rectify(
        LEFT, d, RIGHT, d, SIZE, ROTATION, shift, flags=cv2.CALIB_ZERO_DISPARITY
    )
    return camera_info(LEFT, d, model, r1, p1), camera_info(RIGHT, d, model, r2, p2)


def write_pair(folder: Path, left: dict[str, Any], right: dict[str, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, info in (("left", left), ("right", right)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(info))
    return folder


def camchain(d: np.ndarray, model: str, scale: float = 1.0) -> dict[str, Any]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = ROTATION, scale * TRANSLATION

    def camera(k: np.ndarray) -> dict[str, Any]:
        return {
            "cam_overlaps": [1],
            "camera_model": "pinhole",
            "distortion_coeffs": d.tolist(),
            "distortion_model": model,
            "intrinsics": [float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "resolution": list(SIZE),
            "rostopic": "/image_raw",
        }

    return {"cam0": camera(LEFT), "cam1": camera(RIGHT) | {"T_cn_cnm1": pose.tolist()}}


def write_camchain(path: Path, document: dict[str, Any]) -> Path:
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.fixture(
    params=["ros plumb_bob", "ros rational", "ros equidistant", "kalibr", "kalibr fisheye"]
)
def told(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[StereoRig, np.ndarray, bool]:
    """A rig read from a file of every kind, in mm, its distortion, and whether it is a fisheye's."""
    name = request.param
    if name == "ros plumb_bob":
        d = np.r_[RADIAL, 0.01]
        path = write_pair(tmp_path, *ros_pair(d, "plumb_bob"))
    elif name == "ros rational":
        d = RATIONAL
        path = write_pair(tmp_path, *ros_pair(d, "rational_polynomial"))
    elif name == "ros equidistant":
        d = EQUIDISTANT
        path = write_pair(tmp_path, *ros_pair(d, "equidistant"))
    elif name == "kalibr":
        d = RADIAL
        path = write_camchain(tmp_path / "camchain.yaml", camchain(d, "radtan"))
    else:
        d = EQUIDISTANT
        path = write_camchain(tmp_path / "camchain.yaml", camchain(d, "equidistant"))
    return load_calibration(path), d, d is EQUIDISTANT


def test_every_format_sees_points_where_opencv_sees_them(
    told: tuple[StereoRig, np.ndarray, bool],
) -> None:
    rig, d, fisheye = told
    assert rig.image_size == SIZE
    assert rig.metres_per_unit == 0.001
    assert rig.baseline == pytest.approx(np.linalg.norm(TRANSLATION), rel=1e-6)
    raw = seen(d, fisheye=fisheye)
    points = POINTS @ rig.left.rectification.T
    for mine, expected in zip(rig.project_raw(points), raw, strict=True):
        np.testing.assert_allclose(mine, expected, atol=1e-4)
    left = rig.rectify_pixels(raw[0])
    right = rig.rectify_pixels(raw[1], right=True)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=0.05)
    np.testing.assert_allclose(rig.triangulate(left, right), points, rtol=2e-3, atol=0.1)


def test_images_are_rectified_to_where_points_are_projected(
    told: tuple[StereoRig, np.ndarray, bool],
) -> None:
    rig, d, fisheye = told
    points = (POINTS @ rig.left.rectification.T)[:10]
    for side, raw in enumerate(seen(d, fisheye=fisheye)):
        for point, (u, v) in zip(points, raw[:10], strict=True):
            image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
            cv2.circle(image, (round(u * 16), round(v * 16)), 48, 255, -1, cv2.LINE_AA, 4)
            view = rig.rectify(image, image)[side].astype(float)
            rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
            centre = np.array([(view * columns).sum(), (view * rows).sum()]) / view.sum()
            np.testing.assert_allclose(centre, rig.project(point)[side], atol=0.15)


def test_all_formats_agree_on_one_rig(tmp_path: Path) -> None:
    entries = {"K1": LEFT, "K2": RIGHT, "R": ROTATION, "T": TRANSLATION.reshape(3, 1)}
    d = {"D1": RADIAL.reshape(1, -1), "D2": RADIAL.reshape(1, -1)}
    rigs = [
        load_calibration(write(tmp_path / "opencv.yaml", **entries, **d)),
        load_calibration(write_pair(tmp_path / "ros", *ros_pair(RADIAL, "plumb_bob"))),
        load_calibration(write_camchain(tmp_path / "kalibr.yaml", camchain(RADIAL, "radtan"))),
    ]
    for rig in rigs[1:]:
        for mine, first in ((rig.left, rigs[0].left), (rig.right, rigs[0].right)):
            np.testing.assert_allclose(mine.projection, first.projection, atol=1e-6)
            np.testing.assert_allclose(mine.rectification, first.rectification, atol=1e-9)


@pytest.mark.parametrize(("scale", "unit"), [(1.0, 0.001), (0.001, 1.0)])
def test_metres_and_millimetres_are_told_apart(tmp_path: Path, scale: float, unit: float) -> None:
    for path in (
        write_pair(tmp_path / "ros", *ros_pair(RADIAL, "plumb_bob", scale)),
        write_camchain(tmp_path / "kalibr.yaml", camchain(RADIAL, "radtan", scale)),
    ):
        rig = load_calibration(path)
        assert rig.metres_per_unit == unit
        assert rig.baseline * rig.metres_per_unit == pytest.approx(0.04, rel=1e-3)


def test_a_pair_is_given_as_two_paths_too(tmp_path: Path) -> None:
    folder = write_pair(tmp_path / "ros", *ros_pair(RADIAL, "plumb_bob"))
    both = f"{folder / 'left.yaml'},{folder / 'right.yaml'}"
    assert load_calibration(both).baseline == load_calibration(folder).baseline
    with pytest.raises(InputError, match="at most two files"):
        load_calibration(f"{both},x.yaml")
    with pytest.raises(InputError, match="one camera of a ROS pair; give both files"):
        load_calibration(folder / "left.yaml")
    (folder / "right.yaml").unlink()
    with pytest.raises(InputError, match=r"needs left\.yaml and right\.yaml"):
        load_calibration(folder)


def test_a_rectified_pair_of_ros_leaves_images_alone(tmp_path: Path) -> None:
    k = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    p = np.c_[k, np.zeros(3)]
    q = p.copy()
    q[0, 3] = -500 * 0.005
    none, eye = np.zeros(5), np.eye(3)
    left, right = (camera_info(k, none, "plumb_bob", eye, side) for side in (p, q))
    rig = load_calibration(write_pair(tmp_path, left, right))
    assert rig.is_rectified
    assert rig.baseline == pytest.approx(0.005)
    # Another P than K: the images have to be scaled, and are not rectified yet.
    smaller = camera_info(1.2 * k * [[1], [1], [1 / 1.2]], none, "plumb_bob", eye, p)
    assert not load_calibration(write_pair(tmp_path, smaller, right)).is_rectified


def broken_pair(change: str) -> tuple[dict[str, Any], ...]:
    left, right = ros_pair(np.r_[RADIAL, 0.0], "plumb_bob")
    p = right["projection_matrix"]["data"]
    match change:
        case "no baseline":
            p[3] = 0.0
        case "swapped":
            left, right = right, left
        case "mirrored":
            p[3] = -p[3]
        case "vertical":
            p[3], p[7] = 0.1, p[3]
        case "two single cameras":
            p[0] = p[5] = 1.1 * p[0]
        case "size":
            right["image_width"] = 720
        case "model":
            right["distortion_model"] = "fov"
        case "uncalibrated":
            left["camera_matrix"]["data"] = [0.0] * 9
        case "no rotation":
            left["rectification_matrix"]["data"] = [0.0] * 9
        case "short":
            left["projection_matrix"]["data"] = p[:9]
        case "transposed":
            left["projection_matrix"] |= {"rows": 4, "cols": 3}
        case "word":
            left["projection_matrix"]["data"] = ["wide"] * 12
        case "none":
            del left["projection_matrix"]
    return left, right


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("no baseline", r"P\[3\] of the right camera is 0"),
        ("swapped", r"the baseline P\[3\] is in the left camera; swap"),
        ("mirrored", r"P\[3\] of the right camera is positive"),
        ("vertical", "baseline runs along y"),
        ("two single cameras", "not those of one stereo calibration"),
        ("size", r"left is for \(640, 480\) px, right is for \(720, 480\)"),
        ("model", "right has the distortion model 'fov'; use plumb_bob"),
        ("uncalibrated", "left is not calibrated"),
        ("no rotation", "left rectification_matrix is not a rotation"),
        ("short", "projection_matrix must be 3x4 numbers"),
        ("word", "projection_matrix must be 3x4 numbers"),
        ("transposed", "left.yaml: projection_matrix is 4x3, it must be 3x4"),
        ("none", "no projection_matrix with data"),
    ],
)
def test_a_ros_pair_that_cannot_be_is_refused(tmp_path: Path, change: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        load_calibration(write_pair(tmp_path, *broken_pair(change)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cam1": None}, "a camchain of two cameras is needed"),
        ({"cam0": {"camera_model": "omni"}}, "cam0 has the camera model 'omni'; use pinhole"),
        ({"cam0": {"distortion_model": "fov"}}, "cam0 has the distortion model 'fov'; use radtan"),
        ({"cam0": {"distortion_model": [1]}}, r"cam0 has the distortion model \[1\]; use radtan"),
        ({"cam0": {"distortion_model": "equidistant"}}, "one camera is equidistant"),
        ({"cam0": {"distortion_coeffs": [0.1, 0.2]}}, "cam0 distortion_coeffs must be 4 numbers"),
        ({"cam0": {"intrinsics": "fine"}}, "cam0 intrinsics must be 4 numbers"),
        ({"cam0": {"resolution": [720, 480]}}, "differ in resolution"),
        ({"cam1": {"T_cn_cnm1": None}}, "cam1 T_cn_cnm1 must be 4x4 numbers"),
        ({"cam1": {"T_cn_cnm1": np.diag([1.0, 1, -1, 1]).tolist()}}, "R is not a rotation"),
        ({"cam1": {"T_cn_cnm1": np.eye(4)[::-1].tolist()}}, "last row of cam1 T_cn_cnm1 must be"),
        ({"cam1": {"T_cn_cnm1": np.eye(4).tolist()}}, "T must have three entries, not all zero"),
    ],
)
def test_a_camchain_that_cannot_be_is_refused(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    document = camchain(RADIAL, "radtan")
    for camera, entries in change.items():
        document[camera] = entries and document[camera] | entries
    with pytest.raises(InputError, match=words) as caught:
        load_calibration(write_camchain(tmp_path / "camchain.yaml", document))
    assert "camchain.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_camchain_whose_first_camera_is_the_right_one_is_refused(tmp_path: Path) -> None:
    document = camchain(RADIAL, "radtan")
    pose = np.linalg.inv(np.array(document["cam1"]["T_cn_cnm1"]))
    document["cam1"]["T_cn_cnm1"] = pose.tolist()
    with pytest.raises(InputError, match="swap left and right"):
        load_calibration(write_camchain(tmp_path / "camchain.yaml", document))


def test_a_raw_rig_is_saved_with_its_lenses(
    tmp_path: Path, told: tuple[StereoRig, np.ndarray, bool]
) -> None:
    rig = told[0]
    save_calibration(tmp_path / "saved.yaml", rig)
    again = load_calibration(tmp_path / "saved.yaml")
    for mine, first in ((again.left, rig.left), (again.right, rig.right)):
        assert mine.fisheye == first.fisheye
        np.testing.assert_array_equal(mine.matrix, first.matrix)
        np.testing.assert_array_equal(mine.distortion, first.distortion)
        np.testing.assert_allclose(mine.rectification, first.rectification, atol=1e-9)
        np.testing.assert_allclose(mine.projection, first.projection, atol=1e-5)

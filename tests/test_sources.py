from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import psutil
import pytest

from services.bus import Bus
from services.memory_transport import Hub
from services.service import Service, ServiceConfig
from services.source import SourceConfig, _Pace, run
from services.sources import InputConfig, open_input
from services.sources.footage import Footage
from suturetrack.calibration import save_calibration
from suturetrack.camera import StereoRig
from suturetrack.stage import open_scene
from suturetrack.types import Image, InputError

COUNT = 6
WIDTH, HEIGHT = 320, 240


def picture(index: int, side: int) -> Image:
    """A picture that tells its frame and its side even after lossy compression."""
    image = np.full((HEIGHT, WIDTH, 3), 20 + 30 * index, np.uint8)
    image[:, :40] = 230 if side else 10
    return image


def told(image: Image) -> tuple[int, int]:
    """Frame and side of a picture."""
    return round((float(image[100, 200].mean()) - 20) / 30), int(image[100, 20].mean() > 100)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    k, d = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]), np.zeros(5)
    translation = np.array([-40.0, 0, 0])
    rig = StereoRig.from_calibration((WIDTH, HEIGHT), (k, d), (k, d), np.eye(3), translation, 0.001)
    save_calibration(tmp_path / "calibration.yaml", rig)
    return tmp_path / "calibration.yaml"


def write_video(path: Path, pictures: list[Image], fps: float = 20) -> None:
    size = pictures[0].shape[1], pictures[0].shape[0]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for image in pictures:
        writer.write(image)
    writer.release()


def write_folder(folder: Path, suffix: str = "png") -> None:
    for side, name in enumerate(("left", "right")):
        (folder / name).mkdir(parents=True)
        for i in range(COUNT):
            cv2.imwrite(str(folder / name / f"{i:04}.{suffix}"), picture(i, side))


def both(index: int) -> Image:
    return np.hstack([picture(index, 0), picture(index, 1)])


def open_footage(source: object, calibration: Path, fps: float = 30) -> Footage:
    return open_input(InputConfig(str(source), calibration, fps=fps))[0]


@pytest.fixture(params=["folder", "side-by-side", "two videos"])
def footage(request: pytest.FixtureRequest, tmp_path: Path, calibration: Path) -> Footage:
    if request.param == "folder":
        write_folder(tmp_path / "pairs")
        return open_footage(tmp_path / "pairs", calibration, fps=20)
    if request.param == "side-by-side":
        write_video(tmp_path / "both.avi", [both(i) for i in range(COUNT)])
        return open_footage(tmp_path / "both.avi", calibration)
    for side, name in enumerate(("left", "right")):
        write_video(tmp_path / f"{name}.avi", [picture(i, side) for i in range(COUNT)])
    return open_footage(f"{tmp_path / 'left.avi'},{tmp_path / 'right.avi'}", calibration)


def test_frames_come_in_order_with_the_recordings_own_time(footage: Footage) -> None:
    assert footage.size == (WIDTH, HEIGHT)
    assert footage.fps == 20
    assert footage.frame_count == COUNT
    for i in range(COUNT):
        exposure = footage.read(i)
        assert exposure is not None
        assert told(exposure.left) == (i, 0)
        assert told(exposure.right) == (i, 1)
        assert exposure.capture_ns == i * 50_000_000
    assert footage.read(COUNT) is None


@pytest.mark.parametrize(
    "names",
    [
        [f"frame {i + 8}" for i in range(COUNT)],
        ["1700000099.5", *(f"1700000100.{s}" for s in ("05", "1", "25", "3", "6"))],
    ],
    ids=["counted", "seconds"],
)
def test_images_of_a_folder_come_in_the_order_of_their_numbers(
    tmp_path: Path, calibration: Path, names: list[str]
) -> None:
    write_folder(tmp_path / "pairs")
    for path in list(tmp_path.glob("pairs/*/*.png")):
        path.rename(path.with_name(f"{names[int(path.stem)]} {path.parent.name}.png"))
    footage = open_footage(tmp_path / "pairs", calibration)
    for i in range(COUNT):
        exposure = footage.read(i)
        assert exposure is not None
        assert (told(exposure.left), told(exposure.right)) == ((i, 0), (i, 1))


def test_frames_can_be_left_out(footage: Footage) -> None:
    for i in (0, 3, 5):
        exposure = footage.read(i)
        assert exposure is not None
        assert told(exposure.left) == (i, 0)
    assert footage.read(COUNT + 5) is None


def test_the_bench_top_knows_its_rig_its_seed_and_the_truth() -> None:
    footage, rig = open_input(InputConfig("stage:figure8-175", scene_seed=2, fps=25))
    scene = open_scene("figure8-175", 2, fps=25)
    assert rig.baseline == scene.rig.baseline
    assert footage.seeds == (scene.seed_pixel(0),)
    exposure = footage.read(3)
    assert exposure is not None
    np.testing.assert_array_equal(exposure.left, scene.render(3)[0])
    assert exposure.truths[0].length == pytest.approx(175, rel=1e-3)
    assert exposure.capture_ns == 120_000_000
    assert footage.read(scene.frame_count) is None


def read_all(source: object, calibration: Path) -> None:
    footage = open_footage(source, calibration)
    for i in range(COUNT):
        footage.read(i)


def refused(source: object, calibration: Path, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as error:
        read_all(source, calibration)
    assert "\n" not in str(error.value)


def test_a_folder_that_is_none_of_pairs_is_refused(tmp_path: Path, calibration: Path) -> None:
    folder = tmp_path / "pairs"
    folder.mkdir()
    refused(folder, calibration, "no folder left/; it needs")
    (folder / "left").mkdir()
    (folder / "right").mkdir()
    refused(folder, calibration, "no images in left/ or right/")
    cv2.imwrite(str(folder / "left" / "0.png"), picture(0, 0))
    cv2.imwrite(str(folder / "right" / "0.png"), picture(0, 1))
    cv2.imwrite(str(folder / "right" / "1.png"), picture(0, 1))
    refused(folder, calibration, "1 images in left/, 2 in right/")


@pytest.mark.parametrize(
    ("left", "right"),
    [("", ""), ("left_", "right_"), ("Left_", "Right_"), ("L_", "R_"), ("cam0_", "cam1_")],
)
def test_a_folder_whose_sides_lack_different_images_is_refused(
    tmp_path: Path, calibration: Path, left: str, right: str
) -> None:
    write_folder(tmp_path / "pairs")
    (tmp_path / "pairs" / "left" / "0001.png").unlink()
    (tmp_path / "pairs" / "right" / "0004.png").unlink()
    for side, prefix in (("left", left), ("right", right)):
        for path in list((tmp_path / "pairs" / side).iterdir()):
            path.rename(path.with_name(prefix + path.name))
    words = rf"left/{left}0002\.png would be paired with right/{right}0001\.png, not with right/{right}0002"
    refused(tmp_path / "pairs", calibration, words)


def test_time_stamps_that_agree_nowhere_are_paired_in_order(
    tmp_path: Path, calibration: Path
) -> None:
    write_folder(tmp_path / "pairs")
    for side, began in (("left", 1700000000.0), ("right", 1700000000.004)):
        for path in list((tmp_path / "pairs" / side).iterdir()):
            path.rename(path.with_name(f"{began + int(path.stem) / 20:.3f}.png"))
    exposure = open_footage(tmp_path / "pairs", calibration).read(3)
    assert exposure is not None
    assert (told(exposure.left), told(exposure.right)) == ((3, 0), (3, 1))


def cut(suffix: str) -> bytes:
    """An image file without its last tenth."""
    whole = cv2.imencode(suffix, picture(2, 1))[1].tobytes()
    return whole[: len(whole) * 9 // 10]


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint16), "uint16; convert it to 8 bit"),
        (
            np.zeros((HEIGHT, WIDTH), np.uint8),
            "left is 320x240 in colour, right is 320x240 gray; both must",
        ),
        (
            np.zeros((HEIGHT, WIDTH // 2, 3), np.uint8),
            "left is 320x240 in colour, right is 160x240 in",
        ),
        (b"no image", "cannot be read"),
        (b"", "cannot be read"),
        (cut(".png"), "cut short"),
        (cut(".jpg"), "cut short"),
    ],
    ids=["16 bit", "gray", "narrow", "text", "empty", "cut png", "cut jpg"],
)
def test_a_wrong_image_in_the_middle_is_named(
    tmp_path: Path, calibration: Path, wrong: Image | bytes, reason: str
) -> None:
    write_folder(tmp_path / "pairs")
    path = tmp_path / "pairs" / "right" / "0002.png"
    if isinstance(wrong, bytes):
        path.write_bytes(wrong)
    else:
        cv2.imwrite(str(path), wrong)
    refused(tmp_path / "pairs", calibration, rf"0002\.png.*{reason}|{reason}")


def test_a_pair_of_another_size_in_the_middle_is_named(tmp_path: Path, calibration: Path) -> None:
    write_folder(tmp_path / "pairs")
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / "pairs" / side / "0002.png"), np.zeros((120, 160, 3), np.uint8))
    words = r"0002\.png is 160x120, the first one was 320x240; keep images of one size"
    refused(tmp_path / "pairs", calibration, words)


def test_views_of_another_size_than_the_calibration_are_refused(
    tmp_path: Path, calibration: Path
) -> None:
    write_video(tmp_path / "left.avi", [picture(0, 0)])
    refused(tmp_path / "left.avi", calibration, "views are 160x240, but calibration .* 320x240")


def test_videos_that_do_not_match_are_refused(tmp_path: Path, calibration: Path) -> None:
    write_video(tmp_path / "a.avi", [picture(0, 0)], fps=20)
    write_video(tmp_path / "b.avi", [picture(0, 1)], fps=30)
    write_video(tmp_path / "c.avi", [both(0)], fps=20)
    refused(f"{tmp_path / 'a.avi'},{tmp_path / 'b.avi'}", calibration, "20 and 30 frames/s")
    refused(
        f"{tmp_path / 'a.avi'},{tmp_path / 'c.avi'}",
        calibration,
        "left is 320x240 .*, right is 640x240",
    )


def test_of_two_videos_the_rest_of_the_longer_one_is_left_out_and_told_once(
    tmp_path: Path, calibration: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for side, (name, count) in enumerate((("left", COUNT), ("right", COUNT - 2))):
        write_video(tmp_path / f"{name}.avi", [picture(i, side) for i in range(count)])
    source = f"{tmp_path / 'left.avi'},{tmp_path / 'right.avi'}"
    open_footage(source, calibration).close()
    assert not caplog.messages
    footage = open_footage(source, calibration)
    assert [footage.read(i) is not None for i in (0, 0, 3, 4)] == [True, True, True, False]
    (line,) = caplog.messages
    assert "left.avi has 6 and " in line
    assert "right.avi has 4 frames: only the first 4 of each are paired" in line


@pytest.mark.parametrize("kept", [0.5, 1.0])
def test_a_video_that_is_cut_off_ends_early_and_says_so(
    tmp_path: Path, calibration: Path, kept: float, caplog: pytest.LogCaptureFixture
) -> None:
    promised = 40
    write_video(tmp_path / "both.avi", [both(i % COUNT) for i in range(promised)])
    whole = (tmp_path / "both.avi").read_bytes()
    (tmp_path / "both.avi").write_bytes(whole[: round(kept * len(whole))])
    config = ServiceConfig(lockstep=True)
    service = Service("source", config, Bus(Hub().connect(), "rig", "source"))
    given = list(_Pace(service, open_footage(tmp_path / "both.avi", calibration), None, None))
    assert len(given) == promised if kept == 1 else 10 < len(given) < 30
    told = f"ended before frame {len(given)} of the {promised} that it promises"
    assert (told in caplog.text) == (kept < 1)


def test_a_loop_goes_there_and_back_in_rising_time(tmp_path: Path, calibration: Path) -> None:
    write_folder(tmp_path / "pairs")
    options = {"source": str(tmp_path / "pairs"), "calibration": calibration}
    footage, _ = open_input(InputConfig(**options, loop=3))  # type: ignore[arg-type]
    exposures = [footage.read(i) for i in (0, 1, 2, 3, 4, 5, 4001)]
    assert all(e is not None for e in exposures)
    assert [told(e.left)[0] for e in exposures if e] == [0, 1, 2, 1, 0, 1, 1]
    assert [e.capture_ns for e in exposures if e][-1] == round(4001 * 1e9 / 30)
    with pytest.raises(InputError, match="--loop 7"):
        open_input(InputConfig(**options, loop=7))  # type: ignore[arg-type]


def test_a_loop_that_memory_does_not_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    free = SimpleNamespace(available=2 * 40 * 6 * 640 * 480)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    open_input(InputConfig("stage:figure8-107", loop=40))
    with pytest.raises(InputError, match=r"--loop 41: 0\.1 GB of images .*; use 40 or fewer"):
        open_input(InputConfig("stage:figure8-107", loop=41))


def test_a_source_that_ends_before_all_the_frames_that_are_wanted_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = SourceConfig(InputConfig("stage:figure8-107", fps=0.2, frames=9))
    service = Service("source", config.service, Bus(Hub().connect(), "rig", "source"))
    service.bus.stop.set()
    with service:
        run(service, config)
    assert "stage:figure8-107 ends after 4 frames, before --frames 9" in caplog.messages


@pytest.mark.parametrize("frames", [None, COUNT - 1, 2 * COUNT])
def test_what_lies_beyond_the_end_was_not_skipped(
    tmp_path: Path, calibration: Path, frames: int | None
) -> None:
    write_folder(tmp_path / "pairs")
    service = Service("source", ServiceConfig(), Bus(Hub().connect(), "rig", "source"))
    pace = _Pace(service, open_footage(tmp_path / "pairs", calibration), frames, None)
    first = next(pace)
    pace._began -= 60.0  # as after a suspension
    given = [first, *pace]
    assert len(given) + service.meter.skipped == min(frames or COUNT, COUNT)

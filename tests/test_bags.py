"""Bags of ROS 1 and ROS 2: topics found, images decoded, pairs made, calibrations taken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from services.cli import call
from services.sources import InputConfig, open_input
from services.sources.pairing import Pairing, stereo_topics
from services.sources.ros_image import CAMERA_INFO, COMPRESSED, IMAGE, decode
from suturetrack.types import Image, InputError
from tests.test_sources import HEIGHT, WIDTH, picture, told

COUNT = 5
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000
LEFT, RIGHT = "/endoscope/left/image_raw", "/endoscope/right/image_raw"
K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
Entry = tuple[int, str, str, Any]


class Ros:
    """Messages of one ROS."""

    def __init__(self, version: int):
        self.version = version
        self.types = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_JAZZY)

    def new(self, kind: str, **fields: Any) -> Any:
        return self.types.types[kind](**fields)

    def header(self, stamp_ns: int) -> Any:
        stamp = self.new(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        more = {"seq": 0} if self.version == 1 else {}
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id="camera", **more)

    def image(self, stamp_ns: int, data: Image, encoding: str = "bgr8", padding: int = 0) -> Any:
        rows = np.pad(data.reshape(len(data), -1), ((0, 0), (0, padding)))
        return self.new(
            IMAGE,
            header=self.header(stamp_ns),
            height=data.shape[0],
            width=data.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1] * rows.itemsize,
            data=np.frombuffer(rows.tobytes(), np.uint8),
        )

    def compressed(self, stamp_ns: int, image: Image, suffix: str = ".png") -> Any:
        data = cv2.imencode(suffix, image)[1].ravel()
        return self.new(COMPRESSED, header=self.header(stamp_ns), format=suffix[1:], data=data)

    def info(self, right: bool, *, baseline: float = 0.04, **changes: Any) -> Any:
        projection = np.c_[K, [-400 * baseline if right else 0, 0, 0]]
        region = self.new(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        names = "DKRP" if self.version == 1 else "dkrp"
        numbers = (np.zeros(5), K.ravel(), np.eye(3).ravel(), projection.ravel())
        fields = {
            "header": self.header(0),
            "height": HEIGHT,
            "width": WIDTH,
            "distortion_model": "plumb_bob",
            "binning_x": 0,
            "binning_y": 0,
            "roi": region,
            **dict(zip(names, numbers, strict=True)),
        }
        return self.new(CAMERA_INFO, **(fields | changes))


def write(path: Path, ros: Ros, entries: list[Entry]) -> Path:
    """A bag of (time, topic, type, message), of the kind that the path's suffix tells."""
    if path.suffix == ".bag":
        writer: Any = Writer1(path)
        serialize: Callable[..., Any] = ros.types.serialize_ros1
    else:
        storage = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        path = path.with_suffix("")
        writer = Writer2(path, version=9, storage_plugin=storage)
        serialize = ros.types.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for time_ns, topic, kind, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros.types)
            writer.write(connections[topic], time_ns, serialize(message, kind))
    return path


def frames(
    ros: Ros, *, right_late_ns: int = 0, with_info: bool = True, **options: Any
) -> list[Entry]:
    entries: list[Entry] = []
    for i in range(COUNT):
        now = START_NS + i * PERIOD_NS
        for side, topic in enumerate((LEFT, RIGHT)):
            stamp = now + side * right_late_ns
            message = ros.image(stamp, picture(i, side), **options)
            entries.append((stamp + 1_000_000, topic, IMAGE, message))
            if with_info:
                info = topic.replace("image_raw", "camera_info")
                entries.append((stamp + 1_000_001, info, CAMERA_INFO, ros.info(bool(side))))
    return entries


@pytest.fixture
def ros2() -> Ros:
    return Ros(2)


@pytest.mark.parametrize("name", ["run.bag", "run.mcap", "run.db3"])
def test_every_kind_of_bag_gives_pairs_and_its_own_calibration(tmp_path: Path, name: str) -> None:
    ros = Ros(1 if name == "run.bag" else 2)
    path = write(tmp_path / name, ros, frames(ros, right_late_ns=2_000_000))
    footage, rig = open_input(InputConfig(str(path)))
    assert footage.size == (WIDTH, HEIGHT)
    assert footage.fps == pytest.approx(25)
    assert not footage.live
    assert rig.baseline == pytest.approx(0.04)
    assert rig.metres_per_unit == 1.0
    assert rig.is_rectified
    for i in range(COUNT):
        exposure = footage.read(i)
        assert exposure is not None
        assert (told(exposure.left), told(exposure.right)) == ((i, 0), (i, 1))
        assert exposure.capture_ns == START_NS + i * PERIOD_NS
    assert footage.read(COUNT) is None
    footage.close()


def test_a_single_mcap_file_is_a_bag_and_frames_can_be_left_out(tmp_path: Path, ros2: Ros) -> None:
    path = write(tmp_path / "run.mcap", ros2, frames(ros2))
    footage, _ = open_input(InputConfig(str(next(path.glob("*.mcap")))))
    for i in (0, 0, 2, 4):
        exposure = footage.read(i)
        assert exposure is not None
        assert told(exposure.left) == (i, 0)
    assert footage.read(9) is None
    footage.close()


def test_a_loop_of_more_frames_than_a_bag_turns_out_to_have_is_refused(
    tmp_path: Path, ros2: Ros
) -> None:
    path = write(tmp_path / "run.mcap", ros2, frames(ros2))
    footage, _ = open_input(InputConfig(str(path), loop=COUNT + 1))
    assert footage.read(COUNT - 1) is not None
    with pytest.raises(InputError, match=f"--loop {COUNT + 1}: .* no more than the {COUNT} frames"):
        footage.read(COUNT)
    footage.close()


def test_images_without_a_partner_are_left_out(tmp_path: Path, ros2: Ros) -> None:
    lost = {(LEFT, START_NS + PERIOD_NS), (RIGHT, START_NS + 2 * PERIOD_NS)}
    entries = [e for e in frames(ros2) if (e[1], e[0] - 1_000_000) not in lost]
    assert len(entries) == 4 * COUNT - 2
    path = write(tmp_path / "run.mcap", ros2, entries)
    footage, _ = open_input(InputConfig(str(path)))
    seen = [footage.read(i) for i in range(4)]
    assert [told(e.left)[0] for e in seen if e is not None] == [0, 3, 4]
    assert [told(e.right)[0] for e in seen if e is not None] == [0, 3, 4]
    assert [e.skipped for e in seen if e is not None] == [0, 2, 0]
    footage.close()
    looped, _ = open_input(InputConfig(str(path), loop=3))
    again = [looped.read(i) for i in range(8)]
    assert [e.skipped for e in again if e is not None] == [0, 2, 0, 0, 0, 0, 0, 0]
    looped.close()


def refused(path: Path, words: str, **options: Any) -> None:
    with pytest.raises(InputError, match=words) as caught:
        open_input(InputConfig(str(path), **options))
    assert "\n" not in str(caught.value)


def test_stamps_that_are_too_far_apart_are_told(tmp_path: Path, ros2: Ros) -> None:
    path = write(tmp_path / "run.mcap", ros2, frames(ros2, right_late_ns=14_000_000))
    refused(path, r"nearest left and right stamps are 14\.0 ms apart, more than --slop-ms 10")
    footage, _ = open_input(InputConfig(str(path), slop_ms=15))
    assert footage.read(1) is not None
    footage.close()
    refused(path, "use milliseconds from 0 to 1000", slop_ms=-1)


def test_a_bag_without_camera_info_needs_a_calibration(tmp_path: Path, ros2: Ros) -> None:
    path = write(tmp_path / "run.mcap", ros2, frames(ros2, with_info=False))
    refused(path, r"no camera_info on /endoscope/left/camera_info; give --calibration FILE")


def test_zero_stamps_give_way_to_the_time_of_recording(tmp_path: Path, ros2: Ros) -> None:
    entries = frames(ros2)
    for _, _, kind, message in entries:
        if kind == IMAGE:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    footage, _ = open_input(InputConfig(str(write(tmp_path / "run.mcap", ros2, entries))))
    exposure = footage.read(2)
    assert exposure is not None
    assert told(exposure.left) == (*told(exposure.right)[:1], 0)
    assert exposure.capture_ns == START_NS + 2 * PERIOD_NS + 1_000_000
    footage.close()


def test_a_broken_and_an_empty_bag_are_refused(tmp_path: Path, ros2: Ros) -> None:
    for name, content in (("a.bag", b"junk"), ("a.mcap", b"\x89MCAP0\r\njunk"), ("a.db3", b"")):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, "not a bag that can be read|no left and right")
    refused(tmp_path / "missing.mcap", "no such bag")
    path = write(tmp_path / "one.mcap", ros2, [e for e in frames(ros2) if e[1] == LEFT])
    refused(path, f"no left and right among the image topics; give --topics LEFT RIGHT of: {LEFT}")
    refused(path, "no image topic /x; there are", topics=("/x", LEFT))


def test_a_bag_that_is_damaged_inside_is_refused(tmp_path: Path, ros2: Ros) -> None:
    (path,) = write(tmp_path / "run.db3", ros2, frames(ros2)).glob("*.db3")
    content = bytearray(path.read_bytes())
    page = 4096 * (len(content) // 8192)
    content[page : page + 4096] = b"\xff" * 4096
    path.write_bytes(content)
    refused(path.parent, "run: not a bag that can be read")


def test_a_calibration_of_another_size_needs_a_scale(tmp_path: Path, ros2: Ros) -> None:
    small = [
        (
            t,
            topic,
            kind,
            ros2.info(topic.endswith("right/camera_info"), width=2 * WIDTH, height=2 * HEIGHT)
            if kind == CAMERA_INFO
            else message,
        )
        for t, topic, kind, message in frames(ros2)
    ]
    path = write(tmp_path / "run.mcap", ros2, small)
    refused(path, r"views are 320x240, but camera_info is for 640x480; .*--scale 0\.5")
    footage, rig = open_input(InputConfig(str(path), scale=0.5))
    assert rig.image_size == footage.size
    assert rig.focal == pytest.approx(200)
    footage.close()


def test_rectified_topics_are_taken_for_what_they_are(tmp_path: Path, ros2: Ros) -> None:
    entries = [
        (
            t,
            topic.replace("image_raw", "image_rect_color"),
            kind,
            ros2.info("right" in topic, d=np.array([0.3, 0, 0, 0, 0]))
            if kind == CAMERA_INFO
            else message,
        )
        for t, topic, kind, message in frames(ros2)
    ]
    path = write(tmp_path / "run.mcap", ros2, entries)
    footage, rig = open_input(InputConfig(str(path)))
    assert rig.is_rectified
    footage.close()


def test_cropped_or_binned_images_need_their_own_calibration(tmp_path: Path, ros2: Ros) -> None:
    entries = [
        (
            t,
            topic,
            kind,
            ros2.info("right" in topic, binning_x=2) if kind == CAMERA_INFO else message,
        )
        for t, topic, kind, message in frames(ros2)
    ]
    refused(write(tmp_path / "run.mcap", ros2, entries), "binned or cropped")


COLOUR = np.random.default_rng(2).integers(0, 256, (8, 10, 3)).astype(np.uint8)
GRAY = COLOUR[..., 0].copy()


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", GRAY, GRAY),
        ("bgr8", COLOUR, COLOUR),
        ("8UC3", COLOUR, COLOUR),
        ("rgb8", COLOUR[..., ::-1], COLOUR),
        ("rgba8", np.dstack([COLOUR[..., ::-1], GRAY]), COLOUR),
        ("bgra8", np.dstack([COLOUR, GRAY]), COLOUR),
    ],
)
def test_encodings_become_gray_or_bgr(
    ros2: Ros, encoding: str, data: Image, expected: Image, padding: int
) -> None:
    message = ros2.image(5, np.ascontiguousarray(data), encoding, padding)
    np.testing.assert_array_equal(decode(message, "/x"), expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_told_apart(ros2: Ros, pattern: str) -> None:
    plain = np.empty((16, 16, 3), np.uint8)
    plain[:] = (40, 120, 220)
    mosaic = np.empty((16, 16), np.uint8)
    for i, colour in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = plain[0, 0, "bgr".index(colour)]
    image = decode(ros2.image(5, mosaic, f"bayer_{pattern}8"), "/x")
    np.testing.assert_allclose(image[2:-2, 2:-2], plain[2:-2, 2:-2], atol=1)


@pytest.mark.parametrize(("encoding", "first"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_packed_yuv_is_read(ros2: Ros, encoding: str, first: int) -> None:
    data = np.full((4, 6, 2), 128, np.uint8)
    data[..., first] = 200
    image = decode(ros2.image(5, data, encoding), "/x")
    assert image.shape == (4, 6, 3)
    assert np.ptp(image) == 0
    assert image[0, 0, 0] > 190


def test_compressed_images_are_read(tmp_path: Path, ros2: Ros) -> None:
    entries = [
        (t, f"{topic}/compressed", COMPRESSED, ros2.compressed(t, picture(i // 2, i % 2)))
        for i, (t, topic, _, _) in enumerate(frames(ros2, with_info=False))
    ]
    infos = [e for e in frames(ros2) if e[2] == CAMERA_INFO]
    footage, _ = open_input(InputConfig(str(write(tmp_path / "run.mcap", ros2, infos + entries))))
    exposure = footage.read(3)
    assert exposure is not None
    assert (told(exposure.left), told(exposure.right)) == ((3, 0), (3, 1))
    footage.close()


def test_images_that_cannot_be_used_are_refused(ros2: Ros) -> None:
    deep = np.zeros((8, 10), np.uint16)
    with pytest.raises(
        InputError, match="topic /x: images are 'mono16'; convert them to one of mono8"
    ):
        decode(ros2.image(5, deep, "mono16"), "/x")
    with pytest.raises(InputError, match="images are uint16; convert them to 8 bit"):
        decode(ros2.compressed(5, deep), "/x")
    short = ros2.image(5, GRAY, "bgr8")
    with pytest.raises(InputError, match="are no 10x8 bgr8 image"):
        decode(short, "/x")
    broken = ros2.compressed(5, GRAY)
    broken.data = broken.data[:10]
    empty = ros2.compressed(5, GRAY)
    empty.data = empty.data[:0]
    with pytest.raises(InputError, match="cannot be decoded; use jpeg or png"):
        decode(empty, "/x")
    with pytest.raises(InputError, match="cannot be decoded; use jpeg or png"):
        decode(broken, "/x")


@pytest.mark.parametrize(
    ("topics", "found"),
    [
        ([LEFT, RIGHT], (LEFT, RIGHT)),
        ([LEFT, RIGHT, f"{LEFT}/compressed", f"{RIGHT}/compressed"], (LEFT, RIGHT)),
        (
            [
                "/l/left/image_rect",
                "/l/right/image_rect",
                "/l/left/image_raw",
                "/l/right/image_raw",
            ],
            ("/l/left/image_raw", "/l/right/image_raw"),
        ),
        (
            ["/cam0/image_raw", "/cam1/image_raw", "/room/image_raw"],
            ("/cam0/image_raw", "/cam1/image_raw"),
        ),
    ],
)
def test_left_and_right_are_found_by_their_names(topics: list[str], found: tuple[str, str]) -> None:
    assert stereo_topics(topics, None) == found


def test_two_rigs_in_a_bag_need_a_choice() -> None:
    topics = [f"/{rig}/{side}/image_raw" for rig in "ab" for side in ("left", "right")]
    with pytest.raises(InputError, match="several pairs of image topics; give --topics LEFT RIGHT"):
        stereo_topics(topics, None)
    assert stereo_topics(topics, (topics[2], topics[3])) == (topics[2], topics[3])


def test_each_image_gets_the_partner_nearest_in_time() -> None:
    pairing: Pairing[int] = Pairing(slop_ns=10)
    pairs = []
    for right, stamp in [
        (False, 100),
        (False, 200),
        (True, 205),
        (False, 300),
        (True, 309),
        (True, 450),
    ]:
        pairs.append(pairing.add(right, stamp, stamp))
    found = [(p.stamp_ns, p.left, p.right, p.skipped) for p in pairs if p]
    assert found == [(200, 200, 205, 1), (300, 300, 309, 0)]
    assert pairing.closest_ns == 5


def test_bad_input_ends_with_one_line_and_an_exit_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mcap").write_bytes(b"junk")
    for arguments in (
        ["run", "--source", f"{tmp_path / 'a.mcap'}"],
        ["run", "--source", f"{tmp_path / 'missing.bag'}"],
        ["run", "--source", "ros2:/left/image_raw"],
        ["calibration", "check", f"{tmp_path / 'a.mcap'}"],
    ):
        assert call(arguments) == 1
        said = capsys.readouterr().err
        assert said.startswith(f"suturetrack {arguments[0]}: ")
        assert said.count("\n") == 1

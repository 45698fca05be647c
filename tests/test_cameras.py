"""Live cameras that stall and come back, and interlaced video."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from services import source, topics
from services.bus import Bus
from services.memory_transport import Hub
from services.service import Service
from services.source import SourceConfig
from services.sources import InputConfig, camera, live, open_input
from services.sources.footage import Footage, Stalled
from services.sources.interlace import CombWatch, combing
from suturetrack.types import Image, InputError
from tests.conftest import wait_until
from tests.test_sources import HEIGHT, WIDTH, both, calibration, picture, told

__all__ = ["calibration"]


class Devices:
    """What stands for the cameras of a machine."""

    def __init__(self) -> None:
        self.images: dict[str | int, Image] = {}
        self.stalled = threading.Event()
        self.gone = threading.Event()
        self.opened = 0
        self.open_now = 0
        self.asked: dict[str | int, dict[int, float]] = {}

    def capture(self, name: str | int) -> FakeCapture:
        return FakeCapture(self, name)


class FakeCapture:
    """A `cv2.VideoCapture` of a device that gives one picture at 100 Hz."""

    def __init__(self, devices: Devices, name: str | int):
        self._devices, self._name = devices, name
        self._works = name in devices.images and not devices.gone.is_set()
        if self._works:
            devices.opened += 1
            devices.open_now += 1

    def isOpened(self) -> bool:
        return self._works

    def get(self, what: int) -> float:
        return 100.0 if what == cv2.CAP_PROP_FPS else 0.0

    def set(self, what: int, value: float) -> None:
        self._devices.asked.setdefault(self._name, {})[what] = value

    def grab(self) -> bool:
        time.sleep(0.01)
        return self._works and not self._devices.stalled.is_set()

    def retrieve(self) -> tuple[bool, Image]:
        return True, self._devices.images[self._name]

    def release(self) -> None:
        self._devices.open_now -= self._works
        self._works = False


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> Devices:
    found = Devices()
    monkeypatch.setattr(camera.cv2, "VideoCapture", found.capture)
    monkeypatch.setattr(camera, "STALL_S", 0.1)
    monkeypatch.setattr(camera, "_RETRY_S", 0.02)
    monkeypatch.setattr(camera, "_FIRST_S", 0.5)
    return found


def stall_of(footage: Footage) -> str:
    """What is said once the frames that were on their way have been read."""
    for i in range(1, 100):
        try:
            footage.read(i)
        except Stalled as stall:
            return str(stall)
    return "frames came on"


@pytest.mark.parametrize("name", ["0", "0,/dev/video2"])
def test_one_side_by_side_camera_and_two_cameras(
    devices: Devices, calibration: Path, name: str
) -> None:
    pair = "," in name
    devices.images = {0: picture(2, 0) if pair else both(2), "/dev/video2": picture(2, 1)}
    footage, _ = open_input(InputConfig(name, calibration))
    assert footage.live
    assert footage.size == (WIDTH, HEIGHT)
    for i in range(3):
        exposure = footage.read(i)
        assert exposure is not None
        assert (told(exposure.left), told(exposure.right)) == ((2, 0), (2, 1))
        assert abs(time.time_ns() - exposure.capture_ns) < 10e9
    footage.close()
    assert devices.open_now == 0
    asked = devices.asked[0]
    assert asked[cv2.CAP_PROP_FRAME_WIDTH] == (WIDTH if pair else 2 * WIDTH)
    assert asked[cv2.CAP_PROP_FRAME_HEIGHT] == HEIGHT
    assert asked[cv2.CAP_PROP_FPS] == 30


def test_a_camera_that_stalls_is_told_and_comes_back(devices: Devices, calibration: Path) -> None:
    devices.images = {0: both(1)}
    footage, _ = open_input(InputConfig("0", calibration))
    devices.stalled.set()
    assert stall_of(footage).startswith("camera 0: no image for ")
    devices.gone.set()
    with pytest.raises(Stalled):
        footage.read(1)
    before = devices.opened
    devices.gone.clear()
    devices.stalled.clear()
    devices.images = {0: both(3)}
    wait_until(lambda: devices.opened > before)
    exposure = footage.read(1)
    assert exposure is not None
    assert told(exposure.left) == (3, 0)
    footage.close()
    assert devices.open_now == 0


def test_a_camera_that_gives_nothing_or_the_wrong_thing_is_refused(
    devices: Devices, calibration: Path
) -> None:
    devices.images = {0: both(1)}
    with pytest.raises(InputError, match="camera 5: cannot be opened; is it there"):
        open_input(InputConfig("0,5", calibration))
    assert devices.open_now == 0
    with pytest.raises(InputError, match="--calibration FILE is needed"):
        open_input(InputConfig("0"))
    devices.images[1] = picture(0, 0)[:200]
    with pytest.raises(InputError, match=r"left is 640x240 in colour, right is 320x200"):
        open_input(InputConfig("0,1", calibration))
    devices.stalled.set()
    with pytest.raises(InputError, match=r"camera 0: no image for \d s; is it connected, and free"):
        open_input(InputConfig("0", calibration))
    assert devices.open_now == 0


def test_the_source_says_that_its_camera_stalls_and_goes_on(
    devices: Devices, calibration: Path
) -> None:
    devices.images = {0: both(1)}
    hub = Hub()
    config = SourceConfig(InputConfig("0", calibration))
    service = Service("source", config.service, Bus(hub.connect(), "rig", "source"))
    viewer = Bus(hub.connect(), "rig", "viewer")
    frames = viewer.every(topics.FRAME)

    def body() -> None:
        with service:
            source.run(service, config)

    thread = threading.Thread(target=body, daemon=True)
    thread.start()
    assert frames.get(20) is not None
    devices.stalled.set()
    wait_until(lambda: service.health().awaits == "camera")
    assert service.health().warning.startswith("camera 0: no image for ")
    while frames.get(0) is not None:
        pass
    devices.stalled.clear()
    assert frames.get(20) is not None
    wait_until(lambda: not service.health().warning and not service.health().awaits)
    devices.stalled.set()
    wait_until(lambda: service.health().warning)
    service.bus.stop.set()
    thread.join(20)
    assert not thread.is_alive()


def test_the_source_says_what_is_wrong_with_the_exposure_for_as_long_as_it_is(
    devices: Devices, calibration: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = both(1)
    devices.images = {0: good}
    config = SourceConfig(InputConfig("0", calibration))
    service = Service("source", config.service, Bus(Hub().connect(), "rig", "source"))

    def body() -> None:
        with service:
            source.run(service, config)

    def warning() -> str:
        return service.health().warning

    thread = threading.Thread(target=body, daemon=True)
    thread.start()
    wait_until(lambda: service.meter.last is not None, 20)
    assert not warning()
    right = np.arange(2 * WIDTH) >= WIDTH
    noise = np.random.default_rng(0).integers(0, 4, good.shape).astype(np.uint8)
    for image, fault in (
        (noise, "the left image is black: .*; the right image is black"),
        (
            np.where(right[:, None], np.uint8(90), good),
            "^the right image is empty: every pixel is 90$",
        ),
        (
            np.maximum(good, np.uint8(250)) | 4 | noise | 250,
            "the left image is saturated: .* lower",
        ),
    ):
        devices.images = {0: image}
        wait_until(lambda fault=fault: re.search(fault, warning()))  # type: ignore[misc]
    devices.images = {0: good}
    wait_until(lambda: not warning())
    service.bus.stop.set()
    thread.join(20)
    assert caplog.text.count("the left image is black") == 1


def test_only_the_newest_exposure_waits() -> None:
    newest = live.Newest()
    for i in range(3):
        newest.put(source.Exposure(i, picture(0, 0), picture(0, 1)))
    assert newest.get(0, "x").capture_ns == 2
    with pytest.raises(Stalled, match="x for 0 s"):
        newest.get(0, "x")


def moving_bar(offset: int) -> Image:
    image = np.full((240, 320), 60, np.uint8)
    image[:, 100 + offset : 112 + offset] = 200
    return cv2.GaussianBlur(image, (3, 3), 0)


def interlaced(shift: int) -> Image:
    image = moving_bar(0)
    image[1::2] = moving_bar(shift)[1::2]
    return image


def test_what_moves_in_interlaced_video_is_combed() -> None:
    noise = np.random.default_rng(3).normal(0, 4, (240, 320))
    for shift in (4, 10):
        combed = np.clip(interlaced(shift) + noise, 0, 255).astype(np.uint8)
        assert combing(combed) > 0.01
        assert combing(np.dstack([combed] * 3)) > 0.01
    for image in (
        moving_bar(0),
        moving_bar(0).T,
        np.clip(moving_bar(0) + noise, 0, 255).astype(np.uint8),
    ):
        assert abs(combing(image)) < 0.001


def test_thin_threads_and_textures_are_not_taken_for_combs() -> None:
    image = np.full((240, 320), 60, np.uint8)
    for i in range(12):
        cv2.line(image, (0, 10 * i), (319, 10 * i + 30), 220, 1)
    noise = np.random.default_rng(3).integers(0, 256, (240, 320)).astype(np.uint8)
    for still in (image, noise):
        assert combing(still) < 0.002


def test_combs_are_told_once() -> None:
    watch = CombWatch()
    told_at = [i for i in range(60) if watch.sees(interlaced(8) if i >= 25 else moving_bar(0))]
    assert len(told_at) == 1
    assert 25 <= told_at[0] < 36

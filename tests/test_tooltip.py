"""The tip of a tool shows the thread beside it, and seeds it when the trigger is pulled."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from services import tooltip, topics
from services.bus import Bus
from services.client import Client
from services.memory_transport import Hub
from services.messages import SeedReply, ToolPose, ToolSnap
from services.service import Service, ServiceConfig
from services.tooltip import HandEye, TooltipConfig, load_hand_eye
from suturetrack.camera import StereoRig
from suturetrack.types import InputError, Seed, Stamp
from tests.painting import paint, thread

PERIOD_NS = 33_333_333
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
BASE = np.block([[TURN, np.array([[0.1], [0.2], [0.3]])], [np.zeros((1, 3)), np.ones((1, 1))]])
TIP = (0.0, 0.0, 0.05)


def write(path: Path, **content: object) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture
def hand_eye(tmp_path: Path) -> Path:
    return write(tmp_path / "hand_eye.yaml", camera_from_base=BASE.tolist(), tip=list(TIP))


class Stage:
    """Tooltip as it runs, a robot, and a system that shows one thread."""

    def __init__(self, rig: StereoRig, hand_eye: Path):
        self.rig, hub = rig, Hub()
        self.line = thread(0.3)
        self.ridges = paint(rig, [self.line], 0)
        self.system = Bus(hub.connect(), "rig", "tracker")
        self.system.answer(topics.CALIBRATION, lambda _: rig)
        self.system.answer(topics.SEED, self.find)
        self.snaps = self.system.every(topics.SNAP)
        self.robot = Client(Bus(hub.connect(), "rig", "client"))
        self.seeds: list[Seed] = []
        self.silent = threading.Event()
        config = TooltipConfig(hand_eye)
        self.service = Service("tooltip", ServiceConfig(), Bus(hub.connect(), "rig", "tooltip"))
        body = lambda: tooltip.run(self.service, config)  # noqa: E731
        self.threads = [
            threading.Thread(target=body, daemon=True),
            threading.Thread(target=self.play, daemon=True),
        ]
        for each in self.threads:
            each.start()

    def find(self, seed: Seed) -> SeedReply:
        self.seeds.append(seed)
        return SeedReply(seed.thread, True, "found 100.0 mm")

    def play(self) -> None:
        number = 0
        while not self.system.stop.wait(PERIOD_NS / 1e9):
            number += 1
            if not self.silent.is_set():
                stamp = Stamp(number, number * PERIOD_NS, time.time_ns(), PERIOD_NS)
                self.system.publish(topics.FIELD, replace(self.ridges, stamp=stamp))

    def point(self, tip: np.ndarray, *, trigger: bool, tool: str = "tool") -> None:
        """Moves the tool so that its tip is at a point of the rectified left frame, mm."""
        in_base = TURN.T @ (tip / 1000 - BASE[:3, 3])
        self.robot.move_tool(in_base - TURN @ TIP, TURN, trigger=trigger, tool=tool)

    def snap(self, tip: np.ndarray, fits: Callable[[ToolSnap], object]) -> ToolSnap:
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            self.point(tip, trigger=False)
            snap = self.snaps.get(0.05)
            if snap is not None and fits(snap):
                return snap
        raise AssertionError("no such snap came")

    def close(self) -> None:
        for bus in (self.service.bus, self.system, self.robot.bus):
            bus.close()
        for each in self.threads:
            each.join(10)


@pytest.fixture
def stage(rig: StereoRig, hand_eye: Path) -> Iterator[Stage]:
    stage = Stage(rig, hand_eye)
    yield stage
    stage.close()


def test_the_thread_at_the_tip_is_shown_and_seeded_once_for_each_pull(stage: Stage) -> None:
    tip = stage.line[300] + [0.0, 0.0, 4.0]
    shown = stage.snap(tip, lambda s: s.point is not None)
    np.testing.assert_allclose(shown.tip, tip / 1000, atol=1e-9)
    assert shown.point is not None
    assert np.linalg.norm(stage.line / 1000 - shown.point, axis=1).min() < 0.002
    assert "mm away" in shown.reason
    assert not stage.seeds
    for _ in range(5):
        stage.point(tip, trigger=True)
        time.sleep(0.01)
    seeded = stage.snap(tip, lambda s: s.reason.startswith("seeded"))
    assert seeded.reason == "seeded: found 100.0 mm"
    assert [seed.point for seed in stage.seeds] == [seeded.point]
    stage.point(tip, trigger=True)
    stage.snap(tip, lambda s: s.reason.startswith("seeded"))
    assert len(stage.seeds) == 2


def test_a_trigger_far_from_any_thread_seeds_nothing_and_says_so(stage: Stage) -> None:
    far = stage.line[300] + [0.0, 0.0, 40.0]
    stage.snap(far, lambda s: "no thread within 8 mm" in s.reason)
    stage.point(far, trigger=True)
    stage.snap(far, lambda s: "no thread within 8 mm" in s.reason)
    stage.silent.set()
    stage.snap(stage.line[300], lambda s: s.point is None and "no live field" in s.reason)
    assert not stage.seeds


def test_another_tool_is_left_alone(stage: Stage) -> None:
    stage.snap(stage.line[300], lambda s: s.point is not None)
    stage.point(stage.line[300], trigger=True, tool="other")
    stage.snap(stage.line[300], lambda s: s.point is not None)
    assert not stage.seeds


def test_the_tip_is_turned_into_the_rectified_view(distorted_rig: StereoRig) -> None:
    hand_eye = HandEye(BASE, np.array(TIP))
    pose = ToolPose("tool", 0, np.array([0.01, 0.02, 0.03]), TURN)
    in_camera = TURN @ (pose.position + TURN @ TIP) + [0.1, 0.2, 0.3]
    found = hand_eye.tip_in_left(pose, distorted_rig)
    np.testing.assert_allclose(distorted_rig.left.rectification.T @ found, in_camera)
    assert np.linalg.norm(found - in_camera) > 1e-3


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({}, "camera_from_base is missing"),
        ({"camera_from_base": [[1, 0], [0, 1]]}, "camera_from_base must be 4x4 numbers"),
        ({"camera_from_base": BASE[:3].tolist()}, "camera_from_base must be 4x4 numbers"),
        ({"camera_from_base": "x"}, "camera_from_base must be 4x4 numbers"),
        ({"camera_from_base": None}, "camera_from_base must be 4x4 numbers"),
        ({"camera_from_base": 5}, "camera_from_base must be 4x4 numbers"),
        ({"camera_from_base": BASE.T.tolist()}, "last row of camera_from_base must be 0 0 0 1"),
        ({"camera_from_base": np.diag([2.0, 1, 1, 1]).tolist()}, "no rotation"),
        ({"camera_from_base": np.diag([-1.0, 1, 1, 1]).tolist()}, "no rotation"),
        ({"camera_from_base": np.eye(4).tolist(), "tipp": [0, 0, 0.1]}, "tipp is unknown"),
        ({"camera_from_base": np.eye(4).tolist(), "tip": [1, 2]}, "tip must be 3 numbers"),
        ({"camera_from_base": np.eye(4).tolist(), "tip": [0, 0, math.nan]}, "finite"),
        ({"camera_from_base": np.eye(4).tolist(), "tip": [0, 0, 120]}, "millimetres"),
    ],
)
def test_a_bad_hand_eye_file_gets_one_clear_line(
    tmp_path: Path, content: dict[str, object], reason: str
) -> None:
    with pytest.raises(InputError, match=reason) as refusal:
        load_hand_eye(write(tmp_path / "hand_eye.yaml", **content))
    assert "\n" not in str(refusal.value)


def test_a_hand_eye_file_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("tip: [0, 0, 0]\ncamera_from_base: {:")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe")
    for reason in ("missing.yaml: No such file", "bad.yaml: no YAML in line 2", "binary.yaml: no"):
        with pytest.raises(InputError, match=reason):
            load_hand_eye(tmp_path / reason.partition(":")[0])

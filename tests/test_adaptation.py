"""What the tracker holds teaches the segmenter: when, from which states, and the same every time."""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from services import segmenter, topics
from services.adaptation import Adaptation
from services.bus import Bus
from services.memory_transport import Hub
from services.segmenter import SegmenterConfig
from services.service import ServiceConfig
from services.sources import InputConfig
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.segmentation import Segmenter
from suturetrack.stage import Scene, open_scene
from suturetrack.stage.appearance import Picture
from suturetrack.types import (
    Energies,
    Float64,
    Nurbs,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
)
from tests.test_tiny import Rig, bits, play


@pytest.fixture(scope="module")
def scenes() -> tuple[Scene, Scene]:
    """The same thread on paper and on tissue."""
    backgrounds = ("marbled", "tissue")
    a, b = (open_scene("figure8-107", 22, picture=Picture("violet", b)) for b in backgrounds)
    return a, b


def state_of(curve: Nurbs, stamp: Stamp, status: Status = Status.TRACKING) -> ThreadState:
    nothing: Float64 = np.zeros(64)
    return ThreadState(stamp, "0", status, curve, 100.0, Energies(), nothing, np.ones(64, bool))


class Desk:
    """A segmenter that learned a thread on paper and then sees it on tissue, with its adaptation."""

    def __init__(self, scenes: tuple[Scene, Scene]) -> None:
        hub, paper = Hub(), scenes[0]
        self.bus, reader = (
            Bus(hub.connect(), "rig", "tracker"),
            Bus(hub.connect(), "rig", "segmenter"),
        )
        self.rig = paper.rig
        self.segmenter = Segmenter(self.rig)
        self.images = scenes[1].render(0)
        seed = Seed(pixel=paper.seed_pixel())
        self.segmenter.learn(StereoFrame(Stamp(0, 0, 0), *paper.render(0)), seed)
        states = reader.every(topics.STATE)
        self.adaptation = Adaptation(self.segmenter, self.rig, states.get, lockstep=True)
        truth = paper.truth(0)[0]
        knots = nurbs.clamped_knots(np.linspace(0, 1, 40)[1:-1], 3)
        s = np.linspace(0, 1, len(truth.points))
        self.curve = nurbs.fit(truth.points, s, knots, 3)
        self.fields: list[bytes] = []
        """Of every frame; the pictures are all the same."""

    def frame(self, index: int, *states: ThreadState) -> None:
        stamp = Stamp(index, index * 250_000_000, 0)
        frame = StereoFrame(stamp, *self.images)
        self.fields.append(self.segmenter.step(frame).left.tobytes())
        for state in states:
            message = scaled(replace(state, stamp=stamp), self.rig.metres_per_unit)
            self.bus.publish(topics.STATE, message)
        self.adaptation.step(frame)


def test_the_states_of_a_frame_teach_a_second_later(scenes: tuple[Scene, Scene]) -> None:
    desk = Desk(scenes)
    for index in range(11):
        desk.frame(index, state_of(desk.curve, Stamp(index, 0, 0)))
    changed = [a != b for a, b in itertools.pairwise(desk.fields)]
    assert changed == [index in (4, 8) for index in range(10)]


def test_a_curve_that_is_not_sure_teaches_nothing(scenes: tuple[Scene, Scene]) -> None:
    desk = Desk(scenes)
    for index in range(7):
        desk.frame(index, state_of(desk.curve, Stamp(index, 0, 0), Status.OCCLUDED))
    assert len(set(desk.fields)) == 1


def test_a_thread_that_the_seed_did_not_show_is_learned_once_it_is_seen(
    scenes: tuple[Scene, Scene],
) -> None:
    """A camera's first picture may be black; and what is doubtful teaches more than nothing."""
    desk = Desk(scenes)
    desk.segmenter.forget("0")
    black = np.zeros_like(desk.images[0])
    desk.segmenter.learn(
        StereoFrame(Stamp(0, 0, 0), black, black), Seed(pixel=scenes[0].seed_pixel())
    )
    assert not desk.segmenter.threads
    for index in range(4):
        unseen = replace(state_of(desk.curve, Stamp(index, 0, 0)), seen=np.zeros(64, bool))
        desk.frame(index, unseen)
    assert len(set(desk.fields)) == 1
    for index in range(4, 6):
        desk.frame(index, state_of(desk.curve, Stamp(index, 0, 0), Status.OCCLUDED))
    desk.frame(6)
    assert desk.segmenter.threads == ("0",)
    assert len(set(desk.fields)) == 2


def test_what_is_said_to_be_seen_outside_the_picture_teaches_nothing(
    scenes: tuple[Scene, Scene],
) -> None:
    desk = Desk(scenes)
    desk.segmenter.forget("0")
    black = np.zeros_like(desk.images[0])
    seed = Seed(pixel=scenes[0].seed_pixel())
    desk.segmenter.learn(StereoFrame(Stamp(0, 0, 0), black, black), seed)
    away = replace(
        desk.curve, control_points=desk.curve.control_points + np.array([1000.0, 0.0, 0.0])
    )
    for index in range(4):
        desk.frame(index, state_of(away, Stamp(index, 0, 0)))
    assert not desk.segmenter.threads


def test_a_lost_thread_beside_one_that_is_held_changes_nothing(
    scenes: tuple[Scene, Scene],
) -> None:
    desk = Desk(scenes)
    for index in range(7):
        lost = state_of(desk.curve, Stamp(index, 0, 0), Status.LOST)
        desk.frame(index, lost, replace(lost, thread="1", status=Status.OCCLUDED))
    assert len(set(desk.fields)) == 1


def test_a_thread_that_is_lost_is_looked_for_as_if_it_stood_out_less(
    scenes: tuple[Scene, Scene],
) -> None:
    desk = Desk(scenes)
    for index in range(15):
        desk.frame(index, state_of(desk.curve, Stamp(index, 0, 0), Status.LOST))
    changed = [a != b for a, b in itertools.pairwise(desk.fields)]
    # Down to a quarter in two steps.
    assert changed == [index in (4, 8) for index in range(14)]
    lengths = [
        np.linalg.norm(np.frombuffer(field, np.float32).reshape(-1, 2), axis=1).sum()
        for field in desk.fields[::5]
    ]
    assert lengths[0] < lengths[1] < lengths[2]


def test_states_of_other_frames_and_threads_teach_nothing(scenes: tuple[Scene, Scene]) -> None:
    desk = Desk(scenes)
    for index in range(7):
        stranger = replace(state_of(desk.curve, Stamp(index, 0, 0)), thread="1")
        desk.frame(index, *([stranger] if index % 4 == 0 else []))
    assert len(set(desk.fields)) == 1


def test_lock_step_waits_for_states_on_their_way(scenes: tuple[Scene, Scene]) -> None:
    desks = Desk(scenes), Desk(scenes)
    for desk, is_late in zip(desks, (False, True), strict=True):
        first = state_of(desk.curve, Stamp(0, 0, 0))
        desk.frame(0, *([] if is_late else [first]))
        late = scaled(first, desk.rig.metres_per_unit)
        timer = threading.Timer(0.3, desk.bus.publish, (topics.STATE, late))
        if is_late:
            timer.start()
        desk.frame(4)
        desk.frame(5)
    assert desks[0].fields == desks[1].fields
    assert desks[0].fields[1] != desks[0].fields[2]


def test_lock_step_adapts_the_same_twice_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    adapted = []
    adapt = Segmenter.adapt

    def counted(segmenter: Segmenter, frame: StereoFrame, pixels: Float64, thread: str) -> None:
        adapted.append(frame.stamp.frame)
        adapt(segmenter, frame, pixels, thread)

    monkeypatch.setattr(Segmenter, "adapt", counted)
    stage = InputConfig("stage:figure8-107", fps=8.0, frames=20)
    seed = (open_scene("figure8-107").seed_pixel(0),)
    runs = [play(seed, stage=stage) for _ in range(2)]
    states = [[bits(state) for state in outcome.states] for outcome, _ in runs]
    assert adapted == 2 * [0, 8]
    assert states[0] == states[1]


@pytest.mark.parametrize("late", [0, 9])
@pytest.mark.parametrize(
    ("status", "seen", "learns"),
    [
        (Status.TRACKING, True, True),
        (Status.OCCLUDED, True, True),
        (Status.OCCLUDED, False, False),
        (Status.LOST, True, False),
    ],
)
def test_a_segmenter_that_is_started_again_learns_from_what_is_seen_of_a_thread(
    scenes: tuple[Scene, Scene], status: Status, seen: bool, late: int, learns: bool
) -> None:
    """Of a thread of which nobody is sure, too: without its colour nobody may ever be; and so many frames
    later, as where the tracker is slow."""
    desk, rig, config = Desk(scenes), Rig(), ServiceConfig(resume=1)
    camera, tracker = rig.connect("source"), rig.connect("tracker")
    camera.answer(topics.CALIBRATION, lambda _: desk.rig)
    fields = camera.every(topics.FIELD)
    state = replace(state_of(desk.curve, Stamp(0, 0, 0), status), seen=np.full(64, seen))
    message = scaled(state, desk.rig.metres_per_unit)
    camera.keep(topics.STATE)
    tracker.publish(topics.STATE, message)
    tracker.declare_alive()
    rig.start("segmenter", segmenter, SegmenterConfig(config))
    assert camera.wait_for_alive("segmenter", 60)
    shown = []
    for index in range(late + 2):
        camera.publish(topics.FRAME, StereoFrame(Stamp(index, 0, 0), *desk.images))
        field = fields.get(20)
        assert field is not None
        shown.append(field.left.tobytes())
        # Those of the other frames the tracker was too slow for.
        if index == late:
            tracker.publish(topics.STATE, replace(message, stamp=Stamp(late // 2, 0, 0)))
    rig.stop()
    assert not rig.errors
    assert len(set(shown[:-1])) == 1
    assert (shown[-2] != shown[-1]) is learns


@pytest.mark.parametrize("is_late", [True, False])
def test_in_lock_step_a_frame_waits_for_the_states_of_the_last_one(
    scenes: tuple[Scene, Scene], is_late: bool
) -> None:
    """How a thread moved until then tells where its smear is looked for."""
    desk, told = Desk(scenes), []
    desk.segmenter.follow = lambda capture_ns, *_: told.append(capture_ns)  # type: ignore[method-assign]
    for index in range(2):
        desk.frame(index, state_of(desk.curve, Stamp(index, 0, 0)))
        desk.adaptation.catch_up()
    desk.frame(2)
    last = replace(state_of(desk.curve, Stamp(2, 500_000_000, 0)))
    message = scaled(last, desk.rig.metres_per_unit)
    sender = threading.Timer(0.2 if is_late else 0.0, desk.bus.publish, (topics.STATE, message))
    sender.start()
    desk.adaptation.catch_up()
    sender.join()
    assert told == [0, 250_000_000, 500_000_000]


def test_what_is_reported_no_more_is_waited_for_once(
    scenes: tuple[Scene, Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.adaptation._LONGEST_WAIT_S", 0.3)
    desk = Desk(scenes)
    desk.frame(0, state_of(desk.curve, Stamp(0, 0, 0)))
    waits = []
    for index in range(1, 5):
        began = time.monotonic()
        desk.adaptation.catch_up()
        waits.append(time.monotonic() - began > 0.25)
        desk.frame(index)
    assert waits == [False, True, False, False]

"""A synthetic thread through all stages, on the in-memory bus."""

from __future__ import annotations

import re
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from services import segmenter, source, topics, tracker
from services.bus import Bus, NoAnswer, Request
from services.memory_transport import Hub
from services.messages import Forget, Health, SeedReply
from services.seeding import SeedDesk
from services.segmenter import SegmenterConfig
from services.service import Service, ServiceConfig
from services.source import SourceConfig
from services.sources import InputConfig
from services.tracker import TrackerConfig
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import initialize
from suturetrack.metrics import curve_error
from suturetrack.segmentation import SegmentationConfig, Segmenter
from suturetrack.stage import open_scene
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.types import RidgeField, Seed, Stamp, Status, StereoFrame, ThreadState, Truth
from tests.conftest import wait_until

FRAMES = 8
STAGE = InputConfig("stage:figure8-107", frames=FRAMES)
LOCKSTEP = ServiceConfig(lockstep=True)


@dataclass
class Outcome:
    states: list[ThreadState]
    truths: list[Truth]
    healths: list[Health]


class Rig:
    """Processes as threads around one hub."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.threads: dict[str, threading.Thread] = {}
        self.buses: dict[str, Bus] = {}
        self.errors: dict[str, BaseException] = {}

    def connect(self, name: str) -> Bus:
        self.buses[name] = Bus(self.hub.connect(), "rig", name)
        return self.buses[name]

    def start(self, name: str, module: Any, config: Any) -> None:
        service = Service(name, config.service, self.connect(name))

        def body() -> None:
            try:
                with service:
                    module.run(service, config)
            except BaseException as error:
                self.errors[name] = error

        self.threads[name] = threading.Thread(target=body, name=name, daemon=True)
        self.threads[name].start()

    def wait(self) -> None:
        """Until the source is done, or any process fails."""
        source = self.threads["source"]
        wait_until(lambda: self.errors or not source.is_alive(), 60)

    def stop(self) -> None:
        for name, thread in self.threads.items():
            self.buses[name].stop.set()
            thread.join(10)
            assert not thread.is_alive()


def drain(inbox: Any) -> list[Any]:
    return list(iter(lambda: inbox.get(0), None))


def play(
    seed: tuple[tuple[float, float], ...],
    service: ServiceConfig = LOCKSTEP,
    stage: InputConfig = STAGE,
) -> tuple[Outcome, Rig]:
    rig = Rig()
    watcher = rig.connect("run")
    states, truths = watcher.every(topics.STATE), watcher.every(topics.TRUTH)
    healths = watcher.every(topics.HEALTH)
    rig.start("source", source, SourceConfig(stage, service))
    rig.start("segmenter", segmenter, SegmenterConfig(service, seed))
    rig.start("tracker", tracker, TrackerConfig(service, seed))
    rig.wait()
    rig.stop()
    outcome = Outcome(drain(states), drain(truths), drain(healths))
    watcher.close()
    return outcome, rig


@pytest.fixture(scope="module")
def seed() -> tuple[tuple[float, float], ...]:
    return (open_scene("figure8-107").seed_pixel(0),)


@pytest.fixture(scope="module")
def outcome(seed: tuple[tuple[float, float], ...]) -> Outcome:
    found, rig = play(seed)
    assert not rig.errors
    return found


def test_every_frame_gives_a_tracked_state_near_the_truth(outcome: Outcome) -> None:
    assert [s.stamp.frame for s in outcome.states] == list(range(FRAMES))
    assert [t.stamp.frame for t in outcome.truths] == list(range(FRAMES))
    for state, truth in zip(outcome.states, outcome.truths, strict=True):
        assert state.status is Status.TRACKING
        assert state.stamp == truth.stamp
        assert state.curve is not None
        points = nurbs.evaluate(state.curve, np.linspace(0, 1, 400))
        # Metres on the wire, although the scene is in millimetres.
        assert curve_error(points, truth.points).rms < 1e-3
        assert truth.length == pytest.approx(0.107, rel=1e-3)
        assert state.length == pytest.approx(truth.length, rel=0.02)


def test_every_process_reports_its_health(outcome: Outcome) -> None:
    last = {health.process: health for health in outcome.healths}
    assert set(last) == {"source", "segmenter", "tracker"}
    for health in last.values():
        assert health.frames == FRAMES
        assert health.dropped == health.refused == 0
        assert health.stamp is not None
        assert health.stamp.frame == FRAMES - 1
        assert 0 < health.run_latency.p50_ms <= health.run_latency.max_ms
        assert health.memory_mb > 10


def bits(state: ThreadState) -> tuple[bytes, ...]:
    assert state.curve is not None
    arrays = (state.curve.control_points, state.curve.knots, state.sigma, state.seen)
    return (*(array.tobytes() for array in arrays), repr((state.length, state.energies)).encode())


def test_lock_step_gives_the_same_twice_to_the_bit(
    seed: tuple[tuple[float, float], ...], outcome: Outcome
) -> None:
    again, _ = play(seed)
    assert [bits(s) for s in again.states] == [bits(s) for s in outcome.states]
    times = [s.stamp.capture_ns for s in again.states]
    assert times == [round(i * 1e9 / 30) for i in range(FRAMES)]


def test_the_first_curve_does_not_depend_on_where_the_field_lies_in_memory() -> None:
    scene = open_scene("figure8-107")
    frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
    field = Segmenter(scene.rig).step(frame)
    curves = set()
    for offset in (*range(0, 16, 3), 0):
        memory = np.empty(field.left.size + 16, np.float32)
        shifted = memory[offset : offset + field.left.size].reshape(field.left.shape)
        shifted[:] = field.left
        found = initialize(
            RidgeField(field.stamp, shifted, field.right),
            scene.rig,
            Seed(pixel=scene.seed_pixel(0)),
        )
        curves.add(found.curve.control_points.tobytes())
    assert len(curves) == 1


def test_a_seed_that_cannot_be_costs_the_segmenter_no_frame(
    seed: tuple[tuple[float, float], ...],
) -> None:
    rig = Rig()
    watcher = rig.connect("run")
    fields = watcher.every(topics.FIELD)
    rig.start("source", source, SourceConfig(STAGE, LOCKSTEP))
    rig.start("segmenter", segmenter, SegmenterConfig(LOCKSTEP, ((-500.0, 20.0), *seed)))
    rig.start("tracker", tracker, TrackerConfig(LOCKSTEP, seed))
    rig.wait()
    rig.stop()
    assert not rig.errors
    assert [field.stamp.frame for field in drain(fields)] == list(range(FRAMES))


def test_a_seed_on_no_thread_ends_the_tracker_with_the_reason() -> None:
    stage = InputConfig("stage:figure8-107", frames=40)
    _, rig = play(((5.0, 5.0),), stage=stage)
    assert "seed (5.0, 5.0)" in str(rig.errors["tracker"])


def test_a_seed_on_an_image_without_ridges_is_answered(distorted_rig: StereoRig) -> None:
    replies: list[SeedReply] = []
    follower = Tracker(distorted_rig, TrackingConfig(patience=1))
    desk = SeedDesk(Bus(Hub().connect(), "rig", "tracker"), follower, distorted_rig, at_once=True)
    desk.seed(Seed(pixel=(320.0, 240.0)), Request(Seed(), replies.append))
    nothing = np.zeros((480, 640, 2), np.float32)
    field = RidgeField(Stamp(0, 0, 0), nothing, nothing)
    desk.settle(field.stamp, follower.step(field).initializations)
    (reply,) = replies
    assert not reply.accepted
    assert "no ridge at all" in reply.reason
    assert reply.candidates == ()


def test_a_live_seed_is_answered(seed: tuple[tuple[float, float], ...]) -> None:
    rig = Rig()
    operator = rig.connect("console")
    states = operator.every(topics.STATE)
    service = ServiceConfig()
    rig.start("source", source, SourceConfig(InputConfig("stage:figure8-107"), service))
    rig.start("segmenter", segmenter, SegmenterConfig(service))
    rig.start("tracker", tracker, TrackerConfig(service))
    while not operator.wait_for_alive("segmenter", 0.5):
        assert not rig.errors
    good = operator.ask(topics.SEED, Seed("right", pixel=seed[0]), 30)
    outside = operator.ask(topics.SEED, Seed("left", pixel=(900.0, 5.0)), 30)
    nothing = operator.ask(topics.SEED, Seed("left", pixel=(5.0, 5.0)), 30)
    assert good.stamp is not None
    state = next(s for s in states if s.thread == "right" and s.stamp >= good.stamp)
    forgotten = operator.ask(topics.FORGET, Forget("right"), 30)
    gone = (s for s in states if s.events == ("forgotten",))
    refused, last = next(gone), next(gone)
    unknown = operator.ask(topics.FORGET, Forget("middle"), 30)
    rig.stop()
    assert (forgotten.known, unknown.known) == (True, False)
    assert (refused.thread, refused.curve) == ("left", None)
    assert (last.thread, last.curve) == ("right", None)
    assert not outside.accepted
    assert "outside the 640x480 left image" in outside.reason
    assert not nothing.accepted
    assert nothing.stamp is not None
    assert good.accepted
    # It is looked for in a field that was segmented with the thread's colour known.
    found = re.match(r"found ([0-9.]+) mm with confidence ([0-9.]+)", good.reason)
    assert found is not None
    assert float(found[1]) == pytest.approx(107, abs=2)
    assert float(found[2]) > 0.8
    assert good.curve is not None
    assert state.status is Status.TRACKING


class Still:
    """One picture again and again, as it is asked for: a line that only the left view shows has a look
    that can be learned, but is no thread."""

    LINE = 141.0, 60.0

    def __init__(self) -> None:
        self.scene, self._rig = open_scene("figure8-107"), Rig()
        left, right = self.scene.render(0)
        self._images, self._camera = (left.copy(), right), self._rig.connect("source")
        self._images[0][58:62, 100:180] = 40, 200, 60
        self._camera.answer(topics.CALIBRATION, lambda _: self.scene.rig)
        self._steps, self.drops, self._fields, self.states = (
            self._camera.every(topic)
            for topic in (topics.STEP, topics.DROPPED, topics.FIELD, topics.STATE)
        )
        unchanging = SegmentationConfig(adapt=False)
        config = SegmenterConfig(LOCKSTEP, segmentation=unchanging)
        self._rig.start("segmenter", segmenter, config)
        self._rig.start("tracker", tracker, TrackerConfig(LOCKSTEP))
        assert self._camera.wait_for_alive("segmenter", 60)
        assert self._camera.wait_for_alive("tracker", 60)

    def play(self, frames: int, seeds: dict[int, Seed]) -> list[bytes]:
        """The fields of so many frames, with seeds before some."""
        seen = []
        for frame in range(frames):
            if frame in seeds:
                with suppress(NoAnswer):
                    self._camera.ask(topics.SEED, seeds[frame], timeout=0)
            stamp = Stamp(frame, frame * 33_333_333, 0)
            self._camera.publish(topics.FRAME, StereoFrame(stamp, *self._images))
            assert self._steps.get(60) is not None
            seen.append(next(iter(self._fields)).left.tobytes())
        self._rig.stop()
        assert not self._rig.errors
        return seen


def test_a_seed_on_nothing_leaves_no_trace_once_it_is_refused() -> None:
    still = Still()
    seen = still.play(34, {1: Seed("wrong", pixel=still.LINE)})
    assert [drop.thread for drop in drain(still.drops)] == ["wrong"]
    states = drain(still.states)
    assert [s.stamp.frame for s in states] == [*range(1, 32)]
    assert [s.events for s in states].index(("forgotten",)) == 30
    # Looked for in frames 1 to 30, and known to the segmenter in 2 to 30.
    assert [field == seen[0] for field in seen] == [not 2 <= i <= 30 for i in range(34)]


def test_a_seed_on_nothing_takes_nothing_from_a_thread_that_is_tracked() -> None:
    still = Still()
    seeds = Seed("a", pixel=still.scene.seed_pixel()), Seed("a", pixel=still.LINE)
    seen = still.play(50, {1: seeds[0], 5: seeds[1]})
    states = drain(still.states)
    (given_up,) = [s.stamp.frame for s in states if "given up" in s.events]
    assert [field == seen[3] for field in seen[3:]] == [not 5 < i <= given_up for i in range(3, 50)]
    assert drain(still.drops) == []
    assert [s.events[0] for s in states if "found" in s.events] == ["found"]
    assert all(s.curve is not None for s in states)
    assert states[-1].status is Status.TRACKING


def test_a_thread_outlives_its_seed_and_the_time_in_which_it_was_found() -> None:
    """What its seed was has gone with a source; then another source begins to count anew."""
    scene, rig = open_scene("figure8-107"), Rig()
    camera, before = rig.connect("source"), rig.connect("before")
    camera.answer(topics.CALIBRATION, lambda _: scene.rig)
    camera.keep(topics.STATE)
    states = camera.every(topics.STATE)
    segments, seed = Segmenter(scene.rig), Seed("mine", pixel=scene.seed_pixel(0))

    def frame(at_s: float) -> StereoFrame:
        return StereoFrame(Stamp(int(30 * at_s), int(1e9 * at_s), 0), *scene.render(0))

    def field(at_s: float) -> RidgeField:
        return segments.step(frame(at_s))

    segments.learn(frame(0), seed)
    tracker_before = Tracker(scene.rig)
    tracker_before.seed(seed)
    last = tracker_before.step(field(0)).states[0]
    before.publish(topics.STATE, scaled(last, scene.rig.metres_per_unit))
    assert states.get(1) is not None
    rig.start("tracker", tracker, TrackerConfig(ServiceConfig(resume=1)))
    assert camera.wait_for_alive("tracker", 60)
    found = []
    for at_s in (100.0, 100.1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        refused = rig.buses["tracker"].refused
        camera.publish(topics.FIELD, field(at_s))
        wait_until(lambda n=refused: states.waiting or rig.buses["tracker"].refused > n)
        found += [(s.stamp.frame, "found again" in s.events) for s in drain(states)]
    rig.stop()
    assert not rig.errors
    assert found == [(3000, True), (3003, False), (15, True), (18, False)]

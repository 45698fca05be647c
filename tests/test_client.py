"""The Python client, against a tracker that is played on the in-memory bus."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from services import topics, wire
from services.bus import Bus
from services.client import Client, Refused, Seen, Unavailable
from services.memory_transport import Hub
from services.messages import Forgotten, GraspReply, Health, Latency, SeedReply
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import (
    Energies,
    Grasp,
    InputError,
    Nurbs,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
)
from tests.conftest import wait_until
from tests.painting import paint, thread

PERIOD_NS = 33_333_333


class Stage:
    """A tracker that does what it is told, and a client."""

    def __init__(self, curve: Nurbs):
        self.hub = Hub()
        self.tracker = Bus(self.hub.connect(), "rig", "tracker")
        self.client = Client(Bus(self.hub.connect(), "rig", "client"))
        self.state = ThreadState(
            Stamp(0, 0, 0, PERIOD_NS),
            "0",
            Status.TRACKING,
            curve,
            nurbs.length(curve),
            Energies(),
            np.full(8, 0.1),
            np.ones(8, bool),
        )

    def publish(self, frame: int, thread: str = "0", age_ms: float = 0) -> None:
        released_ns = time.time_ns() - round(age_ms * 1e6)
        stamp = Stamp(frame, frame * PERIOD_NS, released_ns, PERIOD_NS)
        self.tracker.publish(topics.STATE, replace(self.state, stamp=stamp, thread=thread))


@pytest.fixture
def stage(curve: Nurbs) -> Iterator[Stage]:
    stage = Stage(curve)
    yield stage
    stage.client.close()
    stage.tracker.close()


def wait_for_frame(client: Client, frame: int) -> Seen:
    wait_until(lambda: (s := client.latest()) is not None and s.state.stamp.frame == frame)
    seen = client.latest()
    assert seen is not None
    return seen


def follow(stage: Stage, thread: str | None = None) -> list[tuple[str, int, str]]:
    """What a loop over the states gets: thread, frame, and why it is stale."""
    got: list[tuple[str, int, str]] = []

    def note(seen: Seen) -> None:
        got.append((seen.state.thread, seen.state.stamp.frame, seen.reason))

    listeners = len(stage.client._listeners)
    stage.client.watch(note, thread)
    wait_until(lambda: len(stage.client._listeners) > listeners)
    return got


def test_states_arrive_in_order_and_by_thread(stage: Stage) -> None:
    both, one = follow(stage), follow(stage, "b")
    for frame in range(5):
        stage.publish(frame, "a")
        stage.publish(frame, "b")
    wait_until(lambda: len(both) >= 10 and len(one) >= 5)
    assert [(t, f) for t, f, _ in both[:10]] == [(t, f) for f in range(5) for t in "ab"]
    assert [(t, f) for t, f, _ in one[:5]] == [("b", f) for f in range(5)]
    assert set(stage.client.threads) == {"a", "b"}
    latest = stage.client.latest("b")
    assert latest is not None
    assert latest.state.stamp.frame == 4
    assert stage.client.latest("c") is None
    assert stage.client.missed == 0


def test_silence_is_told_once_and_in_time(stage: Stage) -> None:
    """By the client's own clock: nothing arrives to tell it."""
    got = follow(stage)
    began = time.time_ns()
    stage.publish(7)
    wait_until(lambda: len(got) == 2)
    assert time.time_ns() - began < 10 * PERIOD_NS
    assert [(frame, bool(reason)) for _, frame, reason in got] == [(7, False), (7, True)]
    assert "nothing came" in got[1][2]
    latest = stage.client.latest()
    assert latest is not None
    assert not latest.live
    stage.publish(8)
    wait_until(lambda: len(got) == 4)
    assert [(frame, bool(reason)) for _, frame, reason in got[2:]] == [(8, False), (8, True)]


def test_no_live_state_is_older_than_three_periods(stage: Stage) -> None:
    """Whatever the delay of the last one before the silence."""
    for frame, delay_ms in enumerate((0, 30, 60, 95)):
        stage.publish(frame, age_ms=delay_ms)
        seen = wait_for_frame(stage.client, frame)
        wait_until(lambda seen=seen: not seen.live)  # type: ignore[misc]
        assert seen.freshness.left_ns == 0
        stale_at_ns = seen.state.stamp.released_ns + 3 * PERIOD_NS
        assert time.time_ns() - stale_at_ns < 5 * PERIOD_NS


def test_a_tracker_that_repeats_old_frames_is_stale(stage: Stage) -> None:
    got = follow(stage)
    for _ in range(20):
        stage.publish(3, age_ms=101)
    wait_until(lambda: len(got) == 20)
    assert all("old" in reason for _, _, reason in got)


def test_gaps_in_the_numbers_are_counted(stage: Stage) -> None:
    got = follow(stage)
    sender, key = stage.hub.connect(), "suturetrack/rig/thread/0/state"
    state = replace(stage.state, stamp=Stamp(0, 0, time.time_ns(), PERIOD_NS))
    for number in (0, 1, 4, 5, 9):
        sender.put(key, wire.encode(state, "tracker-1", number), large=False)
    wait_until(lambda: len(got) >= 5)
    assert stage.client.missed == 2 + 3


def test_a_slow_loop_delays_nobody_and_its_losses_are_counted(stage: Stage) -> None:
    slow = stage.client.states()
    thread = threading.Thread(target=lambda: next(slow))
    thread.start()
    wait_until(lambda: len(stage.client._listeners) == 1)
    stage.publish(1)
    thread.join(10)
    for frame in range(2, 1100):
        stage.publish(frame)
    wait_for_frame(stage.client, 1099)
    assert stage.client.missed == 1098 - 1024
    slow.close()
    assert stage.client.missed == 1098 - 1024


def test_a_callback_that_fails_is_called_again(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[int] = []

    def fail(seen: Seen) -> None:
        calls.append(seen.state.stamp.frame)
        raise RuntimeError("mine")

    stage.client.watch(fail)
    wait_until(lambda: len(stage.client._listeners) == 1)
    stage.publish(1)
    stage.publish(2)
    wait_until(lambda: len(calls) >= 2)
    assert "a callback failed on frame 1" in caplog.text


def test_seeds_are_answered_or_refused(stage: Stage, curve: Nurbs) -> None:
    asked: list[Seed] = []

    def find(seed: Seed) -> SeedReply:
        asked.append(seed)
        if seed.pixel == (1.0, 2.0):
            return SeedReply(seed.thread, False, "no ridge there", candidates=((5.0, 6.0),))
        return SeedReply(seed.thread, True, "found 10 mm", Stamp(0, 0, 0), curve)

    stage.tracker.answer(topics.SEED, find)
    stage.tracker.declare_alive()
    reply = stage.client.seed((3.0, 4.0), thread="a")
    assert reply.curve is not None
    assert stage.client.seed(point=(0.1, 0.2, 0.3)).accepted
    assert [(s.thread, s.pixel, s.point) for s in asked] == [
        ("a", (3.0, 4.0), None),
        ("0", None, (0.1, 0.2, 0.3)),
    ]
    with pytest.raises(Refused, match="no ridge there") as refusal:
        stage.client.seed((1.0, 2.0))
    assert refusal.value.candidates == ((5.0, 6.0),)
    for wrong in (-1.0, math.nan, "soon"):
        with pytest.raises(InputError, match=r"timeout .*: use"):
            stage.client.seed((1.0, 2.0), timeout=wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="exactly one"):
        stage.client.seed()
    with pytest.raises(InputError, match="thread 'a/b'"):
        stage.client.seed((1.0, 2.0), thread="a/b")


def test_an_area_and_a_laser_spot_seed_at_a_pixel(stage: Stage, rig: StereoRig) -> None:
    """What the newest field and the newest images show, in either view."""
    line = thread(0.3)
    field = paint(rig, [line], 0)
    source, segmenter = (Bus(stage.hub.connect(), "rig", name) for name in ("source", "segmenter"))
    source.answer(topics.CALIBRATION, lambda _: rig)
    asked: list[Seed] = []
    stage.tracker.answer(topics.SEED, lambda s: asked.append(s) or SeedReply(s.thread, True, ""))
    for bus in (source, segmenter, stage.tracker):
        bus.declare_alive()

    def lit(place: tuple[int, int]) -> StereoFrame:
        images = [np.full((480, 640, 3), 90, np.uint8) for _ in range(2)]
        cv2.circle(images[0], place, 5, (255, 255, 255), -1, cv2.LINE_AA)
        return StereoFrame(field.stamp, *images)

    def seed(spot: tuple[int, int] = (320, 200), **where: Any) -> Seed:
        """While images and fields come, as they do, and go on doing so for a moment."""
        done, frame = threading.Event(), lit(spot)

        def play() -> None:
            after = 0
            while after < 3:
                source.publish(topics.FRAME, frame)
                segmenter.publish(topics.FIELD, field)
                after += done.wait(0.01)

        player = threading.Thread(target=play)
        player.start()
        try:
            stage.client.seed(**where)
        finally:
            done.set()
            player.join()
        return asked[-1]

    left, right = (tuple(p[300]) for p in rig.project(line))
    (u, v), (x, y) = left, right
    assert seed(area=(u - 20, v - 20, u + 20, v + 20)).pixel == pytest.approx(left, abs=21)
    point = seed(area=(x - 20, y - 20, x + 20, y + 20), view="right").point
    assert np.linalg.norm(line - 1000 * np.array(point), axis=1).min() < 2
    for spot in ((320, 200), (100, 300)):
        assert seed(spot, laser=True).pixel == pytest.approx(spot, abs=0.5)
    for wrong, where in (
        ("nothing in the area", {"area": (0, 0, 20, 20)}),
        ("no laser spot", {"laser": True, "view": "right"}),
        ("exactly one", {"laser": True, "pixel": (1, 2)}),
    ):
        with pytest.raises(InputError, match=wrong):
            seed(**where)
    assert len(asked) == 4
    # Nothing large is read between the seeds.
    assert not source.wait_for_readers(topics.FRAME, 0)
    assert not segmenter.wait_for_readers(topics.FIELD, 0)
    source.close()
    segmenter.close()


def test_grasps_are_answered_or_refused(stage: Stage) -> None:
    pose = Grasp(Stamp(0, 0, 0), "0", np.ones(3), np.eye(3), 1e-4)
    stage.tracker.answer(
        topics.GRASP,
        lambda request: (
            GraspReply("0", pose)
            if request.where.from_end == 0.01
            else GraspReply("0", None, "thread '0' is lost")
        ),
    )
    stage.tracker.declare_alive()
    assert stage.client.grasp(from_end=0.01).sigma == 1e-4
    with pytest.raises(Refused, match="is lost"):
        stage.client.grasp(fraction=0.5)
    with pytest.raises(InputError, match="exactly one"):
        stage.client.grasp(fraction=0.5, from_end=0.1)


def test_numbers_may_be_numpys(stage: Stage) -> None:
    asked: list[Any] = []
    pose = Grasp(Stamp(0, 0, 0), "0", np.ones(3), np.eye(3), 1e-4)
    stage.tracker.answer(topics.GRASP, lambda r: asked.append(r) or GraspReply("0", pose))
    stage.tracker.answer(topics.SEED, lambda s: asked.append(s) or SeedReply(s.thread, True, ""))
    stage.tracker.declare_alive()
    stage.client.grasp(from_end=np.float64(0.01), approach=np.array([0, 0, 1]))
    stage.client.grasp(fraction=np.float32(0.5))
    stage.client.seed(np.array([3, 4]))
    stage.client.seed(point=np.array([0.1, 0.2, 0.3]))
    assert [r.where.from_end for r in asked[:1]] + [asked[1].where.fraction] == [0.01, 0.5]
    assert [s.pixel or s.point for s in asked[2:]] == [(3.0, 4.0), (0.1, 0.2, 0.3)]


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda c: c.grasp(from_end="10mm"), "from_end '10mm': use a finite number"),
        (lambda c: c.grasp(near=(0.1, 0.2)), r"near \(0.1, 0.2\): use 3 finite"),
        (lambda c: c.grasp(fraction=0.5, approach="down"), "approach 'down': use 3 finite"),
        (lambda c: c.grasp(0, fraction=0.5), "thread 0: a name is a string"),
        (lambda c: c.forget(None), "thread None: a name is a string"),
        (lambda c: c.seed((3.0,)), "pixel .*: use 2 finite"),
        (lambda c: c.seed((np.nan, 3.0), view="right"), "pixel .*: use 2 finite"),
        (lambda c: c.seed((3.0, 4.0), view="rigth"), "view 'rigth': use left or right"),
        (lambda c: c.seed(area=(1, 2, 3)), "area .*: use 4 finite"),
        (lambda c: c.move_tool(np.zeros(2), np.eye(3), trigger=False), "position .*: use 3 finite"),
        (lambda c: c.move_tool(np.zeros(3), 2 * np.eye(3), trigger=False), "rotation is no rota"),
        (lambda c: c.move_tool(np.zeros(3), np.eye(3), trigger=False, tool="a/b"), "tool 'a/b'"),
    ],
)
def test_wrong_arguments_are_told_before_anyone_is_asked(
    stage: Stage, ask: Callable[[Client], object], words: str
) -> None:
    stage.tracker.declare_alive()
    with pytest.raises(InputError, match=words) as caught:
        ask(stage.client)
    assert type(caught.value) is InputError


def test_a_forgotten_thread_is_gone_after_its_last_state(stage: Stage) -> None:
    stage.tracker.answer(topics.FORGET, lambda f: Forgotten(f.thread, f.thread == "a"))
    stage.tracker.declare_alive()
    got = follow(stage)
    stage.publish(1, "a")
    wait_until(lambda: stage.client.threads == ("a",))
    assert stage.client.forget("a")
    assert not stage.client.forget("b")
    stamp = Stamp(2, 2 * PERIOD_NS, time.time_ns(), PERIOD_NS)
    last = replace(stage.state, stamp=stamp, thread="a", events=("forgotten",))
    stage.tracker.publish(topics.STATE, last)
    wait_until(lambda: stage.client.threads == ())
    wait_until(lambda: [frame for _, frame, _ in got][:2] == [1, 2])


def test_a_thread_that_nobody_follows_any_more_is_gone(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another tracker runs since, and tells of its own threads alone."""
    monkeypatch.setattr("services.client._GONE_NS", 50_000_000)
    stage.publish(1, "a")
    wait_until(lambda: stage.client.threads == ("a",))
    wait_until(lambda: (seen := stage.client.latest("a")) is not None and not seen.live)
    assert stage.client.threads == ("a",)
    stage.publish(2, "b")
    wait_until(lambda: stage.client.threads == ("b",))
    assert stage.client.latest("a") is None


def test_threads_of_a_slow_stream_are_not_gone_between_two_frames(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.client._GONE_NS", 50_000_000)
    for name in "ab":
        stage.publish(1, name)
    wait_until(lambda: set(stage.client.threads) == {"a", "b"})
    wait_until(lambda: (seen := stage.client.latest("b")) is not None and not seen.live)
    got = follow(stage, "a")
    stage.publish(2, "a")
    wait_until(lambda: got)
    assert set(stage.client.threads) == {"a", "b"}
    stage.publish(3, "a")
    wait_until(lambda: stage.client.threads == ("a",))


def test_a_closed_client_says_so(stage: Stage) -> None:
    """Also to who waited for an answer when another thread closed it."""
    asked, closed = threading.Event(), threading.Event()

    def answer_late(seed: Seed) -> SeedReply:
        asked.set()
        closed.wait(30)
        return SeedReply(seed.thread, True, "")

    stage.tracker.answer(topics.SEED, answer_late)
    stage.tracker.declare_alive()
    errors: list[BaseException] = []

    def ask() -> None:
        try:
            stage.client.seed((1.0, 2.0), timeout=0.2)
        except InputError as error:
            errors.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    assert asked.wait(10)
    stage.client.close()
    asking.join(10)
    closed.set()
    for call in (
        lambda c: c.grasp(fraction=0.5),
        lambda c: c.seed(laser=True),
        lambda c: c.calibration(),
        lambda c: c.move_tool(np.zeros(3), np.eye(3), trigger=False),
    ):
        with pytest.raises(Unavailable) as caught:
            call(stage.client)
        errors.append(caught.value)
    assert [str(error) for error in errors] == 5 * ["this client is closed; connect again"]


def test_nobody_there_is_said_plainly(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.client._ARRIVAL_S", 0.05)
    monkeypatch.setattr("services.client._BEAT_S", 0.05)
    nobody = (
        "does not answer; no source and no segmenter and no tracker runs on rig 'rig'; start one"
    )
    with pytest.raises(Unavailable, match=f"the tracker {nobody} with `suturetrack run`"):
        stage.client.grasp(fraction=0.5)
    with pytest.raises(Unavailable, match=f"the source {nobody} with `suturetrack run`"):
        stage.client.calibration()
    stage.tracker.declare_alive()
    absent = "no source and no segmenter runs on rig 'rig'; start one with `suturetrack source"
    with pytest.raises(Unavailable, match=f"does not answer: .*; {absent}"):
        stage.client.grasp(fraction=0.5)
    with pytest.raises(Unavailable, match=f"no frames come in which to look; {absent}"):
        stage.client.seed(laser=True)


def test_those_who_begin_are_named_with_what_they_wait_for(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They run: nobody should start them again."""
    monkeypatch.setattr("services.client._ARRIVAL_S", 0.05)
    idle = Health("", 0, None, 0.0, Latency(), 0.0, Latency(), 0, 0, 0, 0.0, ready=False)

    def beat() -> None:
        assert stage.tracker.wait_for_readers(topics.HEALTH, 10)
        for name, awaited in (("tracker", "source"), ("segmenter", "")):
            stage.tracker.publish(topics.HEALTH, replace(idle, process=name, awaits=awaited))

    beating = threading.Thread(target=beat)
    beating.start()
    with pytest.raises(Unavailable) as caught:
        stage.client.grasp(fraction=0.5)
    beating.join(10)
    assert str(caught.value) == (
        "the tracker does not answer; the segmenter is not ready yet; the tracker waits for the source; "
        "no source runs on rig 'rig'; start one with `suturetrack source --rig rig`, "
        "or name the rig that runs"
    )

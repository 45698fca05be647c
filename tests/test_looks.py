"""Looks at threads beside the tracking, and what they say together."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationConfig,
    InitializationError,
    initialize,
)
from suturetrack.initialization.matching import raised
from suturetrack.polylines import polyline_length
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.images import Images
from suturetrack.tracking.overlaps import doubting_ends
from suturetrack.tracking.recovery import Setup, directed
from suturetrack.tracking.sampling import views
from suturetrack.tracking.searches import FromSeed
from suturetrack.tracking.strands import Neighbour, Neighbours, Strand
from suturetrack.tracking.strangers import Strangers
from suturetrack.tracking.sureness import Sureness
from suturetrack.types import Bool, Nurbs, RidgeField, Seed, Status, ThreadState
from tests.painting import FPS, kinked, paint, seed_at, seed_on, thread

Look = Callable[..., Initialization]
DELAY = round(0.3 * FPS)


def rms(state: ThreadState, truth: np.ndarray) -> float:
    assert state.curve is not None
    return metrics.curve_error(nurbs.evaluate(state.curve, np.linspace(0, 1, 500)), truth).rms


def pair(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Two threads side by side."""
    time = frame / FPS
    other = thread(1 + time, 80.0, 210.0, -0.6) + np.array([0, 14, 0])
    return thread(time) - [0, 8, 0], other


def turned(points: np.ndarray) -> np.ndarray:
    """The second thread through its seed still, but turned around it, so that it has to be looked for."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(pair(0)[1][300] + (points - points[300]) @ turn)


def fields_of(rig: StereoRig, count: int, away: range) -> list[RidgeField]:
    """Both threads, the second of them away for a while."""
    pairs = [pair(i) for i in range(count)]
    return [paint(rig, both[:1] if i in away else both, i) for i, both in enumerate(pairs)]


def looks_by(monkeypatch: pytest.MonkeyPatch, look: Look) -> None:
    monkeypatch.setattr("suturetrack.tracking.recovery.initialize", look)


def loses_the_first(monkeypatch: pytest.MonkeyPatch, lost_at: int) -> None:
    """Whoever follows a thread from frame 0 on loses it in a frame, for good."""
    step = Follower.step
    first: list[Follower] = []

    def lose(self: Follower, field: RidgeField, *args: object) -> ThreadState:
        state = step(self, field, *args)  # type: ignore[arg-type]
        # The worker of another test may still follow what that one looked for.
        if field.stamp.frame == 0:
            first[:] = first or [self]
        is_lost = self in first and field.stamp.frame >= lost_at
        return replace(state, status=Status.LOST) if is_lost else state

    monkeypatch.setattr(Follower, "step", lose)


def tracker_of(rig: StereoRig) -> Tracker:
    tracker = Tracker(rig)
    for name, points in zip("ab", pair(0), strict=True):
        tracker.seed(seed_on(rig, points, name))
    return tracker


def test_a_look_for_one_thread_holds_no_other_up(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = fields_of(rig, 50, range(4, 20))
    tracker = tracker_of(rig)
    states = [tracker.step(field).states for field in fields[:4]]
    assert [state.status for state in states[-1]] == [Status.TRACKING] * 2
    began, may_end, ended = threading.Event(), threading.Event(), threading.Event()

    def slow(*args: object) -> Initialization:
        began.set()
        assert may_end.wait(30)
        ended.set()
        return initialize(*args)  # type: ignore[arg-type]

    looks_by(monkeypatch, slow)
    beside = 0
    for field in fields[4:]:
        states.append(tracker.step(field).states)
        if tracker._look is not None and not may_end.is_set():
            assert began.wait(30)
            assert not ended.is_set()
            assert states[-1][0].status is Status.TRACKING
            assert rms(states[-1][0], pair(field.stamp.frame)[0]) < 0.15
            beside += 1
        if beside == DELAY - 2:
            may_end.set()
    assert ended.is_set()
    assert all(a.status is Status.TRACKING for a, _ in states)
    assert any(b.status is Status.LOST for _, b in states)
    assert states[-1][1].status is Status.TRACKING
    for state, truth in zip(states[-1], pair(49), strict=True):
        assert rms(state, truth) < 0.15


def test_when_a_look_is_done_makes_no_difference(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = fields_of(rig, 60, range(4, 16))
    back = [turned(pair(i)[1]) for i in range(60)]
    fields[16:] = [paint(rig, [pair(i)[0], back[i]], i) for i in range(16, 60)]
    runs = []
    for slowness_s in (0.0, 0.03):

        def look(*args: object, slowness_s: float = slowness_s) -> Initialization:
            time.sleep(slowness_s)
            return initialize(*args)  # type: ignore[arg-type]

        looks_by(monkeypatch, look)
        tracker = tracker_of(rig)
        runs.append([state for field in fields for state in tracker.step(field).states])
    assert any("found again" in state.events for state in runs[0])
    assert runs[0][-1].status is Status.TRACKING
    assert rms(runs[0][-1], back[-1]) < 0.15
    for one, other in zip(*runs, strict=True):
        assert (one.status, one.events, one.length) == (other.status, other.events, other.length)
        assert one.curve is not None
        assert other.curve is not None
        np.testing.assert_array_equal(one.curve.control_points, other.curve.control_points)


def test_buffers_may_be_used_again_while_a_look_goes_on(rig: StereoRig) -> None:
    fields = fields_of(rig, 12 + DELAY, range(0))
    results = []
    for is_reused in (False, True):
        tracker = Tracker(rig)
        tracker.seed(seed_on(rig, pair(0)[0], "a"))
        buffers = [np.empty_like(fields[0].left), np.empty_like(fields[0].right)]
        for i, field in enumerate(fields):
            if i == 2:
                tracker.seed(seed_on(rig, pair(2)[1], "b"))
            if is_reused:
                buffers[0][:], buffers[1][:] = field.left, field.right
                field = replace(field, left=buffers[0], right=buffers[1])
            step = tracker.step(field)
        results.append(step.states[1].curve)
    assert results[0] is not None
    assert results[1] is not None
    np.testing.assert_array_equal(results[0].control_points, results[1].control_points)


def test_a_thread_that_is_seeded_beside_another_comes_to_the_present(rig: StereoRig) -> None:
    fields = fields_of(rig, 30, range(0))
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0], "a"))
    steps = []
    for i, field in enumerate(fields):
        if i == 5:
            tracker.seed(seed_on(rig, pair(5)[1], "b"))
            assert tracker.is_sought("b")
        steps.append(tracker.step(field))
    (found,) = [i for i, step in enumerate(steps) if "b" in step.initializations]
    assert found == 5 + DELAY
    assert steps[found].looked_in["b"].stamp == fields[5].stamp
    first = steps[found].initializations["b"]
    assert isinstance(first, Initialization)
    places = nurbs.evaluate(first.curve, np.linspace(0, 1, 500))
    assert metrics.curve_error(places, pair(5)[1]).rms < 0.15
    assert rms(steps[found].states[1], pair(found)[1]) < 0.15
    assert steps[found].states[1].events[0] == "found"
    assert not tracker.is_sought("b")
    assert all(step.states[0].status is Status.TRACKING for step in steps)


def test_patience_ends_beside_another_thread_as_well(rig: StereoRig) -> None:
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0], "a"))
    fields = fields_of(rig, 50, range(50))
    tracker.step(fields[0])
    tracker.seed(seed_on(rig, pair(0)[1], "b"))
    errors = [i for i, field in enumerate(fields[1:]) if "b" in tracker.step(field).initializations]
    assert errors == [DELAY, 2 * DELAY, 3 * DELAY, 4 * DELAY][: len(errors)]
    assert 30 <= errors[-1] < 30 + DELAY
    assert not tracker.is_sought("b")


def test_a_seed_on_nothing_leaves_a_tracked_thread_as_it_is(rig: StereoRig) -> None:
    fields, tracker = fields_of(rig, 45, range(45)), Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0], "a"))
    states = []
    for i, field in enumerate(fields):
        if i == 5:
            tracker.seed(Seed("a", pixel=(5.0, 5.0)))
            assert tracker.is_sought("a")
        states += tracker.step(field).states
    (given_up,) = [i for i, state in enumerate(states) if "given up" in state.events]
    assert 30 <= given_up - 5 < 30 + DELAY
    assert not tracker.is_sought("a")
    assert all(state.status is Status.TRACKING for state in states)
    assert rms(states[-1], pair(44)[0]) < 0.15


def test_a_tracked_thread_is_held_until_it_is_found_elsewhere(rig: StereoRig) -> None:
    fields, tracker = fields_of(rig, 20, range(0)), Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0], "a"))
    states = []
    for i, field in enumerate(fields):
        if i == 5:
            tracker.seed(seed_on(rig, pair(5)[1], "a"))
        states += tracker.step(field).states
    (found,) = [i for i, state in enumerate(states) if i and "found" in state.events]
    assert found == 5 + DELAY
    assert all(state.status is Status.TRACKING for state in states)
    for i, state in enumerate(states):
        assert rms(state, pair(i)[i >= found]) < 0.15


def test_what_is_found_again_is_followed_on_the_rows_that_show_it(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    lowered = rig.with_row_offset(4)

    def look(field: RidgeField, rig: StereoRig, seed: Seed, config: object) -> Initialization:
        level = replace(field, right=raised(field.right, 4))
        return replace(initialize(level, rig, seed), row_offset_px=4)

    looks_by(monkeypatch, look)
    points, seed = pair(0)[0], seed_on(rig, pair(0)[0])
    before, after = Tracker(rig), Tracker(rig)
    before.seed(seed)
    (last,) = before.step(paint(lowered, [points], 0)).states
    after.resume(seed, last)
    states = [after.step(paint(lowered, [points], i)).states[0] for i in range(1, 8)]
    assert "found again" in states[0].events
    assert all(state.status is Status.TRACKING for state in states)
    assert rms(states[-1], points) < 0.1


def test_a_thread_whose_seed_lies_outside_the_image_stays_lost(rig: StereoRig) -> None:
    """It was lost above the images, and its seed with the source that remembered it."""
    points = thread(0.0)
    before, after = Tracker(rig), Tracker(rig)
    before.seed(seed_on(rig, points))
    (last,) = before.step(paint(rig, [points], 0)).states
    assert last.curve is not None
    above = replace(last.curve, control_points=last.curve.control_points - [0.0, 100.0, 0.0])
    x, y, z = (float(c) for c in points[300] - [0.0, 100.0, 0.0])
    after.resume(Seed("0", point=(x, y, z)), replace(last, curve=above))
    states = [after.step(paint(rig, [points], i)).states[0] for i in range(1, 20)]
    assert all(state.status is Status.LOST for state in states)
    after.seed(seed_on(rig, points))
    (state,) = after.step(paint(rig, [points], 20)).states
    assert state.status is Status.TRACKING
    assert rms(state, points) < 0.1


def follow(
    rig: StereoRig, truths: Sequence[np.ndarray], away: range = range(0)
) -> list[ThreadState]:
    """The states of a thread that is away in some frames."""
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, truths[0]))
    fields = [paint(rig, [] if i in away else [points], i) for i, points in enumerate(truths)]
    return [tracker.step(field).states[0] for field in fields]


def test_looks_at_a_thread_that_bends_add_up(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def doubtful(*args: object) -> Initialization:
        return replace(initialize(*args), confidence=0.4)  # type: ignore[arg-type]

    looks_by(monkeypatch, doubtful)
    truths = [thread(i / FPS) for i in range(3 * FPS)]
    states = follow(rig, truths)
    sure = next(i for i, state in enumerate(states) if "found for sure" in state.events)
    assert sure > 2 * DELAY
    assert all(state.status is Status.OCCLUDED for state in states[:sure])
    assert all(state.status is Status.TRACKING for state in states[sure:])
    assert rms(states[-1], truths[-1]) < 0.1
    at_rest = follow(rig, [truths[0]] * len(truths))
    assert all(state.status is Status.OCCLUDED for state in at_rest)
    assert rms(at_rest[-1], truths[0]) < 0.1


@pytest.mark.parametrize("is_plain_later", [True, False])
def test_a_first_look_in_doubt_is_followed_by_two_at_once(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, is_plain_later: bool
) -> None:
    looks = []

    def look(field: RidgeField, *args: object) -> Initialization:
        looks.append(field.stamp.frame)
        is_plain = is_plain_later and field.stamp.frame == 2
        found = initialize(field, *args)  # type: ignore[arg-type]
        return replace(found, confidence=0.95 if is_plain else 0.4)

    looks_by(monkeypatch, look)
    states = follow(rig, [thread(i / FPS) for i in range(FPS)])
    assert looks[:3] == [0, 1, 2]
    assert [state.status for state in states[:2]] == [Status.OCCLUDED] * 2
    if is_plain_later:
        assert all(state.status is Status.TRACKING for state in states[2:])
        assert len(looks) == 3
    else:
        assert looks[3] >= 0.25 * FPS
        assert all(state.status is Status.OCCLUDED for state in states)


def looks_at(*threads: int) -> Look:
    """Doubtful looks at one or the other of a pair, in turn; the last ones all at the last."""
    looks: list[int] = []

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        looks.append(threads[min(len(looks), len(threads) - 1)])
        seed = seed_on(rig, pair(field.stamp.frame)[looks[-1]])
        return replace(initialize(field, rig, seed), confidence=0.45)

    return look


def test_looks_that_contradict_one_another_do_not_add_up(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks_by(monkeypatch, looks_at(*[0, 1] * 20))
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0]))
    states = [tracker.step(field).states[0] for field in fields_of(rig, 4 * FPS, range(0))]
    assert all(state.status is Status.OCCLUDED for state in states)


def test_what_most_looks_find_takes_the_place_of_the_first(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks_by(monkeypatch, looks_at(0, 1))
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0]))
    states = [tracker.step(field).states[0] for field in fields_of(rig, 4 * FPS, range(0))]
    assert rms(states[0], pair(0)[0]) < 0.15
    elsewhere = next(i for i, state in enumerate(states) if "found elsewhere" in state.events)
    sure = next(i for i, state in enumerate(states) if "found for sure" in state.events)
    assert elsewhere < sure
    assert all(state.status is Status.OCCLUDED for state in states[:sure])
    # Where the thread that nobody seeded touches it there may be doubt again for a moment.
    assert states[sure].status is states[-1].status is Status.TRACKING
    assert max(rms(state, pair(i)[1]) for i, state in enumerate(states) if i >= sure) < 0.25


def test_a_plain_look_takes_the_place_of_a_hopeless_one_at_once(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    confidences = iter([0.05])

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        confidence = next(confidences, 0.95)
        seed = seed_on(rig, pair(field.stamp.frame)[int(confidence > 0.5)])
        return replace(initialize(field, rig, seed), confidence=confidence)

    looks_by(monkeypatch, look)
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0]))
    states = [tracker.step(field).states[0] for field in fields_of(rig, FPS, range(0))]
    sure = next(i for i, state in enumerate(states) if "found for sure" in state.events)
    assert rms(states[0], pair(0)[0]) < 0.15
    assert all(state.status is Status.OCCLUDED for state in states[:sure])
    assert all(state.status is Status.TRACKING for state in states[sure:])
    assert max(rms(state, pair(i)[1]) for i, state in enumerate(states) if i >= sure) < 0.25


@pytest.mark.parametrize("confidence", [0.001, 0.3])
def test_a_curve_is_looked_at_where_it_is_and_not_where_it_was_seeded(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, confidence: float
) -> None:
    """However little speaks for it: another thread may lie on the seed's pixel by now."""
    truths = [thread(i / FPS) for i in range(2 * FPS)]
    distances: list[float] = []

    def look(field: RidgeField, rig: StereoRig, seed: Seed, _: object) -> Initialization:
        if seed.point is not None:
            away = truths[field.stamp.frame] - np.array(seed.point)
            distances.append(float(np.linalg.norm(away, axis=1).min()))
        hope = 0.9 if field.stamp.frame > FPS else confidence
        return replace(initialize(field, rig, seed), confidence=hope)

    looks_by(monkeypatch, look)
    states = follow(rig, truths)
    assert len(distances) > 1
    assert max(distances) < 1.0
    assert states[0].status is Status.OCCLUDED
    assert states[-1].status is Status.TRACKING
    assert rms(states[-1], truths[-1]) < 0.1


def test_where_a_thread_was_seeded_long_ago_is_no_place_to_look_from(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was followed for sure, and is found again far away, at first with next to no confidence."""
    away = range(3, 14)
    truths = [
        thread(i / FPS) + np.array([0.0, 15.0 * (i >= away.stop), 0.0]) for i in range(2 * FPS)
    ]
    confidences = iter([0.9, 0.01])

    def look(field: RidgeField, rig: StereoRig, seed: Seed, _: object) -> Initialization:
        if field.stamp.frame >= away.start and seed.pixel is not None:
            raise InitializationError("nothing is there", np.empty((0, 2)))
        found = initialize(field, rig, seed_on(rig, truths[field.stamp.frame]))
        return replace(found, confidence=next(confidences, 0.9))

    looks_by(monkeypatch, look)
    states = follow(rig, truths, away)
    again = next(i for i, state in enumerate(states) if "found again" in state.events)
    assert states[again].status is Status.OCCLUDED
    assert states[-1].status is Status.TRACKING
    assert rms(states[-1], truths[-1]) < 0.1


@pytest.mark.parametrize(
    ("first", "hope", "later"), [(0.6, 0.1, 1.0), (1.0, 0.1, 0.3), (1.0, 0.001, 0.3)]
)
def test_what_was_never_sure_does_not_tell_the_length_but_is_no_stub(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, first: float, hope: float, later: float
) -> None:
    """But for what was found with next to no hope, which may be anything."""
    whole, away = [thread(i / FPS) for i in range(FPS)], range(3, 14)
    down = np.array([0.0, 15.0, 0.0])
    rest = [points[: round(later * len(points))] + down for points in whole[away.stop :]]
    truths = [*whole[: away.stop], *rest]

    def look(field: RidgeField, rig: StereoRig, *_: object) -> Initialization:
        number = field.stamp.frame
        found = initialize(field, rig, seed_on(rig, truths[number]))
        part, confidence = (1.0, 0.9) if number > away.start else (first, hope)
        return replace(found, curve=nurbs.part(found.curve, 0.0, part), confidence=confidence)

    looks_by(monkeypatch, look)
    states = follow(rig, truths, away)
    assert states[0].length == pytest.approx(first * polyline_length(whole[0]), rel=0.1)
    assert states[away[-1]].status is Status.LOST
    if later == 1.0:
        assert states[-1].status is Status.TRACKING
        assert rms(states[-1], truths[-1]) < 0.15
    else:
        is_found = any("found again" in state.events for state in states)
        assert is_found == (hope < 0.01)


def test_what_was_never_sure_is_followed_again_in_doubt(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    truths, away = [thread(i / FPS) for i in range(FPS)], range(3, 14)
    for points in truths[away.stop :]:
        points[:, 1] += 15.0

    def look(field: RidgeField, rig: StereoRig, *_: object) -> Initialization:
        found = initialize(field, rig, seed_on(rig, truths[field.stamp.frame]))
        return replace(found, confidence=0.1)

    looks_by(monkeypatch, look)
    states = follow(rig, truths, away)
    assert states[away[-1]].status is Status.LOST
    assert any("found again" in state.events for state in states)
    assert states[-1].status is Status.OCCLUDED
    assert rms(states[-1], truths[-1]) < 0.15


def test_a_curve_that_lacks_an_end_is_what_a_look_finds(rig: StereoRig) -> None:
    field = paint(rig, [thread(0.0)], 0)
    look = initialize(field, rig, seed_on(rig, thread(0.0)))
    whole = look.curve
    short, shorter = nurbs.part(whole, 0.0, 0.93), nurbs.part(whole, 0.0, 0.8)
    for followed, found, is_sure in (
        (short, whole, True),
        (whole, short, False),
        (shorter, whole, False),
    ):
        sureness = Sureness(replace(look, confidence=0.4), followed, 0, rig)
        later = replace(look, curve=found, confidence=0.6)
        assert sureness.weigh(later, followed)
        assert not sureness.weigh(later, found)
        assert sureness.is_sure == is_sure


@pytest.mark.parametrize(
    ("moved_px", "bent_s", "is_same"),
    [(4.0, 0.0, True), (10.0, 0.0, True), (30.0, 0.0, False), (0.0, 0.6, False)],
)
def test_what_has_moved_a_little_as_a_whole_is_still_the_same(
    rig: StereoRig, moved_px: float, bent_s: float, is_same: bool
) -> None:
    look = look_at(rig, thread(0.0), 0.9)
    aside = np.array([0.0, moved_px * 200.0 / rig.focal, 0.0])
    found = look_at(rig, thread(bent_s) + aside, 0.3).curve
    sureness = Sureness(look, look.curve, 0, rig)
    assert sureness.is_same(found, look.curve, may_move=True) == is_same
    assert sureness.is_same(found, look.curve) == (is_same and moved_px < 5.0)


def test_a_part_of_what_was_sure_does_not_take_its_place(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tool may hide the rest, and look like an end."""
    looks = []

    def look(*args: object) -> Initialization:
        found = replace(initialize(*args), confidence=0.95)  # type: ignore[arg-type]
        looks.append(found)
        return found if len(looks) == 1 else replace(found, curve=nurbs.part(found.curve, 0.0, 0.7))

    looks_by(monkeypatch, look)
    tracker, truths = Tracker(rig), [thread(i / FPS) for i in range(4 * FPS)]
    tracker.seed(seed_on(rig, truths[0]))
    states = []
    for i, points in enumerate(truths):
        states += tracker.step(paint(rig, [points], i)).states
        if i == FPS // 2:
            assert states[-1].status is Status.TRACKING
            sureness, curve = tracker._threads["0"]._sureness, states[-1].curve
            assert sureness is not None
            assert curve is not None
            sureness.revoke(curve, states[-1].stamp.capture_ns)
    assert len(looks) > 3
    assert min(state.length for state in states) > 98.0
    assert rms(states[-1], truths[-1]) < 0.1


@pytest.mark.parametrize(("shown_at", "is_taken_up"), [(8, True), (40, True), (-45, False)])
def test_what_comes_into_sight_beyond_an_end_is_taken_up_unless_the_length_was_steady(
    rig: StereoRig, shown_at: int, is_taken_up: bool
) -> None:
    """A tool draws back along the thread, or stays where it is (below 0), and goes; or another comes."""
    steps = range(75) if shown_at > 0 else [0] * 75
    shares = [0.4 + 0.006 * k if i < abs(shown_at) else 1.0 for i, k in enumerate(steps)]
    truths = [thread(i / FPS)[: round(600 * share) + 1] for i, share in enumerate(shares)]
    tracker = Tracker(rig)
    tracker.seed(seed_at(rig, truths[0][120]))
    states = [tracker.step(paint(rig, [p], i)).states[0] for i, p in enumerate(truths)]
    further = [i for i, state in enumerate(states) if "found further on" in state.events]
    if not is_taken_up:
        assert not further
        assert max(state.length for state in states) < 60.0
        return
    assert shown_at < further[0] < shown_at + FPS // 2
    for state, points in zip(states[further[0] :], truths[further[0] :], strict=True):
        assert state.status is Status.TRACKING
        assert rms(state, points) < 0.15


@pytest.mark.parametrize("is_clear_once", [True, False])
def test_places_that_are_clear_in_one_look_each_are_sure_together(
    rig: StereoRig, is_clear_once: bool
) -> None:
    near, far = (0.3, 0.4), (0.7, 0.4)
    seen = [(near, far), (near,), (far,), (near,)] if is_clear_once else 4 * [(near, far)]
    looks = []
    for turn, left in enumerate(seen):
        truth = thread(0.6 * turn)
        found = initialize(paint(rig, [truth], turn), rig, seed_on(rig, truth))
        rest = 0.4 ** len(left)
        looks.append(replace(found, confidence=0.9 * rest, doubts=(left, ())))
    sureness = Sureness(looks[0], looks[0].curve, 0, rig)
    for look in looks[1:]:
        assert not sureness.is_sure
        assert not sureness.weigh(look, look.curve)
    assert sureness.is_sure == is_clear_once
    sureness.revoke(looks[-1].curve, 1)
    assert not sureness.is_hopeless
    sureness.weigh(looks[0], looks[0].curve)
    assert not sureness.is_sure


@pytest.mark.parametrize("as_long", [True, False])
def test_looks_settle_doubts_about_a_curve_of_one_length(rig: StereoRig, as_long: bool) -> None:
    """An end beside another ridge, as one look sees it, is a crossing once the curve runs on there."""
    first, second = (
        replace(look_at(rig, thread(0.6 * turn), 0.6), doubts=(((place, 0.4),), ()))
        for turn, place in enumerate((0.4, 0.9))
    )
    if not as_long:
        first = replace(first, curve=nurbs.part(first.curve, 0.0, 0.9))
    sureness = Sureness(first, first.curve, 0, rig)
    sureness.weigh(second, second.curve)
    assert sureness.is_sure == as_long


def test_a_sure_look_outweighs_doubtful_ones_of_another_length(rig: StereoRig) -> None:
    looks = [look_at(rig, thread(0.6 * turn), 0.8) for turn in range(4)]
    for i in (0, 1):
        shorter = nurbs.part(looks[i].curve, 0.0, 0.99)
        looks[i] = replace(looks[i], curve=shorter, confidence=0.45, doubts=(((0.5, 0.4),), ()))
    sureness = Sureness(looks[0], looks[0].curve, 0, rig)
    for look in looks[1:]:
        assert not sureness.is_sure
        sureness.weigh(look, look.curve)
    assert sureness.is_sure


@pytest.mark.parametrize(("confidence", "is_sure"), [(0.08, True), (0.03, False)])
def test_a_hopeless_look_settles_no_doubts(
    rig: StereoRig, confidence: float, is_sure: bool
) -> None:
    first, second, third = (look_at(rig, thread(0.6 * turn), 0.6) for turn in range(3))
    first, third = (replace(look, doubts=(((0.9, 0.4),), ())) for look in (first, third))
    sureness = Sureness(first, first.curve, 0, rig)
    for look in (replace(second, confidence=confidence), third):
        assert not sureness.is_sure
        assert not sureness.weigh(look, look.curve)
    assert sureness.is_sure == is_sure


@pytest.mark.parametrize("stays", [True, False])
def test_a_doubt_that_stays_is_not_voted_down(rig: StereoRig, stays: bool) -> None:
    looks = [look_at(rig, thread(0.6 * turn), 0.4) for turn in range(8)]
    if stays:
        looks = [replace(look, doubts=(((0.9, 0.4),), ())) for look in looks]
    sureness = Sureness(looks[0], looks[0].curve, 0, rig)
    for look in looks[1:]:
        assert not sureness.weigh(look, look.curve)
    assert sureness.is_sure != stays


def look_at(rig: StereoRig, truth: np.ndarray, confidence: float) -> Initialization:
    found = initialize(paint(rig, [truth], 0), rig, seed_on(rig, truth))
    return replace(found, confidence=confidence)


def test_a_curve_that_was_revoked_is_sure_again_once_it_has_moved(rig: StereoRig) -> None:
    still, moved = (look_at(rig, thread(time), 0.9) for time in (0.0, 0.6))
    sureness = Sureness(still, still.curve, 0, rig)
    sureness.revoke(still.curve, 1)
    assert not sureness.weigh(still, still.curve)
    assert not sureness.is_sure
    assert not Sureness(still, still.curve, 2, rig, sureness).is_sure
    assert Sureness(moved, moved.curve, 2, rig, sureness).is_sure
    sureness.weigh(moved, moved.curve)
    assert sureness.is_sure


@pytest.mark.parametrize(("count", "is_enough"), [(3, True), (12, False)])
def test_the_more_looks_there_were_the_more_votes_it_takes(
    rig: StereoRig, count: int, is_enough: bool
) -> None:
    """Of many looks at what is wrong some think it right."""
    first, *others = (look_at(rig, thread(0.6 * turn), 0.6) for turn in range(3))
    sureness = Sureness(replace(first, confidence=0.2), first.curve, 0, rig)
    for turn in range(count):
        assert sureness.asks_for_look(first.curve, 10_000_000_000 * (turn + 1))
    for look in others:
        assert not sureness.is_sure
        sureness.weigh(look, look.curve)
    assert sureness.is_sure == is_enough


@pytest.mark.parametrize(("confidence", "at_once"), [(0.6, False), (0.8, True)])
def test_a_first_look_that_is_not_plain_needs_a_second_one(
    rig: StereoRig, confidence: float, at_once: bool
) -> None:
    look = look_at(rig, thread(0.0), confidence)
    sureness = Sureness(look, look.curve, 0, rig)
    assert sureness.is_sure == at_once
    assert not sureness.weigh(look, look.curve)
    assert sureness.is_sure


@pytest.mark.parametrize(("confidence", "is_enough"), [(0.8, False), (0.95, True)])
def test_a_look_after_doubtful_ones_needs_another_unless_it_is_plain(
    rig: StereoRig, confidence: float, is_enough: bool
) -> None:
    first, second, third = (look_at(rig, thread(0.6 * turn), confidence) for turn in range(3))
    sureness = Sureness(replace(first, confidence=0.2), first.curve, 0, rig)
    sureness.weigh(second, second.curve)
    assert sureness.is_sure == is_enough
    sureness.weigh(third, third.curve)
    assert sureness.is_sure


@pytest.mark.parametrize(("is_known", "is_revoked"), [(True, False), (True, True), (False, False)])
def test_one_sure_look_is_enough_where_the_thread_was_found_again_by_its_length(
    rig: StereoRig, is_known: bool, is_revoked: bool
) -> None:
    first, second = (look_at(rig, thread(0.6 * turn), 0.6 * turn) for turn in range(2))
    sureness = Sureness(first, first.curve, 0, rig, is_known=is_known)
    if is_revoked:
        sureness.is_sure = True
        sureness.revoke(first.curve, 1)
    assert not sureness.is_sure
    sureness.weigh(second, second.curve)
    assert sureness.is_sure == (is_known and not is_revoked)


def test_a_sure_look_that_finds_another_length_needs_another(rig: StereoRig) -> None:
    """However long what was found again by its length is followed."""
    truth = thread(0.0)
    known, longer = look_at(rig, truth[: -len(truth) // 10], 0.4), look_at(rig, truth, 0.7)
    sureness = Sureness(known, known.curve, 0, rig, is_known=True)
    sureness.weigh(longer, known.curve)
    assert not sureness.is_sure


@pytest.mark.parametrize("is_accused", [False, True])
def test_what_runs_beside_a_revoked_curve_takes_its_place(rig: StereoRig, is_accused: bool) -> None:
    first = look_at(rig, thread(0.0), 0.9 if is_accused else 0.1)
    sureness = Sureness(first, first.curve, 0, rig)
    sureness.revoke(first.curve, 1)
    followed = look_at(rig, thread(0.6), 0.0).curve
    beside = look_at(rig, thread(0.6) + np.array([0.0, 2.0, 0.0]), 0.4)
    assert sureness.weigh(beside, followed) == is_accused
    assert not sureness.is_sure


@pytest.mark.parametrize(
    ("is_shared", "is_alone", "is_sure"),
    [(True, False, False), (True, True, True), (False, False, True)],
)
def test_a_seed_that_may_mean_either_thread_makes_none_sure_unless_there_is_but_one(
    rig: StereoRig,
    monkeypatch: pytest.MonkeyPatch,
    is_shared: bool,
    is_alone: bool,
    is_sure: bool,
) -> None:
    def look(field: RidgeField, rig: StereoRig, *args: object) -> Initialization:
        found = initialize(field, rig, *args)  # type: ignore[arg-type]
        is_first = field.stamp.frame == 0
        return replace(
            found,
            confidence=0.3 if is_first else 1.0,
            is_seed_shared=is_shared and is_first,
            is_alone=is_alone and not is_first,
        )

    looks_by(monkeypatch, look)
    states = follow(rig, [thread(i / FPS) for i in range(2 * FPS)], range(0))
    assert rms(states[-1], thread(2 - 1 / FPS)) < 0.15
    assert any("found for sure" in state.events for state in states) == is_sure
    assert states[-1].status is (Status.TRACKING if is_sure else Status.OCCLUDED)


def test_a_revoked_curve_does_not_tell_the_length(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was another thread: what later looks find for sure has its own length."""

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        seed = seed_on(rig, pair(field.stamp.frame)[min(field.stamp.frame, 1)])
        return replace(initialize(field, rig, seed), confidence=0.9)

    step, revoked_at = Strangers.step, 10

    def accuse(
        self: Strangers, curve: Nurbs, seen: Bool, images: Images, others: Neighbours
    ) -> Strangers:
        strangers = step(self, curve, seen, images, others)
        return replace(strangers, is_found=images.field.stamp.frame == revoked_at)

    looks_by(monkeypatch, look)
    monkeypatch.setattr(Strangers, "step", accuse)
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, pair(0)[0]))
    fields = fields_of(rig, 3 * FPS, range(0))
    states = [tracker.step(field).states[0] for field in fields]
    lengths = [polyline_length(points) for points in pair(0)]
    assert abs(lengths[0] - lengths[1]) > 0.1 * lengths[0]
    assert states[revoked_at - 1].status is Status.TRACKING
    assert rms(states[revoked_at - 1], pair(revoked_at - 1)[0]) < 0.2
    assert states[revoked_at].status is Status.OCCLUDED
    assert states[-1].status is Status.TRACKING
    assert rms(states[-1], pair(len(fields) - 1)[1]) < 0.2


def lens(height: float) -> np.ndarray:
    """A thread that bulges in its middle, where another one crosses it twice."""
    x = np.linspace(-30, 30, 600)
    bulge = np.where(abs(x) < 9, np.cos(np.pi * x / 18) ** 2, 0.0)
    return np.c_[x, 0.01 * x**2 + height * bulge, np.full(600, 200.0)]


@pytest.mark.parametrize(("confidence", "is_put_right"), [(0.6, True), (0.4, False)])
def test_a_curve_that_another_ridge_has_drawn_aside_is_put_right_by_a_look(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, confidence: float, is_put_right: bool
) -> None:
    truth, other = lens(0.7), lens(-0.7)  # Neither bends less than the other.

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        points = truth if field.stamp.frame else other
        found = initialize(paint(rig, [points], 0), rig, seed_on(rig, points))
        return replace(found, confidence=confidence if field.stamp.frame else 0.9)

    looks_by(monkeypatch, look)
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, truth))
    fields = [paint(rig, [truth, other], i) for i in range(FPS)]
    states = [tracker.step(field).states[0] for field in fields]
    assert all(state.status is Status.TRACKING for state in states)
    assert any("put right" in state.events for state in states) == is_put_right
    assert rms(states[0], other) < 0.1
    assert rms(states[-1], truth if is_put_right else other) < 0.15


def test_a_look_at_a_sure_curve_holds_no_recovery_up(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, other = lens(0.7), lens(-0.7)  # Neither bends less than the other.
    looked: list[int] = []

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        looked.append(field.stamp.frame)
        found = initialize(paint(rig, [truth], 0), rig, seed_on(rig, truth))
        return replace(found, confidence=0.9)

    lost_at = round(0.5 * FPS) + 2
    loses_the_first(monkeypatch, lost_at)
    looks_by(monkeypatch, look)
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, truth))
    fields = [paint(rig, [truth, other], i) for i in range(lost_at + 3)]
    states = [tracker.step(field).states[0] for field in fields]
    assert lost_at - DELAY < looked[1] < lost_at
    assert states[lost_at - 1].status is states[-1].status is Status.TRACKING
    assert any("found again" in state.events for state in states[lost_at:])


def test_doubts_run_with_the_curve(rig: StereoRig) -> None:
    found = initialize(paint(rig, [thread(0.0)], 0), rig, seed_on(rig, thread(0.0)))
    reasons = "first end cut by the image border", "the left view shows the last end further on"
    found = replace(found, reasons=reasons, doubts=(((0.2, 0.5),), ()))
    assert directed(found, found.curve) is found
    turned = directed(found, nurbs.reversed_curve(found.curve))
    assert turned.doubts == (((0.8, 0.5),), ())
    assert turned.reasons == (
        "last end cut by the image border",
        "the left view shows the first end further on",
    )
    np.testing.assert_array_equal(turned.growth.marks, found.growth.marks[::-1])
    np.testing.assert_allclose(turned.curve.control_points, found.curve.control_points[::-1])


@pytest.mark.parametrize(
    ("how", "is_known"), [("the same", True), ("kinked in depth", False), ("elsewhere", False)]
)
def test_what_was_followed_for_sure_is_known_again(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, how: str, is_known: bool
) -> None:
    """However doubtful it looks by itself, but nothing else is."""
    lost_at = 6
    truth = thread(0.0)
    elsewhere, bent = truth + np.array([0.0, 6.0, 0.0]), kinked(truth, 4.0)
    later = {"the same": truth, "kinked in depth": bent, "elsewhere": elsewhere}[how]

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        is_first = field.stamp.frame == 0
        found = initialize(field, rig, seed_on(rig, truth if is_first else later))
        return replace(found, confidence=0.9 if is_first else 0.3)

    loses_the_first(monkeypatch, lost_at)
    looks_by(monkeypatch, look)
    fields = [
        paint(rig, [bent if later is bent and i >= lost_at else truth, elsewhere], i)
        for i in range(12)
    ]
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, truth))
    states = [tracker.step(field).states[0] for field in fields]
    assert states[lost_at - 1].status is Status.TRACKING
    assert any("found again" in state.events for state in states)
    assert rms(states[-1], later) < 0.3
    assert states[-1].status is (Status.TRACKING if is_known else Status.OCCLUDED)


def test_what_was_taken_for_the_thread_since_does_not_tell_its_length_alone(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A strand as long as the thread is held in doubt, and grows; the thread is known by its own length."""
    lost_at, plain_at = 6, 50
    truth = thread(0.0)
    longer = thread(1.0, 140.0, bend=-0.6) + np.array([0.0, 30.0, 0.0])
    grown = [longer[: round(600 * np.clip(88 + i, 100, 125) / 140)] for i in range(90)]

    def look(field: RidgeField, rig: StereoRig, _: Seed, config: object) -> Initialization:
        number = field.stamp.frame
        is_other = lost_at <= number < plain_at
        found = initialize(field, rig, seed_on(rig, grown[number] if is_other else truth))
        return replace(found, confidence=0.3 if is_other else 0.9)

    loses_the_first(monkeypatch, lost_at)
    looks_by(monkeypatch, look)
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, truth))
    states = [
        tracker.step(paint(rig, [truth, other], i)).states[0] for i, other in enumerate(grown)
    ]
    assert states[plain_at].status is Status.OCCLUDED
    assert states[plain_at].length == pytest.approx(polyline_length(grown[-1]), rel=0.01)
    assert rms(states[-1], truth) < 0.1


def test_an_end_that_runs_along_another_thread_leaves_a_look_in_doubt(rig: StereoRig) -> None:
    x = np.linspace(-25, 25, 600)
    points = np.c_[x, 0.01 * x**2, np.full(600, 200.0)]
    field, seed = paint(rig, [points], 0), seed_on(rig, points)
    found = replace(initialize(field, rig, seed), confidence=0.9, doubts=((), ()))

    def strands(other: np.ndarray) -> Neighbours:
        both = views(rig, other, np.gradient(other, axis=0))
        left, right = (Strand.other(view, np.ones(len(other), bool)) for view in both)
        return Neighbours((Neighbour(left, right),))

    def beside(other: np.ndarray) -> Initialization:
        return doubting_ends(found, strands(other), rig)

    along = points[450:] + np.array([0.0, 0.6, 0.0])
    across = np.c_[np.full(600, 24.0), x + 6.0, np.full(600, 200.0)]
    middle = points[200:400]
    above = points[450:] * 0.9
    for other in (across, middle, above):
        assert beside(other).confidence == 0.9
        assert beside(other).doubts == ((), ())
    doubted = beside(along)
    assert doubted.confidence == pytest.approx(0.27)
    for view in doubted.doubts:
        ((place, rest),) = view
        assert rest == 0.3
        end = nurbs.evaluate(doubted.curve, np.array([place]))[0]
        assert np.linalg.norm(end - points[450]) < 1.5
    first = FromSeed(seed, Setup(rig, TrackingConfig(), InitializationConfig()), None)
    for other, left in ((along, 0.27), (points[250:], 0.27), (points, 0.9)):
        assert first.beside(strands(other), found).confidence == pytest.approx(left)


def overlapping(shared: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two threads that meet, and the first of them as it is mistaken to run on along the second."""
    x = np.linspace(-25, 25, 600)
    second = np.c_[x, 0.01 * x**2, np.full(600, 200.0)]
    meet = second[round((1 - shared) * 600)]
    first = meet + np.c_[-x - 25, -0.4 * (x + 25), np.zeros(600)][::-1]
    return first, second, np.r_[first[:-1], second[second[:, 0] >= meet[0]]]


def finds(monkeypatch: pytest.MonkeyPatch, **threads: tuple[np.ndarray, float]) -> None:
    """Looks from the seed of a thread find these points, with such confidence and no doubts."""

    def look(_field: RidgeField, rig: StereoRig, seed: Seed, *_: object) -> Initialization:
        points, confidence = threads[seed.thread]
        start = seed_at(rig, points[len(points) // 4], seed.thread)
        alone = initialize(paint(rig, [points], 0), rig, start)
        return replace(alone, confidence=confidence, doubts=((), ()))

    looks_by(monkeypatch, look)


@pytest.mark.parametrize("shared", [0.25, 0.5])
@pytest.mark.parametrize("names", ["ab", "ba"])
def test_of_threads_found_in_one_field_the_surest_counts(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, names: str, shared: float
) -> None:
    first, second, runs_on = overlapping(shared)
    finds(monkeypatch, a=(runs_on, 0.8), b=(second, 0.9))
    seeds = {"a": seed_on(rig, first, "a"), "b": seed_on(rig, second, "b")}
    tracker = Tracker(rig)
    for name in names:
        tracker.seed(seeds[name])
    states = {s.thread: s for s in tracker.step(paint(rig, [first, second], 0)).states}
    assert states["a"].status is Status.OCCLUDED
    assert states["b"].status is Status.TRACKING


@pytest.mark.parametrize("shared", [0.25, 0.5])
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_of_threads_found_one_after_another_the_surest_counts(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, confidence: float, shared: float
) -> None:
    first, second, runs_on = overlapping(shared)
    finds(monkeypatch, a=(runs_on, confidence), b=(second, 0.9))
    tracker = Tracker(rig)
    tracker.seed(seed_on(rig, first, "a"))
    fields = [paint(rig, [first, second], i) for i in range(DELAY + 4)]
    assert [s.status for s in tracker.step(fields[0]).states] == [Status.TRACKING]
    tracker.seed(seed_on(rig, second, "b"))
    for field in fields[1:]:
        states = {s.thread: s.status for s in tracker.step(field).states}
    is_surer = confidence < 0.9
    assert states["a"] is (Status.OCCLUDED if is_surer else Status.TRACKING)
    assert states["b"] is (Status.TRACKING if is_surer else Status.OCCLUDED)


def test_a_thread_that_is_tracked_takes_no_other_name(rig: StereoRig) -> None:
    points = pair(0)[0]
    tracker = Tracker(rig, TrackingConfig(patience=3))
    fields = [paint(rig, [points], i) for i in range(4 * DELAY)]
    for name in "ab":
        tracker.seed(seed_on(rig, points, name))
    steps = [tracker.step(fields[0])]
    tracker.seed(seed_on(rig, points, "c"))
    steps += [tracker.step(field) for field in fields[1:]]
    for name in "bc":
        (refusal, *_) = (s.initializations[name] for s in steps if name in s.initializations)
        assert isinstance(refusal, InitializationError)
        assert refusal.reason == "that is thread a already"
        assert not tracker.is_sought(name)
    statuses = [state.status for state in steps[-1].states]
    assert statuses == [Status.TRACKING, Status.LOST, Status.LOST]
    assert all(step.states[0].status is Status.TRACKING for step in steps)


def test_a_closer_look_does_not_take_a_thread_that_is_tracked(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However sure it is of that one."""
    seeds = [seed_on(rig, points, name) for name, points in zip("ab", pair(0), strict=True)]

    def look(field: RidgeField, rig: StereoRig, seed: Seed, _: object) -> Initialization:
        is_first = seed.pixel is not None
        which = 0 if seed.thread == "a" or not is_first else 1
        found = initialize(field, rig, seed_on(rig, pair(field.stamp.frame)[which]))
        return replace(found, confidence=1.0 if not is_first else (0.1, 0.8)[seed.thread == "a"])

    looks_by(monkeypatch, look)
    tracker = Tracker(rig)
    for seed in seeds:
        tracker.seed(seed)
    for field in fields_of(rig, 2 * FPS, range(0)):
        states = {state.thread: state for state in tracker.step(field).states}
    for name, points, status in zip("ab", pair(2 * FPS - 1), ("TRACKING", "OCCLUDED"), strict=True):
        assert states[name].status is Status[status]
        assert rms(states[name], points) < 0.2


@pytest.mark.parametrize("away_px", [2, 6, 15])
def test_a_thread_is_seeded_near_where_it_crosses_a_tracked_one(
    rig: StereoRig, away_px: int
) -> None:
    x = np.linspace(-25, 25, 600)
    first = np.c_[x, 0.01 * x**2, np.full(600, 200.0)]
    second = np.c_[0.02 * x**2 - 3, x, np.full(600, 196.0)]
    tracker = Tracker(rig)
    fields = [paint(rig, [first, second], i) for i in range(DELAY + 4)]
    tracker.seed(seed_on(rig, first[:100], "a"))
    tracker.step(fields[0])
    pixels = rig.project_raw(second)[0]
    away = np.abs(np.hypot(*(pixels - pixels[len(x) // 2]).T) - away_px)
    tracker.seed(seed_at(rig, second[np.argmin(away)], "b"))
    for field in fields[1:]:
        states = tracker.step(field).states
    assert [state.status for state in states] == [Status.TRACKING] * 2
    assert rms(states[1], second) < 0.15

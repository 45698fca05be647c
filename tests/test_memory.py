"""Where the thread was of late, which tells when the curve follows something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_distances
from suturetrack.tracking import Tracker
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.memory import Memory
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import NOBODY, Neighbour, Neighbours, Strand
from suturetrack.types import Status
from tests.painting import FPS, curve_through, paint, seed_on

T = np.linspace(-1, 1, 400)
KNOWN = KnownLength(60.0)
SOON_NS = 100_000_000


def line(bulge: float) -> np.ndarray:
    """(400, 3) points, 200 away, of nearly one length: 4 px to a unit, with a bulge in the middle third."""
    arc = bulge * np.cos(1.5 * np.pi * np.clip(T, -1 / 3, 1 / 3)) ** 2
    return np.c_[arc + 3 * T**2, 30 * T, np.full(400, 200.0)]


def moved(points: np.ndarray) -> np.ndarray:
    """The points somewhat elsewhere and turned."""
    turn = np.radians(12)
    spun = points[:, :2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    return np.c_[spun, points[:, 2]] + np.array([6.0, -3.0, 4.0])


def learned(*threads: np.ndarray) -> Memory:
    memory = Memory()
    for k, points in enumerate(threads):
        memory = memory.learned(
            curve_through(points), replace(KNOWN, now=60.0 + k), 500_000_000 * k
        )
    return memory


def images(rig: StereoRig, *shown: np.ndarray, frame: int = 60) -> Images:
    return Images(paint(rig, shown, frame), rig, (0.8, 0.8))


def off_px(rig: StereoRig, curve: nurbs.Nurbs, points: np.ndarray) -> float:
    """How far the curve is from the points somewhere in the left view."""
    found = rig.project(nurbs.evaluate(curve, (T + 1) / 2))[0]
    return float(polyline_distances(found, rig.project(points)[0]).max())


def test_the_thread_shows_where_it_was_while_the_curve_follows_something_else(
    rig: StereoRig,
) -> None:
    thread, dragged = line(0.0), line(5.0)
    shown = images(rig, thread, dragged)
    _, before = learned(thread).step(curve_through(dragged), shown, NOBODY)
    assert before is not None
    assert off_px(rig, before[0], thread) < 1.5
    assert before[1].now == 60.0


def test_the_thread_is_looked_for_where_the_rest_of_it_has_gone(rig: StereoRig) -> None:
    thread, dragged = moved(line(0.0)), moved(line(5.0))
    shown = images(rig, thread, dragged)
    _, before = learned(line(0.0)).step(curve_through(dragged), shown, NOBODY)
    assert before is not None
    assert off_px(rig, before[0], thread) < 2.5


def test_a_thread_that_has_moved_there_is_left_alone(rig: StereoRig) -> None:
    dragged = line(5.0)
    memory = learned(line(0.0))
    after, before = memory.step(curve_through(dragged), images(rig, dragged), NOBODY)
    assert before is None
    assert after.known == memory.known


def test_what_shows_for_a_little_way_only_is_not_the_thread(rig: StereoRig) -> None:
    dragged = line(5.0)
    stub = line(0.0)[190:210]
    shown = images(rig, stub, dragged)
    assert learned(line(0.0)).step(curve_through(dragged), shown, NOBODY)[1] is None


def test_another_thread_where_the_thread_was_is_not_the_thread(rig: StereoRig) -> None:
    thread, dragged = line(0.0), line(5.0)
    left, right = views(rig, thread, np.gradient(thread, axis=0))
    seen = np.ones(len(thread), bool)
    others = Neighbours((Neighbour(Strand.other(left, seen), Strand.other(right, seen)),))
    shown = images(rig, thread, dragged)
    assert learned(thread).step(curve_through(dragged), shown, others)[1] is None


def test_what_was_learned_since_is_forgotten(rig: StereoRig) -> None:
    thread, astray, dragged = line(0.0), line(4.5), line(5.0)
    shown = images(rig, thread, dragged)
    memory, before = learned(thread, astray).step(curve_through(dragged), shown, NOBODY)
    assert before is not None
    assert before[1].now == 60.0
    assert len(memory.known) == 1


def test_the_thread_is_looked_for_every_now_and_then(rig: StereoRig) -> None:
    thread, dragged = line(0.0), line(5.0)
    nothing, both = images(rig, dragged, frame=60), images(rig, thread, dragged, frame=61)
    memory, _ = learned(thread).step(curve_through(dragged), nothing, NOBODY)
    assert memory.step(curve_through(dragged), both, NOBODY) == (memory, None)


def test_a_curve_of_another_length_is_another_matter(rig: StereoRig) -> None:
    thread, dragged = line(0.0), line(5.0)
    shown = images(rig, thread, dragged)
    assert learned(thread).step(curve_through(dragged[:340]), shown, NOBODY)[1] is None


@pytest.mark.parametrize("shows_again", [True, False])
def test_what_the_edge_of_a_tool_has_taken_along_is_taken_back(
    rig: StereoRig, shows_again: bool
) -> None:
    """The edge hides the thread that it moves over; where it has gone, the thread shows again."""
    thread, tracker = line(0.0), Tracker(rig)
    tracker.seed(seed_on(rig, thread))
    states = []
    for i in range(3 * FPS):
        bulge = 5.0 * max(i / FPS - 1, 0) / 2
        shown = [thread] if bulge > 4.0 and shows_again else []
        # What comes over the thread hides it for a moment.
        shown += [] if i == FPS else [line(bulge)]
        states.append(tracker.step(paint(rig, shown, i)).states[0])
    taken_back = [i for i, s in enumerate(states) if "taken back" in s.events]
    truth, curve = thread if shows_again else line(5.0), states[-1].curve
    assert curve is not None
    assert bool(taken_back) == shows_again
    assert off_px(rig, curve, truth) < 2
    # Once the edge is gone, it is as sure as before.
    for i in range(3 * FPS, 5 * FPS):
        state = tracker.step(paint(rig, [truth], i)).states[0]
    assert state.status is Status.TRACKING

"""Ridges that branch off a curve and move, which shows that it follows something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError, initialize
from suturetrack.tracking import Tracker
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import views
from suturetrack.tracking.strands import NOBODY, Neighbour, Neighbours, Strand
from suturetrack.tracking.strangers import Strangers
from suturetrack.tracking.sureness import Sureness
from suturetrack.types import RidgeField, Status
from tests.painting import FPS, curve_through, paint, seed_at

LEVELS = (0.8, 0.8)
SECONDS = 2.0
T = np.linspace(-1, 1, 400)


def line(bulge: float = 0.0) -> np.ndarray:
    """(400, 3) points, 200 away: straight at both ends, with a bulge between."""
    arc = bulge * np.cos(0.75 * np.pi * np.clip(T, -2 / 3, 2 / 3)) ** 2
    return np.c_[arc, 30 * T, np.full(400, 200.0)]


def fields(rig: StereoRig, *motions: tuple[float, float]) -> list[RidgeField]:
    """Lines whose bulges go from the first to the second value."""
    count = round(SECONDS * FPS)
    return [
        paint(rig, [line(a + (b - a) * i / count) for a, b in motions], i)
        for i in range(0, count, 3)
    ]


def found(
    rig: StereoRig, followed: list[np.ndarray], shown: list[RidgeField], others: Neighbours = NOBODY
) -> list[bool]:
    strangers, flags = Strangers(), []
    for points, field in zip(followed, shown, strict=True):
        curve = curve_through(points)
        strangers = strangers.step(curve, np.ones(64, bool), Images(field, rig, LEVELS), others)
        flags.append(strangers.is_found)
    return flags


def test_a_thread_that_parts_from_what_is_followed_is_found(rig: StereoRig) -> None:
    shown = fields(rig, (0.0, 0.0), (0.0, 6.0))
    flags = found(rig, [line()] * len(shown), shown)
    assert not any(flags[:6])
    assert all(flags[-4:])


def test_what_has_always_branched_off_is_no_stranger(rig: StereoRig) -> None:
    shown = fields(rig, (0.0, 0.0), (6.0, 6.0))
    assert not any(found(rig, [line()] * len(shown), shown))


def test_a_ridge_that_the_thread_leaves_where_it_was_is_no_stranger(rig: StereoRig) -> None:
    shown = fields(rig, (0.0, 0.0), (0.0, 6.0))
    followed = [line(6.0 * i / len(shown)) for i in range(len(shown))]
    assert not any(found(rig, followed, shown))


def test_what_one_view_shows_alone_is_no_stranger(rig: StereoRig) -> None:
    still, shown = fields(rig, (0.0, 0.0)), fields(rig, (0.0, 0.0), (0.0, 6.0))
    half = [replace(a, right=b.right) for a, b in zip(shown, still, strict=True)]
    assert not any(found(rig, [line()] * len(half), half))


def test_another_thread_that_is_held_is_no_stranger(rig: StereoRig) -> None:
    shown = fields(rig, (0.0, 0.0), (0.0, 6.0))
    strangers, seen = Strangers(), np.ones(400, bool)
    for i, field in enumerate(shown):
        other = line(6.0 * 3 * i / round(SECONDS * FPS))
        left, right = views(rig, other, np.gradient(other, axis=0))
        others = Neighbours((Neighbour(Strand.other(left, seen), Strand.other(right, seen)),))
        curve = curve_through(line())
        strangers = strangers.step(curve, np.ones(64, bool), Images(field, rig, LEVELS), others)
        assert not strangers.is_found


def test_a_curve_that_the_thread_has_left_is_not_called_tracking(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However sure its first look was, while no other finds the thread."""
    shown = fields(rig, (0.0, 0.0), (3.0, 7.0))
    seed = seed_at(rig, line()[200])
    first = initialize(paint(rig, [line()], 0), rig, seed)
    looks = iter([replace(first, confidence=0.9)])

    def look(*_: object) -> Initialization:
        if (found := next(looks, None)) is not None:
            return found
        raise InitializationError("nothing there", np.empty((0, 2)))

    monkeypatch.setattr("suturetrack.tracking.recovery.initialize", look)
    tracker = Tracker(rig)
    tracker.seed(seed)
    states = [tracker.step(field).states[0] for field in shown]
    curve = states[-1].curve
    assert curve is not None
    assert np.ptp(nurbs.evaluate(curve, (T + 1) / 2)[:, 0]) < 0.5
    statuses = [state.status for state in states]
    assert statuses[1] is Status.TRACKING
    assert Status.TRACKING not in statuses[-4:]


def test_what_branched_off_a_curve_says_nothing_of_the_one_that_takes_its_place(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = fields(rig, (0.0, 0.0), (1.0, 4.5))
    seed = seed_at(rig, line()[200])
    first = replace(initialize(paint(rig, [line()], 0), rig, seed), confidence=0.9)
    looks: list[RidgeField] = []

    def look(field: RidgeField, *_: object) -> Initialization:
        looks.append(field)
        bulge = 1.0 + 3.5 * field.stamp.frame / round(SECONDS * FPS)
        return first if len(looks) == 1 else replace(first, curve=curve_through(line(bulge)))

    monkeypatch.setattr("suturetrack.tracking.recovery.initialize", look)
    # No look puts the curve right before it is revoked.
    monkeypatch.setattr(Sureness, "outweighs", lambda *_, **__: False)
    tracker = Tracker(rig)
    tracker.seed(seed)
    states = [tracker.step(field).states[0] for field in shown]
    (place,) = [i for i, state in enumerate(states) if "found for sure" in state.events]
    assert states[place - 1].status is Status.OCCLUDED
    assert states[place].status is Status.TRACKING


def test_what_moves_across_the_curve_is_no_stranger(rig: StereoRig) -> None:
    across = [np.c_[20 * T, 6 * T + i / 2, np.full(400, 200.0)] for i in range(20)]
    shown = [paint(rig, [line(), other], 3 * i) for i, other in enumerate(across)]
    assert not any(found(rig, [line()] * len(shown), shown))


@pytest.mark.parametrize(("radius", "is_stranger"), [(3.0, False), (8.0, True)])
def test_the_loop_of_a_tight_knot_is_no_stranger_but_a_wide_one_is(
    rig: StereoRig, radius: float, is_stranger: bool
) -> None:
    """A curve passes a tight knot as a point; the knot slides along the line."""
    turn = np.linspace(0, 2 * np.pi, 200)
    loop = np.c_[radius * (1 - np.cos(turn)), radius * np.sin(turn), np.full(200, 200.0)]
    loops = [loop + np.array([0, i / 2, 0]) for i in range(20)]
    shown = [paint(rig, [line(), loop], 3 * i) for i, loop in enumerate(loops)]
    assert any(found(rig, [line()] * len(shown), shown)) == is_stranger

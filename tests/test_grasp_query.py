"""The pose at which to take a thread, asked over the bus."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from services import topics
from services.bus import Bus
from services.grasping import GraspDesk
from services.memory_transport import Hub
from services.messages import GraspReply, GraspRequest
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.grasping import GraspPoint
from suturetrack.types import Energies, Nurbs, Stamp, Status, ThreadState
from tests.conftest import wait_until

PERIOD_NS = 33_333_333


def now() -> Stamp:
    return Stamp(3, 99, time.time_ns(), PERIOD_NS)


@pytest.fixture
def state(curve: Nurbs) -> ThreadState:
    """In millimetres."""
    return ThreadState(
        Stamp(3, 99, 0),
        "0",
        Status.TRACKING,
        curve,
        nurbs.length(curve),
        Energies(),
        np.full(64, 0.2),
        np.ones(64, bool),
    )


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    hub = Hub()
    tracker, robot = (Bus(hub.connect(), "rig", name) for name in ("tracker", "robot"))
    yield tracker, robot
    tracker.close()
    robot.close()


def ask(robot: Bus, thread: str = "0", **where: object) -> GraspReply:
    point = GraspPoint(**where)  # type: ignore[arg-type]
    return robot.ask(topics.GRASP, GraspRequest(thread, point), timeout=10)


def test_the_answer_is_in_metres(
    buses: tuple[Bus, Bus], rig: StereoRig, state: ThreadState, curve: Nurbs
) -> None:
    desk = GraspDesk(buses[0], rig)
    stamp = replace(now(), released_ns=time.time_ns() + PERIOD_NS // 2)
    desk.update([replace(state, stamp=stamp)])
    start = curve.control_points[0] / 1000
    for where in ({"from_start": 0.0}, {"fraction": 0.0}, {"near": tuple(start.tolist())}):
        desk.update([replace(state, stamp=now())])
        reply = ask(buses[1], **where)
        assert reply.grasp is not None, reply.reason
        np.testing.assert_allclose(reply.grasp.position, start, atol=1e-9)
        assert reply.grasp.sigma == pytest.approx(0.0002)
    desk.update([replace(state, stamp=stamp)])
    inside = ask(buses[1], from_end=0.01)
    assert inside.grasp is not None
    assert inside.grasp.stamp == stamp
    beyond = np.linalg.norm(inside.grasp.position - curve.control_points[-1] / 1000)
    assert 0.006 < beyond < 0.01001


def test_refusals_tell_why(buses: tuple[Bus, Bus], rig: StereoRig, state: ThreadState) -> None:
    desk = GraspDesk(buses[0], rig)
    assert "seed one first" in ask(buses[1], fraction=0.5).reason
    hidden = replace(state, thread="b", seen=np.zeros(64, bool), status=Status.OCCLUDED)
    lost = replace(state, thread="c", status=Status.LOST)
    old = replace(state, thread="d", stamp=replace(now(), released_ns=time.time_ns() - 10**8))
    desk.update([replace(s, stamp=now()) for s in (state, hidden, lost)] + [old])
    assert "no thread 'x'; there is 0, b, c, d" in ask(buses[1], "x", fraction=0.5).reason
    assert "not seen at 50 %" in ask(buses[1], "b", fraction=0.5).reason
    assert "lost" in ask(buses[1], "c", fraction=0.5).reason
    assert "stale" in ask(buses[1], "d", fraction=0.5).reason
    desk.update([replace(state, stamp=now())])
    assert "off the thread" in ask(buses[1], from_start=9.0).reason


def test_a_state_goes_stale_when_no_field_comes_any_more(
    buses: tuple[Bus, Bus], rig: StereoRig, state: ThreadState
) -> None:
    desk = GraspDesk(buses[0], rig)
    desk.update([replace(state, stamp=now())])
    wait_until(lambda: ask(buses[1], fraction=0.5).reason, 10)
    assert "stale" in ask(buses[1], fraction=0.5).reason

"""What a run tells of itself at its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from services import topics
from services.bus import Bus
from services.memory_transport import Hub
from services.messages import Latency
from services.monitor import Monitor
from services.tables import number
from suturetrack.tracking.thread import not_found
from suturetrack.types import Nurbs, Stamp, Status, Truth
from tests.test_doctor import HEALTHY


def test_errors_have_signs() -> None:
    assert [number(x, 2, signed=True) for x in (0.5, -0.5, np.nan)] == ["+0.50", "-0.50", "-"]


def test_what_nothing_was_measured_of_has_no_figures(curve: Nurbs) -> None:
    hub = Hub()
    here, there = (Bus(hub.connect(), "rig", name) for name in ("run", "tracker"))
    monitor = Monitor(here)
    points, stamp = np.zeros((2, 3)), Stamp(0, 0, 0)
    lost = not_found("lost", stamp, ())
    held = replace(lost, thread="held", status=Status.TRACKING, curve=curve, length=0.1)
    there.publish(topics.TRUTH, Truth(stamp, "held", points, 0.2, np.ones(2, bool)))
    for state in (lost, held):
        there.publish(topics.STATE, state)
    idle = replace(HEALTHY, process="tracker", frames=0, run_rate_hz=0.0, run_latency=Latency())
    there.publish(topics.HEALTH, idle)
    monitor.listen()
    threads, processes = (
        [list(row) for row in zip(*(column.cells for column in table.columns), strict=True)]
        for table in monitor.tables()
    )
    assert threads[0][-4:] == ["-", "-", "-", "-"]
    assert threads[1][-4:] == ["100.00", "0.00", "200.00", "-50.00"]
    assert processes[0][1:6] == ["0", "-", "-", "-", "-"]
    for bus in (here, there):
        bus.close()


def test_what_those_pass_over_who_only_watch_is_not_dropped() -> None:
    hub = Hub()
    here, there = (Bus(hub.connect(), "rig", name) for name in ("run", "all"))
    monitor = Monitor(here)
    for process, dropped in (("segmenter", 2), ("tracker", 1), ("console", 1000)):
        there.publish(topics.HEALTH, replace(HEALTHY, process=process, dropped=dropped))
    monitor.listen()
    assert " · dropped 3" in monitor.line()
    for bus in (here, there):
        bus.close()

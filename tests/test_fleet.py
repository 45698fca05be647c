"""How a run ends whose processes do not all end well."""

from __future__ import annotations

from services.fleet import Fleet, Launch
from services.pulse import Pulse
from tests.conftest import wait_until


def test_a_run_whose_process_died_for_good_does_not_end_well() -> None:
    """The source ends as it should, while the tracker dies again and again before it is ready."""
    launches = [Launch("source", ("--help",)), Launch("tracker", ("--no-such-option",))]
    said: list[str] = []
    fleet = Fleet(launches, said.append, 5, Pulse())
    try:
        wait_until(lambda: not fleet.tend() and any("is started again" in s for s in said), 120)
    finally:
        fleet.stop()
    complaint = fleet.complaint()
    assert complaint is not None
    assert complaint.startswith("the tracker")

"""How a run ends whose processes do not all end well."""

from __future__ import annotations

from services.fleet import Fleet, Launch
from services.pulse import Pulse
from tests.conftest import wait_until


def ended(launches: list[Launch], until: str = "") -> tuple[str | None, list[str]]:
    """The complaint of a run that has ended and said so, and all that it said."""
    said: list[str] = []
    fleet = Fleet(launches, said.append, 5, Pulse())
    try:
        wait_until(lambda: not fleet.tend() and any(until in s for s in [*said, ""]), 120)
    finally:
        fleet.stop()
    return fleet.complaint(), said


def test_a_run_whose_process_died_for_good_does_not_end_well() -> None:
    """The source ends as it should, while another process dies again and again before it is ready."""
    launches = [Launch("source", ("--help",)), Launch("nobody", ())]
    complaint, _ = ended(launches, "is started again")
    assert complaint is not None
    assert complaint.startswith("the nobody")


def test_a_process_whose_options_are_wrong_is_not_started_again() -> None:
    complaint, said = ended([Launch("tracker", ("--no-such-option",))])
    assert complaint is not None
    assert "unrecognized options: --no-such-option" in complaint
    assert not any("is started again" in s for s in said)

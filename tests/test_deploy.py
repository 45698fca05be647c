"""The units and configurations that are handed out fit the program."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path

import pytest
import tyro

from services.access import ROLES
from services.cli import VERBS
from services.service import HEARTBEAT_S
from services.zenoh_transport import load_config

DEPLOY = Path(__file__).parents[1] / "services" / "deploy"
OPTIONS = {
    "source": ["--source", "0,1", "--calibration", "rig.yaml"],
    "tooltip": ["--hand-eye", "hand_eye.yaml"],
}
ALONE = ("run", "client")
"""Who connects to a rig without being a verb that a unit starts."""


def started_by(unit: str) -> list[str]:
    """The words of the command after the program's path."""
    (line,) = [
        line for line in (DEPLOY / unit).read_text().splitlines() if line.startswith("ExecStart=")
    ]
    return shlex.split(line)[1:]


@pytest.mark.parametrize(
    "process",
    ["record", *(p for role in ROLES.values() for p in role.processes if p not in ALONE)],
)
def test_the_unit_of_a_process_starts_it_to_go_on_where_the_last_one_left_off(process: str) -> None:
    words = [word.replace("%i", process) for word in started_by("suturetrack@.service")]
    assert words[0] == process
    assert words[-1] == "$OPTIONS"
    verb = VERBS[process]
    kind = getattr(importlib.import_module(verb.module), verb.config)
    config = tyro.cli(kind, args=[*words[1:-1], *OPTIONS.get(process, [])])
    service = getattr(config, "service", config)
    assert service.zenoh == Path(f"/etc/suturetrack/{process}.json5")
    assert service.resume == 1


def test_the_unit_of_a_process_waits_for_heartbeats() -> None:
    lines = (DEPLOY / "suturetrack@.service").read_text().splitlines()
    settings = dict(line.split("=", 1) for line in lines if "=" in line and line[0] != "#")
    assert settings["Type"] == "notify"
    assert settings["Restart"] == "always"
    assert float(settings["WatchdogSec"]) > 5 * HEARTBEAT_S
    assert float(settings["TimeoutStartSec"]) > 30


def test_the_unit_of_the_router_starts_it() -> None:
    assert started_by("suturetrack-router.service") == [
        *("router", "--zenoh", "/etc/suturetrack/router.json5")
    ]
    assert "router" in VERBS


@pytest.mark.parametrize("path", sorted(DEPLOY.glob("*.json5")), ids=lambda path: path.stem)
def test_configurations_are_whole(path: Path) -> None:
    config = load_config(path)
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("mode") == ('"router"' if path.stem == "router" else '"client"')

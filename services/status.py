"""`suturetrack status`: rigs, processes and threads, live in the terminal."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services import topics
from services.bus import Bus
from services.checks import check_rig
from services.client import Client, Seen
from services.messages import Health
from services.tables import new_table, number, report_console
from services.zenoh_transport import ZenohTransport, load_config, local_config, local_rigs
from suturetrack.types import InputError, Status

_LOOK_S = 0.25
_FIRST_S = 1.5
"""How long a single look listens: every process tells of itself once a second."""
_SILENT_S = 2.5


@dataclass(frozen=True)
class StatusConfig:
    """Shows every rig that runs: its processes, their rates and latencies, and its threads."""

    rig: str | None = None
    """Name of the rig; every rig of this user on this machine without it."""
    zenoh: Path | None = None
    """The Zenoh configuration file of a rig on other machines; needs --rig."""
    once: bool = False
    """Looks once and ends, with status 1 when nothing runs; as it does where no terminal shows it live."""


class RigWatch:
    """What is heard of one rig."""

    def __init__(self, rig: str, zenoh: Path | None, *, waits: bool = True):
        check_rig(rig)
        config = local_config(rig, "status") if zenoh is None else load_config(zenoh)
        self.rig = rig
        self.health: dict[str, tuple[Health, int]] = {}
        """By process: its last heartbeat, and when it arrived by the wall clock, ns."""
        self.bus = Bus(ZenohTransport(config, waits=waits), rig, "status")
        self._client = Client(self.bus)
        self._healths = self.bus.every(topics.HEALTH)

    def listen(self) -> None:
        """Takes in what has arrived."""
        while (health := self._healths.get(0)) is not None:
            late_ns = time.monotonic_ns() - self._healths.arrived_ns
            self.health[health.process] = health, time.time_ns() - late_ns

    @property
    def threads(self) -> dict[str, Seen]:
        """By thread: its last state."""
        latest = {name: self._client.latest(name) for name in self._client.threads}
        return {name: seen for name, seen in latest.items() if seen is not None}

    @property
    def unheard(self) -> list[str]:
        """The processes that every rig needs and of which nothing was heard."""
        return [name for name in topics.PROCESSES if name not in self.health]

    def tables(self) -> list[Table]:
        """The processes, and the threads where there are any."""
        if not self.health:
            return []
        return [self._processes(), self._threads()] if self.threads else [self._processes()]

    def _processes(self) -> Table:
        columns = ("frames", "Hz", "p50 ms", "p99 ms", "dropped", "refused", "MB", "")
        table = new_table(f"Rig {self.rig}", "process", *columns)
        for name, (health, arrived_ns) in sorted(self.health.items()):
            silent_s = (time.time_ns() - arrived_ns) / 1e9
            notes = [health.warning] if health.warning else []
            notes += [f"started again {health.restarts}x"] if health.restarts else []
            notes += [f"silent for {silent_s:.0f} s"] if silent_s > _SILENT_S else []
            table.add_row(
                name,
                str(health.frames),
                number(health.rate_hz, 1),
                number(health.latency.p50_ms, 1),
                number(health.latency.p99_ms, 1),
                str(health.dropped),
                str(health.refused),
                number(health.memory_mb, 0),
                Text("; ".join(notes), style="yellow"),
            )
        for name in self.unheard:
            table.add_row(name, *[""] * (len(columns) - 1), Text("not heard of", style="red"))
        return table

    def _threads(self) -> Table:
        table = new_table("Threads", "thread", "status", "live", "length mm", "seen %", "frame")
        for name, seen in sorted(self.threads.items()):
            state, good = seen.state, seen.state.status is Status.TRACKING
            table.add_row(
                name,
                Text(str(state.status), style="green" if good else "red"),
                Text("yes") if seen.live else Text(seen.reason, style="red"),
                number(1000 * state.length, 1),
                number(100 * float(state.seen.mean()) if len(state.seen) else 0.0, 0),
                str(state.stamp.frame),
            )
        return table

    def close(self) -> None:
        """Ends the connection."""
        self.bus.close()


def run(config: StatusConfig) -> None:
    """Shows the table until Ctrl-C; raises InputError."""
    if config.zenoh is not None and config.rig is None:
        raise InputError("--zenoh needs --rig, the name of the rig behind it")
    console = report_console()
    config = replace(config, once=config.once or not console.is_terminal)
    watches: dict[str, RigWatch] = {}
    try:
        if config.once:
            _look(config, watches, _FIRST_S)
            shown = _tables(watches)
            if not shown:
                raise InputError(nothing_runs(config.rig))
            console.print(*shown)
            return
        with Live(console=console, refresh_per_second=4) as live, suppress(KeyboardInterrupt):
            while True:
                _look(config, watches, _LOOK_S)
                shown = _tables(watches)
                live.update(Group(*shown) if shown else Text(nothing_runs(config.rig)))
    finally:
        for watch in watches.values():
            watch.close()


def watch_rigs(rig: str | None, zenoh: Path | None, seconds: float) -> dict[str, RigWatch]:
    """What is heard of one rig, or of all on this machine, within some time; to be closed."""
    watches: dict[str, RigWatch] = {}
    _look(StatusConfig(rig, zenoh, once=True), watches, seconds)
    return watches


def nothing_runs(rig: str | None) -> str:
    """What to say when nothing was heard of a rig, or of any on this machine."""
    where = "on this machine" if rig is None else f"of rig {rig!r}"
    others = ", ".join(name for name in local_rigs() if name != rig)
    instead = f", or name a rig that is here: {others}" if others else ""
    start = "start some with `suturetrack demo` or `suturetrack run`"
    return f"no process {where} runs; {start}{instead}"


def _look(config: StatusConfig, watches: dict[str, RigWatch], seconds: float) -> None:
    for rig in local_rigs() if config.rig is None else [config.rig]:
        if rig not in watches:
            watches[rig] = RigWatch(rig, config.zenoh, waits=not config.once)
    time.sleep(seconds)
    for watch in watches.values():
        watch.listen()


def _tables(watches: dict[str, RigWatch]) -> list[Table]:
    return [table for watch in watches.values() for table in watch.tables()]

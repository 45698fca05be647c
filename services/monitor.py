"""What a run looks like from outside: one live line, and a table at the end."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from rich.table import Table

from services import topics
from services.bus import Bus
from services.messages import Health
from services.pulse import Pulse
from services.tables import number
from suturetrack.types import Status, ThreadState, Truth

_STALE_S = 3.0


@dataclass
class _Thread:
    """What was heard of one thread."""

    last: ThreadState
    statuses: dict[Status, int] = field(default_factory=lambda: dict.fromkeys(Status, 0))
    lengths_mm: list[float] = field(default_factory=list)
    true_mm: list[float] = field(default_factory=list)


class Monitor:
    """Listens to states, truths and heartbeats of a rig."""

    def __init__(self, bus: Bus):
        self.pulse = Pulse()
        self._states = bus.every(topics.STATE)
        self._truths = bus.every(topics.TRUTH)
        self._healths = bus.every(topics.HEALTH)
        self._health: dict[str, Health] = {}
        self._lives: dict[tuple[str, int], Health] = {}
        """The last heartbeat of each life of each process: counts begin anew with a new one."""
        self._threads: dict[str, _Thread] = {}
        self._true_mm: dict[str, float] = {}

    def listen(self) -> None:
        """Takes in what has arrived."""
        while (truth := self._truths.get(0)) is not None:
            self._take_truth(truth)
        while (state := self._states.get(0)) is not None:
            self._take_state(state)
        while (health := self._healths.get(0)) is not None:
            self._health[health.process] = health
            self._lives[health.process, health.restarts] = health
            self.pulse.hear(health)

    def line(self) -> str:
        """The run at a glance."""
        if not self._health:
            return "waiting for source, segmenter and tracker"
        parts = [
            f"{name} {health.rate_hz:.1f} Hz{_trouble(health)}" for name, health in self._in_order()
        ]
        tracker = self._health.get("tracker")
        if tracker is not None:
            parts.append(f"latency {tracker.latency.p50_ms:.0f}/{tracker.latency.p99_ms:.0f} ms")
        # Those who only watch pass frames over as they like.
        parts.append(f"dropped {sum(self._total(name, 'dropped') for name in topics.PROCESSES)}")
        for name, thread in self._threads.items():
            length = thread.last.length * 1000
            known = "" if np.isnan(length) else f" {length:.1f} mm"
            parts.append(f"thread {name} {thread.last.status}{known}")
        return " · ".join(parts + self.warnings())

    def warnings(self) -> list[str]:
        """What is wrong, as the processes told it last."""
        return [f"{name}: {h.warning}" for name, h in self._in_order() if h.warning]

    def tables(self) -> list[Table]:
        """How the run went: the threads, and the processes."""
        tables = [self._thread_table()] if self._threads else []
        return [*tables, self._process_table()] if self._health else tables

    def _take_truth(self, truth: Truth) -> None:
        self._true_mm[truth.thread] = truth.length * 1000

    def _take_state(self, state: ThreadState) -> None:
        thread = self._threads.setdefault(state.thread, _Thread(state))
        thread.last = state
        thread.statuses[state.status] += 1
        if state.status is Status.TRACKING:
            thread.lengths_mm.append(state.length * 1000)
            if state.thread in self._true_mm:
                thread.true_mm.append(self._true_mm[state.thread])

    def _in_order(self) -> list[tuple[str, Health]]:
        order = topics.PROCESSES
        names = sorted(self._health, key=lambda n: (order.index(n) if n in order else 9, n))
        return [(name, self._health[name]) for name in names]

    def _total(self, process: str, count: str) -> int:
        """Of all lives of a process."""
        return sum(getattr(h, count) for (name, _), h in self._lives.items() if name == process)

    def _frames(self) -> int:
        seen = max((sum(t.statuses.values()) for t in self._threads.values()), default=0)
        return max(seen, self._total("source", "frames") + self._total("source", "dropped"))

    def _thread_table(self) -> Table:
        table = Table(title=f"Threads, of {self._frames()} frames", title_justify="left")
        for column in ("thread", "tracking %", "occluded %", "lost %", "length mm", "sigma mm"):
            table.add_column(column, justify="right")
        with_truth = any(thread.true_mm for thread in self._threads.values())
        for column in ("true mm", "error %") if with_truth else ():
            table.add_column(column, justify="right")
        for name, thread in self._threads.items():
            shares = [100 * thread.statuses[s] / max(1, self._frames()) for s in Status]
            mean, sigma = _mean_and_sigma(thread.lengths_mm)
            cells = [name, *(f"{s:.1f}" for s in shares), number(mean, 2), number(sigma, 2)]
            if with_truth:
                true, _ = _mean_and_sigma(thread.true_mm)
                cells += [number(true, 2), number(100 * (mean - true) / true, 2, signed=True)]
            table.add_row(*cells)
        return table

    def _process_table(self) -> Table:
        table = Table(title="Processes; latency from the release of a frame", title_justify="left")
        columns = ("process", "frames", "rate Hz", "p50 ms", "p99 ms", "max ms", "dropped")
        for column in (*columns, "refused", "memory MB"):
            table.add_column(column, justify="right")
        for name, health in self._in_order():
            latency = health.run_latency
            figures = latency.p50_ms, latency.p99_ms, latency.max_ms
            table.add_row(
                name,
                str(self._total(name, "frames")),
                number(health.run_rate_hz if health.frames > 1 else np.nan, 2),
                *(number(ms if health.frames else np.nan, 1) for ms in figures),
                str(self._total(name, "dropped")),
                str(self._total(name, "refused")),
                f"{health.memory_mb:.0f}",
            )
        return table


def _trouble(health: Health) -> str:
    again = f" (started again {health.restarts}x)" if health.restarts else ""
    return again + (" (silent)" if _is_stale(health) else "")


def _is_stale(health: Health) -> bool:
    return time.time_ns() - health.time_ns > _STALE_S * 1e9


def _mean_and_sigma(values: list[float]) -> tuple[float, float]:
    return (float(np.mean(values)), float(np.std(values))) if values else (np.nan, np.nan)

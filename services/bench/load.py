"""`suturetrack bench load`: how much a machine takes: rates, gaps, delays, memory, slow consumers."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from rich.console import Console
from rich.progress import Progress

from services import topics
from services.bench import report
from services.bench.system import System, film, private_folder, rig_name
from services.client import Seen
from services.messages import Health

Measure = Callable[[str, float, float], "Row"]

BESIDE = "beside slow consumers"
_FRAMES = 30
"""Of the film that is shown there and back."""
_FIRST_SECONDS = 5.0
"""Left out of the figures: caches fill, and the film is read."""
_LEAST_FOR_GROWTH_S = 30.0
_SUSTAINED = 0.99
"""Share of the frames asked for that has to be answered by a state."""
_SLOW_CONSUMER = """
import sys, time
from services import topics
from services.bus import Bus
from services.zenoh_transport import ZenohTransport, local_config
bus = Bus(ZenohTransport(local_config(sys.argv[1], "slow")), sys.argv[1], "slow")
readers = [bus.newest(topics.FRAME), bus.newest(topics.FIELD), bus.every(topics.STATE)]
print("ready", flush=True)
while True:
    [reader.get(0) for reader in readers]
    time.sleep(0.5)
"""


@dataclass(frozen=True)
class LoadBench:
    """What this machine takes with recording on, and what happens beyond."""

    fps: float = 30.0
    """Frames a second of the soak."""
    seconds: float = 20.0
    """Length of the soak; 600 shows whether memory grows."""
    search: bool = True
    """Look for the highest sustainable rate too, and flood at twice that."""
    trial_seconds: float = 10.0
    """Length of each trial of the search."""
    highest: float = 240.0
    """Frames a second at which the search ends."""


@dataclass(frozen=True)
class Row:
    """One load."""

    load: str
    asked_hz: float
    rate_hz: float
    """Mean rate of states at a consumer."""
    answered_percent: float
    """Frames asked for that a state answered."""
    largest_gap_ms: float
    """Between the arrivals of two states."""
    latency_p50_ms: float
    """From the release of a frame to the arrival of its state."""
    latency_p99_ms: float
    latency_max_ms: float
    skipped: int
    """Frames that were passed over, as the processes counted them."""
    missed: int
    """States that were published and did not reach the consumer."""
    memory_mb: float
    """Of all processes together, at the end."""
    memory_percent_per_10_min: float
    """Its growth, by a line through the second half; nan after less than a minute."""
    source_mb_per_10_min: float
    """The same growth process by process, in MB."""
    segmenter_mb_per_10_min: float
    tracker_mb_per_10_min: float


def run(config: LoadBench, console: Console) -> list[Row]:
    """Prints a row a load."""
    table = []
    with private_folder() as folder, Progress(console=console, transient=True) as progress:
        task = progress.add_task("Load", total=None)
        options = film(Path(folder) / "film", _FRAMES, config.fps)

        def row(load: str, fps: float, seconds: float) -> Row:
            progress.update(task, description=f"{load} at {fps:g} Hz")
            table.append(measure(load, fps, seconds, options, Path(folder)))
            return table[-1]

        row("soak", config.fps, config.seconds)
        row(BESIDE, config.fps, config.trial_seconds)
        if config.search:
            highest = _highest(config, row)
            row("flood", 2 * highest, config.trial_seconds)
    report.print_rows(console, "Load, with recording", table)
    return table


def _highest(config: LoadBench, measure: Measure) -> float:
    """The highest rate, in steps of a quarter, until the first that is not sustained."""
    highest = config.fps
    while (fps := 1.25 * highest) <= config.highest:
        if measure("search", fps, config.trial_seconds).answered_percent < 100 * _SUSTAINED:
            break
        highest = fps
    return highest


class _Watch:
    """What a consumer hears during a load."""

    def __init__(self, system: System):
        self.seen: list[tuple[int, int, int]] = []
        self.memory: list[tuple[float, dict[str, float]]] = []
        self._system = system
        self._healths = system.client.bus.every(topics.HEALTH)
        self.healths: dict[str, Health] = {}
        system.client.watch(self._take)

    def _take(self, seen: Seen) -> None:
        stamp = seen.state.stamp
        now_ns = time.time_ns() - time.monotonic_ns() + seen.arrived_ns
        if not self.seen or stamp.frame != self.seen[-1][0]:
            self.seen.append((stamp.frame, seen.arrived_ns, now_ns - stamp.released_ns))

    def glance(self) -> None:
        """Notes the memory and the newest heartbeats."""
        processes = self._system.processes().items()
        with suppress(psutil.NoSuchProcess):
            used = {name: process.memory_info().rss / 1e6 for name, process in processes}
            if len(used) == len(topics.PROCESSES):
                self.memory.append((time.monotonic(), used))
        while (health := self._healths.get(0)) is not None:
            self.healths[health.process] = health
        time.sleep(0.5)


def measure(load: str, fps: float, seconds: float, options: list[str], folder: Path) -> Row:
    """One load on a system of its own; `BESIDE` at the end of its name adds slow consumers."""
    folder = folder / f"{load.replace(' ', '-')}-{fps:g}"
    folder.mkdir()
    rig = rig_name("load")
    with System(rig, [*options, "--fps", f"{fps:g}"], folder) as system:
        # No state is ever live where frames come faster than states can.
        system.until(lambda: system.client.latest() is not None)
        slow = _slow_consumers(rig) if load.endswith(BESIDE) else []
        # A pause of the consumer's own is no gap between states.
        gc.collect()
        gc.freeze()
        try:
            watch = _Watch(system)
            began = time.monotonic()
            while time.monotonic() < began + _FIRST_SECONDS + seconds:
                watch.glance()
        finally:
            for consumer in slow:
                consumer.kill()
                consumer.wait()
        missed = system.client.missed
    return _row(load, fps, watch, round((began + _FIRST_SECONDS) * 1e9), missed)


def _slow_consumers(rig: str) -> list[subprocess.Popen[bytes]]:
    """One that reads twice a second, and one that stands still."""
    command = [sys.executable, "-c", _SLOW_CONSUMER, rig]
    consumers = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(2)]
    for consumer in consumers:
        assert consumer.stdout is not None
        with consumer.stdout as said:
            said.readline()
    os.kill(consumers[0].pid, signal.SIGSTOP)
    return consumers


def _row(load: str, fps: float, watch: _Watch, from_ns: int, missed: int) -> Row:
    frames, arrived, latency = np.array([s for s in watch.seen if s[1] >= from_ns]).T
    duration_s = (arrived[-1] - arrived[0]) / 1e9
    asked = int(frames[-1] - frames[0])
    healths = [watch.healths[name] for name in topics.PROCESSES]
    memory_mb = sum(watch.memory[-1][1].values())
    growth_mb = {name: _growth_mb(watch.memory, name) for name in topics.PROCESSES}
    return Row(
        load=load,
        asked_hz=fps,
        rate_hz=(len(frames) - 1) / duration_s,
        answered_percent=100 * (len(frames) - 1) / asked,
        largest_gap_ms=float(np.diff(arrived).max() / 1e6),
        latency_p50_ms=float(np.percentile(latency, 50) / 1e6),
        latency_p99_ms=float(np.percentile(latency, 99) / 1e6),
        latency_max_ms=float(latency.max() / 1e6),
        skipped=sum(health.dropped for health in healths),
        missed=missed,
        memory_mb=memory_mb,
        memory_percent_per_10_min=100 * sum(growth_mb.values()) / memory_mb,
        source_mb_per_10_min=growth_mb["source"],
        segmenter_mb_per_10_min=growth_mb["segmenter"],
        tracker_mb_per_10_min=growth_mb["tracker"],
    )


def _growth_mb(memory: list[tuple[float, dict[str, float]]], process: str) -> float:
    """Of a process in ten minutes, by a line through the second half of the soak."""
    times, used = np.array([(when, mb[process]) for when, mb in memory[len(memory) // 2 :]]).T
    if times[-1] - times[0] < _LEAST_FOR_GROWTH_S:
        return float("nan")
    return 600 * float(np.polyfit(times, used, 1)[0])

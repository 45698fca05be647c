"""`suturetrack bench latency`: the whole dataflow in real time, at growing rates and both recordings."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import track

from services.bench import report
from services.bench.system import private_folder, rig_name
from services.run_folder import RunFolder
from services.summary import summarize
from suturetrack.types import InputError


@dataclass(frozen=True)
class LatencyBench:
    """Rates, latencies, drops and sizes of real runs with real processes."""

    scenario: str = "figure8-175"
    """Scene of the bench top."""
    seconds: float = 20.0
    """Length of each run."""
    rates: tuple[float, ...] = (30.0, 60.0)
    """Frames a second that the source is asked for; the renderer itself needs about a third of a core
    at 30."""
    recordings: tuple[Literal["light", "full"], ...] = ("light", "full")
    """Levels of recording to compare."""


@dataclass(frozen=True)
class Row:
    """One process in one run."""

    asked_hz: float
    recording: str
    process: str
    rate_hz: float
    p50_ms: float
    """From the release of a frame to the publication of the process's result."""
    p99_ms: float
    max_ms: float
    frames: int
    dropped: int
    memory_mb: float
    recorded_mb_per_s: float


def run(config: LatencyBench, console: Console) -> list[Row]:
    """Prints a row a process and run."""
    cases = [(rate, level) for rate in config.rates for level in config.recordings]
    table: list[Row] = []
    for rate, level in track(cases, "Latency", console=console, transient=True):
        table += _rows(config, rate, level)
    report.print_rows(console, f"Latency, {config.scenario}", table)
    return table


def _rows(config: LatencyBench, rate: float, level: str) -> Iterator[Row]:
    with private_folder() as folder:
        run_dir = Path(folder) / "run"
        command = [sys.executable, "-m", "services.cli", "run"]
        command += ["--source", f"stage:{config.scenario}", "--fps", f"{rate:g}"]
        command += ["--frames", f"{round(rate * config.seconds)}", "--recording", level]
        command += ["--run-dir", str(run_dir), "--rig", rig_name("latency")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise InputError(f"bench latency: {done.stderr.strip().splitlines()[-1:]}")
        for process in summarize(RunFolder(run_dir)).processes:
            size = sum(f.stat().st_size for f in run_dir.glob(f"{process.name}*.rrd"))
            yield Row(
                asked_hz=rate,
                recording=level,
                process=process.name,
                rate_hz=process.rate_hz,
                p50_ms=process.latency_ms.p50,
                p99_ms=process.latency_ms.p99,
                max_ms=process.latency_ms.largest,
                frames=process.frames,
                dropped=process.dropped,
                memory_mb=process.memory_mb,
                recorded_mb_per_s=size / 1e6 / config.seconds,
            )

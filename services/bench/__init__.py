"""`suturetrack bench`: accuracy and speed, each figure beside its reference in the same run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from services.bench import (
    faults,
    footage,
    initialization,
    latency,
    load,
    recording,
    report,
    segmentation,
    tracking,
)
from services.bench.faults import FaultsBench
from services.bench.footage import FootageBench
from services.bench.initialization import InitializationBench
from services.bench.latency import LatencyBench
from services.bench.load import LoadBench
from services.bench.recording import RecordingBench
from services.bench.report import Plot
from services.bench.segmentation import SegmentationBench
from services.bench.tracking import TrackingBench

_PLOTS = {
    "tracking": (
        Plot("rms", "scenario", logarithmic=True),
        Plot("length_error_percent", "scenario"),
        Plot("ends_p95", "scenario", logarithmic=True),
        Plot("false_percent", "scenario"),
        Plot("tracked_percent", "scenario"),
    ),
    "initialization": (
        Plot("mean", "data", reference="published_mean", logarithmic=True),
        Plot("length_error_percent", "data", reference="published_length_error_percent"),
        Plot("worst_end", "data", logarithmic=True),
        Plot("seconds", "data"),
    ),
    "footage": (
        Plot("tracked_percent", "spoil"),
        Plot("false_percent", "spoil"),
        Plot("mean_px", "spoil", logarithmic=True),
    ),
    "segmentation": (Plot("pair_ms", "filter", logarithmic=True), Plot("f1", "filter")),
    "latency": (Plot("p50_ms", "process"), Plot("p99_ms", "process")),
    "recording": (
        Plot("ratio", "process"),
        Plot("loop_ms", "process"),
        Plot("kilobytes", "process", logarithmic=True),
    ),
    "load": (Plot("rate_hz", "load", reference="asked_hz"), Plot("latency_p99_ms", "load")),
    "faults": (
        Plot("stale_max_ms", "fault", reference="limit_ms"),
        Plot("back_max_s", "fault", logarithmic=True),
    ),
}


@tyro.conf.configure(tyro.conf.CascadeSubcommandArgs)
@dataclass(frozen=True)
class BenchConfig:
    """Measure accuracy and speed, each figure beside its reference in the same run."""

    what: Annotated[
        Annotated[TrackingBench, tyro.conf.subcommand("tracking")]
        | Annotated[InitializationBench, tyro.conf.subcommand("initialization")]
        | Annotated[FootageBench, tyro.conf.subcommand("footage")]
        | Annotated[SegmentationBench, tyro.conf.subcommand("segmentation")]
        | Annotated[LatencyBench, tyro.conf.subcommand("latency")]
        | Annotated[RecordingBench, tyro.conf.subcommand("recording")]
        | Annotated[FaultsBench, tyro.conf.subcommand("faults")]
        | Annotated[LoadBench, tyro.conf.subcommand("load")],
        tyro.conf.arg(name=""),
    ]
    """The benchmark."""
    json: Path | None = None
    """Write every row at full precision to this file."""
    page: Path | None = None
    """Write one HTML page with tables and plots to this file."""


def run(config: BenchConfig) -> None:
    """Runs one benchmark, prints its rows, and writes what was asked for.

    Raises:
        InputError: what was asked for cannot be written, or the benchmark cannot be run.
    """
    for path in (config.json, config.page):
        if path is not None:
            report.check_writable(path)
    console = Console()
    table: list[object]
    match config.what:
        case TrackingBench():
            name, table = "tracking", [*tracking.run(config.what, console)]
        case InitializationBench():
            name, table = "initialization", [*initialization.run(config.what, console)]
        case FootageBench():
            name, table = "footage", [*footage.run(config.what, console)]
        case SegmentationBench():
            name, table = "segmentation", [*segmentation.run(config.what, console)]
        case LatencyBench():
            name, table = "latency", [*latency.run(config.what, console)]
        case RecordingBench():
            name, table = "recording", [*recording.run(config.what, console)]
        case LoadBench():
            name, table = "load", [*load.run(config.what, console)]
        case FaultsBench():
            name, table = "faults", [*faults.run(config.what, console)]
    if config.json is not None:
        report.write_json(config.json, {name: table})
    if config.page is not None:
        report.write_page(config.page, f"suturetrack bench {name}", {name: table}, _PLOTS)

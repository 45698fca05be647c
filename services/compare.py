"""`suturetrack compare`: runs side by side, and how far their curves are apart."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from services.course import Course
from services.output import opened
from services.run_folder import RunFolder
from services.summary import RunSummary, Spread, ThreadSummary, summarize
from services.tables import new_table, number, report_console
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.metrics import curve_error
from suturetrack.types import Float64, InputError, Nurbs, Status

_SAMPLES = 300
_BARS = "▁▂▃▄▅▆▇█"
_BINS = 24


@dataclass(frozen=True)
class CompareConfig:
    """Compares every run with the first one, thread by thread and frame by frame.

    With a tolerance it is a regression check: the exit status is 1 when a run exceeds it.
    """

    run_dirs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The folders of two or more runs."""
    tolerance_mm: float | None = None
    """Largest mean distance between the curves of one frame."""
    tolerance_tracking: float | None = None
    """By how many percent points the share of `tracking` may be lower than in the first run."""
    output: Path | None = None
    """A CSV file for the distances: frame, thread, run, distance_mm."""


@dataclass(frozen=True, eq=False)
class Distances:
    """One thread of a run against the same thread of the first run, over the frames of both."""

    run: str
    thread: str
    frames: list[int]
    mm: Float64
    """(n,) mean distance of the curves; nan where one has none, or calls it lost."""
    equal: int
    """How many of the states are equal to the bit."""


def run(config: CompareConfig) -> None:
    """Prints the tables.

    Raises:
        InputError: fewer than two runs, one that cannot be read, or a tolerance that is none.
        SystemExit: a run exceeds a tolerance.
    """
    if len(config.run_dirs) < 2:
        raise InputError("give two or more run folders")
    _check_tolerance("tolerance-mm", config.tolerance_mm)
    _check_tolerance("tolerance-tracking", config.tolerance_tracking)
    folders = [RunFolder(path) for path in config.run_dirs]
    summaries = _told_apart([summarize(folder) for folder in folders], config.run_dirs)
    first = summaries[0]
    distances = [d for other in summaries[1:] for d in compare(first, other, folders[0].rig())]
    show(summaries, distances, report_console())
    if config.output is not None:
        _write(distances, config.output)
    excess = exceeded(summaries, distances, config)
    if excess:
        sys.exit(f"suturetrack compare: {'; '.join(excess)}")


def _check_tolerance(name: str, tolerance: float | None) -> None:
    if tolerance is not None and not 0 <= tolerance < float("inf"):
        raise InputError(f"{name} {tolerance:g}: use a number of 0 or more")


def _told_apart(summaries: list[RunSummary], paths: Sequence[Path]) -> list[RunSummary]:
    """The summaries, under the paths of the folders where several have one name."""
    if len({summary.name for summary in summaries}) == len(summaries):
        return summaries
    return [replace(s, name=str(path)) for s, path in zip(summaries, paths, strict=True)]


def compare(first: RunSummary, other: RunSummary, rig: StereoRig) -> list[Distances]:
    """The distances of the threads that both runs have."""
    courses = {course.thread: course for course in other.courses}
    return [
        _distances(other.name, course, courses[course.thread], rig)
        for course in first.courses
        if course.thread in courses
    ]


def show(summaries: list[RunSummary], distances: list[Distances], console: Console) -> None:
    """Prints which runs these are, what they were like, a column a run, and their distances."""
    labels = [f"run {k}" for k in range(1, len(summaries) + 1)]
    names = [summary.name for summary in summaries]
    label_of = dict(zip(names, labels, strict=True))
    legend = new_table("Runs", "", "folder")
    for label, name in zip(labels, names, strict=True):
        legend.add_row(label, escape(name))
    console.print(legend)
    for label, summary in zip(labels, summaries, strict=True):
        for problem in summary.problems:
            console.print(f"[yellow]{label}: {escape(problem)}[/]", highlight=False)
    for thread in sorted({t.thread for summary in summaries for t in summary.threads}):
        rows = new_table(f"Thread {thread}", "", *labels)
        for label, value in _ROWS.items():
            rows.add_row(label, *(_of(summary, thread, value) for summary in summaries))
        console.print(rows)
    rates = new_table("Processes: frames per second, latency p50 and p99 in ms", "process", *labels)
    for process in summaries[0].processes:
        rates.add_row(process.name, *(_rate(summary, process.name) for summary in summaries))
    console.print(rates)
    apart = new_table(
        f"Distance from the curves of {labels[0]} (mm)",
        *("run", "thread", "frames", "equal", "p50", "p95", "largest", "at frame", "over time"),
    )
    for d in distances:
        spread, seen = Spread.of(d.mm), np.isfinite(d.mm).any()
        apart.add_row(
            *(label_of[d.run], d.thread, str(len(d.frames)), str(d.equal)),
            *(number(x, 3) for x in (spread.p50, spread.p95, spread.largest)),
            str(d.frames[int(np.nanargmax(d.mm))]) if seen else "-",
            _bars(d.mm),
        )
    console.print(apart)


def exceeded(
    summaries: list[RunSummary], distances: list[Distances], config: CompareConfig
) -> list[str]:
    """What is out of tolerance, in words; what cannot be compared is."""
    excess: list[str] = []
    if config.tolerance_mm is None and config.tolerance_tracking is None:
        return excess
    if not summaries[0].threads:
        return [f"{summaries[0].name}: {summaries[0].no_thread}, there is nothing to compare with"]
    if config.tolerance_mm is not None:
        for summary in summaries[1:]:
            excess += _not_compared(summaries[0], summary, distances)
        for d in distances:
            largest = Spread.of(d.mm).largest
            if largest > config.tolerance_mm:
                far = f"up to {largest:.3f} mm from {summaries[0].name}"
                excess.append(f"{d.run}: thread {d.thread} is {far}")
    if config.tolerance_tracking is not None:
        for summary in summaries[1:]:
            excess += _less_tracking(summaries[0], summary, config.tolerance_tracking)
    return excess


def _not_compared(first: RunSummary, other: RunSummary, distances: list[Distances]) -> list[str]:
    compared = {d.thread for d in distances if d.run == other.name and np.isfinite(d.mm).any()}
    missing = [t.thread for t in first.threads if t.thread not in compared]
    return [
        f"{other.name}: thread {thread} has no curve at the frames of {first.name}"
        for thread in missing
    ]


def _less_tracking(first: RunSummary, other: RunSummary, tolerance: float) -> list[str]:
    shares = {t.thread: 100 * t.shares[Status.TRACKING] for t in other.threads}
    return [
        f"{other.name}: thread {t.thread} is tracked in {shares.get(t.thread, 0.0):.1f} % of the "
        f"frames, not {100 * t.shares[Status.TRACKING]:.1f} %"
        for t in first.threads
        if shares.get(t.thread, 0.0) < 100 * t.shares[Status.TRACKING] - tolerance
    ]


def _distances(run: str, one: Course, other: Course, rig: StereoRig) -> Distances:
    others = dict(zip(other.frames.tolist(), other.states, strict=True))
    frames, mm, equal = [], [], 0
    for frame, recorded in zip(one.frames.tolist(), one.states, strict=True):
        if frame not in others:
            continue
        a, b = recorded.state, others[frame].state
        frames.append(frame)
        held = Status.LOST not in (a.status, b.status)
        mm.append(_distance(a.curve, b.curve) if held else float("nan"))
        equal += a.status == b.status and _equal(a.curve, b.curve)
    return Distances(run, one.thread, frames, np.array(mm) * rig.mm_per_unit, equal)


def _distance(a: Nurbs | None, b: Nurbs | None) -> float:
    if a is None or b is None:
        return float("nan")
    s = np.linspace(0, 1, _SAMPLES)
    return curve_error(nurbs.evaluate(a, s), nurbs.evaluate(b, s)).mean


def _equal(a: Nurbs | None, b: Nurbs | None) -> bool:
    if a is None or b is None:
        return a is b
    names = ("knots", "control_points", "weights")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


_ROWS: dict[str, Callable[[ThreadSummary], float]] = {
    "tracking, %": lambda t: 100 * t.shares[Status.TRACKING],
    "occluded, %": lambda t: 100 * t.shares[Status.OCCLUDED],
    "lost, %": lambda t: 100 * t.shares[Status.LOST],
    "skipped, %": lambda t: 100 * t.skipped_share,
    "losses": lambda t: float(len(t.losses)),
    "mean length, mm": lambda t: t.length_mm.mean,
    "sigma of the length, mm": lambda t: t.length_mm.sigma,
    "error of the length, %": lambda t: t.length_error_percent,
    "mean energy, left": lambda t: t.energies["image_left"].mean,
    "mean energy, right": lambda t: t.energies["image_right"].mean,
    "median error, mm": lambda t: t.error_mm.p50,
    "worst error, mm": lambda t: t.error_mm.largest,
    "wrong while tracking, %": lambda t: 100 * t.wrong_share,
}


def _of(summary: RunSummary, thread: str, value: Callable[[ThreadSummary], float]) -> str:
    found = [t for t in summary.threads if t.thread == thread]
    return number(value(found[0]), 2) if found else "-"


def _rate(summary: RunSummary, name: str) -> str:
    found = [p for p in summary.processes if p.name == name]
    if not found:
        return "-"
    ms = found[0].latency_ms
    return f"{found[0].rate_hz:.1f}, {ms.p50:.1f}, {ms.p99:.1f}"


def _bars(mm: Float64) -> str:
    """The largest of every stretch of the run, as a row of bars; a space where nothing is known."""
    top = Spread.of(mm).largest
    bars = ""
    for stretch in np.array_split(mm, min(_BINS, max(len(mm), 1))):
        known = stretch[np.isfinite(stretch)]
        level = known.max() / top if len(known) and top > 0 else 0.0
        bars += _BARS[int(level * (len(_BARS) - 1))] if len(known) else " "
    return bars


def _write(distances: list[Distances], output: Path) -> None:
    with opened(output) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "thread", "run", "distance_mm"])
        for d in distances:
            for frame, mm in zip(d.frames, d.mm.tolist(), strict=True):
                writer.writerow([frame, d.thread, d.run, mm if mm == mm else ""])

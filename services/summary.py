"""What a run amounts to, in figures: by process, by thread, and against the truth where there is one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from services.run_folder import RecordedState, RunFolder
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.metrics import curve_error
from suturetrack.types import Float64, Status, Truth

WRONG_PX = 3.0
"""A curve whose mean distance from the truth is larger is on no thread."""
_SAMPLES = 300


@dataclass(frozen=True)
class Spread:
    """How a quantity is spread over a run; nan without values."""

    mean: float
    sigma: float
    p50: float
    p95: float
    p99: float
    smallest: float
    largest: float

    @classmethod
    def of(cls, values: Sequence[float] | Float64) -> Spread:
        """Of the finite ones among (n,) values."""
        x = np.asarray(values, float)
        x = x[np.isfinite(x)]
        if not len(x):
            return cls(*[float("nan")] * 7)
        p50, p95, p99 = np.percentile(x, [50, 95, 99])
        return cls(*map(float, (x.mean(), x.std(), p50, p95, p99, x.min(), x.max())))


@dataclass(frozen=True)
class ProcessSummary:
    """One process over the run."""

    name: str
    frames: int
    rate_hz: float
    """Frames per second of wall clock, from the first to the last."""
    latency_ms: Spread
    """From the release of a frame to the publication of its result."""
    dropped: int
    memory_mb: float
    """The largest."""


@dataclass(frozen=True)
class Loss:
    """A thread was lost, and when it was found again."""

    frame: int
    recovered: int | None


@dataclass(frozen=True)
class ThreadSummary:
    """One thread over the run; lengths and errors in mm."""

    thread: str
    frames: int
    first: int
    shares: dict[Status, float]
    """Share of the frames with each status."""
    losses: list[Loss]
    length_mm: Spread
    """Of the frames whose status is `tracking`."""
    true_length_mm: float
    """Mean of the true length; nan without a truth."""
    control_points: Spread
    energies: dict[str, Spread]
    error_mm: Spread
    """Mean distance of curve and truth, by frame, where not lost; nan without a truth."""
    error_px: Spread
    """The same in pixels at the thread's depth."""
    wrong_share: float
    """Share of the frames called `tracking` whose curve is more than `WRONG_PX` off; nan without."""
    worst_frame: int | None
    """The frame of the largest error, else of the highest image energy."""

    @property
    def length_error_percent(self) -> float:
        """The % column of Table I."""
        return 100 * (self.length_mm.mean / self.true_length_mm - 1)


@dataclass(frozen=True, eq=False)
class RunSummary:
    """One run."""

    name: str
    processes: list[ProcessSummary]
    threads: list[ThreadSummary]
    problems: list[str]


def summarize(folder: RunFolder) -> RunSummary:
    """Reads what the figures need, and no image."""
    rig = folder.rig()
    truths = {(t.thread, t.stamp.frame): t for t in folder.truths()}
    states = sorted(folder.states(), key=lambda s: s.state.thread)
    threads = [
        _thread(thread, list(group), truths, rig)
        for thread, group in groupby(states, key=lambda s: s.state.thread)
    ]
    return RunSummary(folder.path.name, _processes(folder), threads, folder.problems)


def errors_px(
    states: Sequence[RecordedState], truths: dict[tuple[str, int], Truth], rig: StereoRig
) -> tuple[Float64, Float64]:
    """(n,) mean distances of each state's curve from the truth: in mm, and in px at its depth."""
    mm, px = np.full((2, len(states)), np.nan)
    s = np.linspace(0, 1, _SAMPLES)
    for i, state in enumerate(recorded.state for recorded in states):
        truth = truths.get((state.thread, state.stamp.frame))
        if truth is None or state.curve is None:
            continue
        error = curve_error(nurbs.evaluate(state.curve, s), truth.points).mean
        mm[i] = error * rig.metres_per_unit * 1000
        px[i] = error * rig.focal / float(np.median(truth.points[:, 2]))
    return mm, px


def _thread(
    thread: str,
    states: list[RecordedState],
    truths: dict[tuple[str, int], Truth],
    rig: StereoRig,
) -> ThreadSummary:
    status = np.array([s.state.status for s in states])
    held = (status != Status.LOST) & [s.state.curve is not None for s in states]
    counts = Counter(status.tolist())
    mm_per_unit = rig.metres_per_unit * 1000
    length = np.array([s.state.length for s in states]) * mm_per_unit
    truth = [truths.get((thread, s.state.stamp.frame)) for s in states]
    true_length = Spread.of([t.length * mm_per_unit for t in truth if t is not None])
    mm, px = errors_px(states, truths, rig)
    tracking = (status == Status.TRACKING) & np.isfinite(px)
    names = ("image_left", "image_right", "end", "internal")
    energies = {n: np.array([getattr(s.state.energies, n) for s in states]) for n in names}
    points = [len(s.state.curve.control_points) for s in states if s.state.curve is not None]
    badness = np.where(held, px, np.nan)
    if not np.isfinite(badness).any():
        badness = np.where(held, energies["image_left"] + energies["image_right"], np.nan)
    return ThreadSummary(
        thread=thread,
        frames=len(states),
        first=states[0].state.stamp.frame,
        shares={s: counts[s] / len(states) for s in Status},
        losses=_losses(states),
        length_mm=Spread.of(length[status == Status.TRACKING]),
        true_length_mm=true_length.mean,
        control_points=Spread.of(points),
        energies={name: Spread.of(values[held]) for name, values in energies.items()},
        error_mm=Spread.of(mm[held]),
        error_px=Spread.of(px[held]),
        wrong_share=float((px[tracking] > WRONG_PX).mean()) if tracking.any() else float("nan"),
        worst_frame=(
            states[int(np.nanargmax(badness))].state.stamp.frame
            if np.isfinite(badness).any()
            else None
        ),
    )


def _losses(states: Sequence[RecordedState]) -> list[Loss]:
    """Stretches of lost frames after the thread was found for the first time."""
    found = [s.state for s in states if s.state.curve is not None]
    losses: list[Loss] = []
    for lost, stretch in groupby(found, key=lambda s: s.status is Status.LOST):
        first = next(stretch).stamp.frame
        if lost:
            losses.append(Loss(first, None))
        elif losses:
            losses[-1] = Loss(losses[-1].frame, first)
    return losses


def _processes(folder: RunFolder) -> list[ProcessSummary]:
    latencies = folder.series("/plots/latency_ms/**")
    clocks: dict[str, list[int]] = {}
    for row in folder.rows("/plots/latency_ms/**"):
        if "Scalars:scalars" in row:
            clocks.setdefault(row["entity"].split("/")[-1], []).append(row["log_time"])
    others = folder.series("/plots/dropped/**", "/plots/memory_mb/**")

    def largest(quantity: str, name: str) -> float:
        _, values = others.get(f"/plots/{quantity}/{name}", (None, np.zeros(1)))
        return float(values.max())

    summaries = []
    for entity, (frames, values) in latencies.items():
        name = entity.split("/")[-1]
        seconds = (max(clocks[name]) - min(clocks[name])) / 1e9
        rate = (len(frames) - 1) / seconds if seconds > 0 else float("nan")
        dropped = int(largest("dropped", name))
        memory = largest("memory_mb", name)
        summaries.append(
            ProcessSummary(name, len(frames), rate, Spread.of(values), dropped, memory)
        )
    order = ["source", "segmenter", "tracker"]
    return sorted(summaries, key=lambda p: order.index(p.name) if p.name in order else len(order))

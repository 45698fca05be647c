"""What a run amounts to, in figures: by process, by thread, and against the truth where there is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.course import Course, Loss, courses, losses
from services.run_folder import RunFolder
from services.topics import PROCESSES
from suturetrack.types import Float64, Status

WRONG_PX = 3.0
"""A curve whose mean distance from the truth is larger is not on the thread."""


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
class ThreadSummary:
    """One thread over the run; nan for what cannot be told."""

    thread: str
    first: int
    """The frame of the first state."""
    frames: int
    """Frames of the run from there on, with those that were skipped on the way."""
    shares: dict[Status, float]
    """Share of those frames with each status."""
    skipped_share: float
    """Share of those frames that never reached the tracker."""
    losses: list[Loss]
    length_mm: Spread
    """Of the frames called `tracking`."""
    true_length_mm: float
    """Its mean over the same frames."""
    control_points: Spread
    energies: dict[str, Spread]
    """Of the frames that are not lost, as the errors."""
    error_mm: Spread
    error_px: Spread
    wrong_share: float
    """Share of the frames called `tracking` whose curve is more than `WRONG_PX` off."""
    worst_frame: int | None
    """The frame of the largest error, else of the highest image energy."""

    @classmethod
    def of(cls, course: Course, last: int) -> ThreadSummary:
        """Of a run whose last frame is `last`."""
        first, held, tracking = int(course.frames[0]), course.held, course.tracking
        frames, judged = last - first + 1, tracking & np.isfinite(course.error_px)
        wrong = course.error_px[judged] > WRONG_PX
        return cls(
            thread=course.thread,
            first=first,
            frames=frames,
            shares={s: float((course.status == s).sum() / frames) for s in Status},
            skipped_share=1 - len(course.frames) / frames,
            losses=losses(course.frames.tolist(), course.status.tolist()),
            length_mm=Spread.of(course.length_mm[tracking]),
            true_length_mm=Spread.of(course.true_length_mm[tracking]).mean,
            control_points=Spread.of(course.control_points),
            energies={name: Spread.of(e[held]) for name, e in course.energies.items()},
            error_mm=Spread.of(course.error_mm[held]),
            error_px=Spread.of(course.error_px[held]),
            wrong_share=float(wrong.mean()) if len(wrong) else float("nan"),
            worst_frame=None if course.worst is None else int(course.frames[course.worst]),
        )

    @property
    def length_error_percent(self) -> float:
        """The % column of Table I."""
        return 100 * (self.length_mm.mean / self.true_length_mm - 1)


@dataclass(frozen=True, eq=False)
class RunSummary:
    """One run."""

    name: str
    about: str
    """Version, level and machine, in words."""
    processes: list[ProcessSummary]
    threads: list[ThreadSummary]
    courses: list[Course]
    problems: list[str]

    @property
    def no_thread(self) -> str:
        """Why there may be none, in words."""
        return "no thread in what can be read" if self.problems else "no thread was seeded"


def summarize(folder: RunFolder) -> RunSummary:
    """Reads what the figures need, and no image."""
    frames = folder.series("/plots/latency_ms/**").values()
    found = courses(folder)
    # Of a run that goes on, what is read later knows of later frames.
    ends = [*(numbers.max() for numbers, _ in frames), *(course.frames[-1] for course in found)]
    last = int(max(ends, default=0))
    about = next(iter(folder.about().values()), {})
    words = [f"suturetrack {about.get('suturetrack')}", about.get("level"), about.get("machine")]
    return RunSummary(
        name=folder.path.resolve().name,
        about=", ".join(str(word) for word in words),
        processes=_processes(folder),
        threads=[ThreadSummary.of(course, last) for course in found],
        courses=found,
        problems=folder.problems,
    )


def _processes(folder: RunFolder) -> list[ProcessSummary]:
    clocks: dict[str, list[int]] = {}
    for row in folder.rows("/plots/latency_ms/**"):
        if "Scalars:scalars" in row:
            clocks.setdefault(row["entity"], []).append(row["log_time"])
    others = folder.series("/plots/dropped/**", "/plots/memory_mb/**")

    def largest(quantity: str, name: str) -> float:
        _, values = others.get(f"/plots/{quantity}/{name}", (None, np.zeros(1)))
        return float(values.max())

    summaries = []
    for entity, (_, latency_ms) in folder.series("/plots/latency_ms/**").items():
        name, count = entity.split("/")[-1], len(latency_ms)
        seconds = (max(clocks[entity]) - min(clocks[entity])) / 1e9
        rate_hz = (count - 1) / seconds if seconds > 0 else float("nan")
        dropped, memory_mb = int(largest("dropped", name)), largest("memory_mb", name)
        spread = Spread.of(latency_ms)
        summaries.append(ProcessSummary(name, count, rate_hz, spread, dropped, memory_mb))
    known = {name: i for i, name in enumerate(PROCESSES)}
    return sorted(summaries, key=lambda p: known.get(p.name, len(known)))

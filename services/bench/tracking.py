"""`suturetrack bench tracking`: scenes with exact truth, tracked from one seed pixel, each a row."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track

from services.adaptation import follow
from services.bench import report
from services.bench.pool import check_count, side_by_side
from suturetrack import metrics, nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_offsets
from suturetrack.segmentation import Segmenter
from suturetrack.stage import SCENARIOS, Picture, open_scene
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.types import (
    Bool,
    Float64,
    InputError,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

FALSE_BEYOND_MM = 2.0
"""A curve whose 95th percentile is this far from the thread is wrong, whatever it is called."""
_TOUCHING_MM, _KNOT_MM = 1.0, 15.0
"""A thread is knotted tightly where it touches itself within so much of its length."""
_SAMPLES = 400
_FRAMES_A_LIMIT = 30
Method = Literal["gauss-newton", "paper"]


@dataclass(frozen=True)
class TrackingBench:
    """Scenes tracked from one seed pixel: every scenario, seed and method a row."""

    scenarios: tuple[str, ...] = tuple(SCENARIOS)
    """Scenes to track."""
    seeds: int = 12
    """Fresh seeds of each scenario."""
    first_seed: int = 100
    """The seeds count from here."""
    methods: tuple[Method, ...] = ("gauss-newton",)
    """Trackers to run side by side."""
    rig: str = "bench"
    """The rig of the scenes."""
    fps: float = 30.0
    """Frames a second."""
    picture: Picture = field(default_factory=Picture)
    """How the scenes are filmed."""
    seconds: float | None = None
    """Only so much of each scene; None for the whole."""
    workers: int = 2
    """Scenes side by side."""


@dataclass(frozen=True)
class Case:
    """One scene, tracked by every method on the same fields."""

    scenario: str
    seed: int
    rig: str = "bench"
    methods: tuple[Method, ...] = ("gauss-newton",)
    fps: float = 30.0
    picture: Picture = field(default_factory=Picture)
    seconds: float | None = None


@dataclass(frozen=True, kw_only=True)
class FrameScore:
    """One thread in one frame against its truth, in mm; nan where there is no curve."""

    status: Status
    energy: float
    true_length: float
    limit: float
    """RMS of the best curve that the rig and the noise allow."""
    milliseconds: float
    """Time of the tracker's update."""
    whole: bool
    """Whether the truth is visible from end to end."""
    rms: float = math.nan
    p95: float = math.nan
    largest: float = math.nan
    lateral: float = math.nan
    """Root mean square of the part across the line of sight."""
    depth: float = math.nan
    """Root mean square of the part along the line of sight."""
    length: float = math.nan
    ends: tuple[float, ...] = (math.nan, math.nan)
    coverage: float = 0.0
    """Share of the visible truth within 1 mm of the curve."""
    knot: float = math.nan
    """By how much a tight knot is misplaced along the thread; nan where there is none."""


@dataclass(frozen=True)
class PublishedRow:
    """A row of the paper's Table I."""

    scenario: str
    true_length: float
    length: float
    sigma: float
    length_error_percent: float


PAPERS_TABLE_1 = (
    PublishedRow("figure8-107", 107.0, 108.8, 2.41, 1.68),
    PublishedRow("figure8-175", 175.0, 181.4, 2.65, 3.66),
    PublishedRow("figure8-200", 200.0, 203.53, 2.77, 1.76),
)


@dataclass(frozen=True)
class Row:
    """One thread over one run: the columns of Table I and what length alone hides; mm and %."""

    scenario: str
    rig: str
    seed: int
    method: str
    thread: str
    frames: int
    tracked_percent: float
    losses: int
    longest_recovery_s: float
    false_percent: float
    rms: float
    p95: float
    largest: float
    lateral: float
    depth: float
    limit_ratio: float
    true_length: float
    length: float
    length_error_percent: float
    sigma: float
    ends_p50: float
    ends_p95: float
    knot_p95: float
    coverage_percent: float
    energy: float
    update_ms: float


def rows(config: TrackingBench) -> Iterator[list[Row]]:
    """The rows of every case, as they are done."""
    check_count("seeds", config.seeds)
    for name in config.scenarios:
        if name not in SCENARIOS:
            raise InputError(f"no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    if config.seconds is not None and config.seconds * config.fps < 1:
        raise InputError(f"seconds {config.seconds:g}: that is no frame at {config.fps:g} fps")
    how = config.rig, config.methods, config.fps, config.picture, config.seconds
    cases = [
        Case(name, config.first_seed + k, *how)
        for name in config.scenarios
        for k in range(config.seeds)
    ]
    yield from side_by_side(run_case, cases, config.workers)


def run(config: TrackingBench, console: Console) -> list[Row]:
    """Prints every row, the paper's Table I, and the share of false tracking over all."""
    total = len(config.scenarios) * config.seeds
    progress = track(rows(config), "Tracking", total=total, console=console, transient=True)
    table = sorted(
        (row for case in progress for row in case),
        key=lambda r: (config.scenarios.index(r.scenario), r.method, r.seed, r.thread),
    )
    report.print_rows(console, f"Tracking, {config.rig} rig, mm", table)
    report.print_rows(console, "The paper's Table I, mm", PAPERS_TABLE_1)
    frames = sum(r.frames for r in table)
    false = sum(r.false_percent * r.frames for r in table) / frames
    worst = max(table, key=lambda r: r.false_percent)
    console.print(
        f"{len(table)} runs, {frames} frames: false tracking {false:.2f} % "
        f"(worst: {worst.scenario} seed {worst.seed} {worst.method}, {worst.false_percent:.1f} %), "
        f"{sum(r.losses for r in table)} losses"
    )
    return table


def run_case(case: Case) -> list[Row]:
    """Tracks the scene's threads from one seed pixel each in the first frame.

    A row a method and thread; all methods work on the same fields, in which the threads are looked for
    where the first method says that they move.
    """
    cv2.setNumThreads(1)
    scene = open_scene(case.scenario, case.seed, case.rig, case.fps, case.picture)
    segmenter = Segmenter(scene.rig)
    trackers = {m: Tracker(scene.rig, TrackingConfig(method=m)) for m in case.methods}
    count = scene.frame_count
    if case.seconds is not None:
        count = min(count, round(case.seconds * scene.fps))
    runs = [(method, thread) for method in case.methods for thread in scene.threads]
    scores: dict[tuple[Method, str], list[FrameScore]] = {run: [] for run in runs}
    limits: dict[str, float] = {}
    for i in range(count):
        frame = StereoFrame(Stamp(i, round(i * 1e9 / scene.fps), 0), *scene.render(i))
        for name in scene.threads if i == 0 else ():
            seed = Seed(name, pixel=scene.seed_pixel(0, name))
            segmenter.learn(frame, seed)
            for tracker in trackers.values():
                tracker.seed(seed)
        seen = segmenter.step(frame)
        truths = {truth.thread: truth for truth in scene.truth(i)}
        if i % _FRAMES_A_LIMIT == 0:
            limits = {t: metrics.physical_limit(scene.rig, truths[t].points) for t in truths}
        for method, tracker in trackers.items():
            began = time.perf_counter()
            states = {state.thread: state for state in tracker.step(seen).states}
            elapsed = 1000 * (time.perf_counter() - began)
            for state in states.values() if method == case.methods[0] else ():
                follow(segmenter, state)
            for name, truth in truths.items():
                result = score(states[name], truth, scene.rig, limits[name], elapsed)
                scores[method, name].append(result)
    return [summarise(case, *run, scores[run]) for run in runs]


def score(
    state: ThreadState, truth: Truth, rig: StereoRig, limit: float, milliseconds: float
) -> FrameScore:
    """One state against the truth.

    The curve may lie on hidden stretches of the true thread (it is held there), so its points are
    measured against the whole truth; the truth's points count only where they can be seen.

    Args:
        state: the tracker's answer.
        truth: the thread as it is.
        rig: the cameras of the scene.
        limit: the physical limit, calibration's unit.
        milliseconds: time of the update.
    """
    mm = rig.mm_per_unit
    blank = FrameScore(
        status=state.status,
        energy=state.energies.image_left,
        true_length=truth.length * mm,
        limit=limit * mm,
        milliseconds=milliseconds,
        whole=bool(truth.visible.all()),
    )
    if state.curve is None:
        return blank
    visible = truth.points[truth.visible]
    curve = nurbs.evaluate(state.curve, nurbs.evenly_spaced(state.curve, _SAMPLES))
    points = np.concatenate([curve, visible])
    back = polyline_offsets(visible, curve) if len(visible) else visible
    offsets = mm * np.concatenate([polyline_offsets(curve, truth.points), back])
    distance = np.linalg.norm(offsets, axis=1)
    along = (offsets * points).sum(1) / np.linalg.norm(points, axis=1)
    covered = distance[len(curve) :] <= 1.0
    return replace(
        blank,
        rms=_rms(distance),
        p95=float(np.percentile(distance, 95)),
        largest=float(distance.max()),
        lateral=float(np.sqrt(max(np.mean(distance**2 - along**2), 0))),
        depth=_rms(along),
        length=state.length * mm,
        ends=tuple(mm * d for d in metrics.end_distances(curve, truth.points)),
        knot=metrics.knot_shift(mm * curve, mm * truth.points, _TOUCHING_MM, _KNOT_MM),
        coverage=float(covered.mean()) if len(covered) else math.nan,
    )


def summarise(case: Case, method: Method, thread: str, scores: list[FrameScore]) -> Row:
    """The row of one method and thread: every frame since the seed counts, errors over the tracked ones."""
    tracking = np.array([s.status == Status.TRACKING for s in scores], dtype=bool)
    p95 = _column(scores, "p95")
    wrong = tracking & ~(p95 <= FALSE_BEYOND_MM)
    # Lengths and ends can be judged only where the whole thread is to be seen.
    whole = tracking & np.array([s.whole for s in scores], dtype=bool)
    length, true_length = _column(scores, "length"), _column(scores, "true_length")
    error = (length - true_length)[whole]
    ends = np.array([s.ends for s in scores], dtype=float)[whole]
    rms = _column(scores, "rms")[tracking]
    lost, longest = losses(tracking, case.fps)
    return Row(
        scenario=case.scenario,
        rig=case.rig,
        seed=case.seed,
        method=method,
        thread=thread,
        frames=len(scores),
        tracked_percent=100 * float(tracking.mean()),
        losses=lost,
        longest_recovery_s=longest,
        false_percent=100 * float(wrong.mean()),
        rms=_rms(rms),
        p95=_percentile(p95[tracking], 95),
        largest=_percentile(_column(scores, "largest")[tracking], 100),
        lateral=_rms(_column(scores, "lateral")[tracking]),
        depth=_rms(_column(scores, "depth")[tracking]),
        limit_ratio=_percentile(rms / _column(scores, "limit")[tracking], 50),
        true_length=_mean(true_length[whole]),
        length=_mean(length[whole]),
        length_error_percent=_mean(100 * error / true_length[whole]),
        sigma=float(error.std()) if len(error) else float("nan"),
        ends_p50=_percentile(ends.ravel(), 50),
        ends_p95=_percentile(ends.ravel(), 95),
        knot_p95=_known_percentile(_column(scores, "knot")[whole], 95),
        coverage_percent=100 * _mean(_column(scores, "coverage")[tracking]),
        energy=_mean(_column(scores, "energy")[tracking]),
        update_ms=_percentile(_column(scores, "milliseconds"), 50),
    )


def losses(tracking: Bool, fps: float) -> tuple[int, float]:
    """How often the thread went from held to not held, and the longest time until it was held again."""
    held = np.flatnonzero(tracking)
    if len(held) == 0:
        return 1, float("inf")
    inner = tracking[held[0] :]
    starts = np.flatnonzero(inner[:-1] & ~inner[1:]) + 1
    gaps = [_gap(inner[start:]) / fps for start in starts]
    return len(gaps), max(gaps, default=0.0)


def _gap(rest: Bool) -> float:
    again = np.flatnonzero(rest)
    return float(again[0]) if len(again) else float("inf")


def _column(scores: list[FrameScore], name: str) -> Float64:
    return np.array([getattr(s, name) for s in scores], dtype=np.float64)


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _mean(values: Float64) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _known_percentile(values: Float64, q: float) -> float:
    return _percentile(values[np.isfinite(values)], q)


def _percentile(values: Float64, q: float) -> float:
    return float(np.percentile(values, q)) if len(values) else float("nan")

"""`suturetrack bench footage`: a recording of one's own made hard, and what that costs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from services.adaptation import Adaptation
from services.bench import report
from services.bench.pool import check_count, side_by_side
from services.bench.spoils import SPOILS, Pair, Spoiler
from services.bench.tracking import losses
from services.sources import Footage, InputConfig, open_input
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import polyline_distances
from suturetrack.segmentation import Segmenter
from suturetrack.tracking import Tracker
from suturetrack.types import Float64, InputError, Seed, Stamp, Status, StereoFrame, ThreadState

_SAMPLES = 200
_OUTLIERS = 98
"""Percentile of the distances from a curve's places that counts."""
_SEED_SHARES = (0.2, 0.8)
"""Between which shares of the thread a seed is drawn."""


@dataclass(frozen=True)
class FootageBench:
    """Footage of your own made hard, and judged by what is tracked in it as it is; each way a row."""

    input: Annotated[InputConfig, tyro.conf.arg(name="")]
    seed: tuple[float, float] | None = None
    """U V of a pixel on the thread in the raw left image of the first frame. The bench top knows its own."""
    spoils: tuple[str, ...] = tuple(SPOILS)
    """What is done to the footage."""
    seeds: int = 1
    """Draws of each: how strong, from which seed pixel, and where the gripper comes from."""
    first_seed: int = 100
    """The draws count from here."""
    false_beyond_px: float = 8.0
    """A curve that strays so far from the one in the footage as it is, is wrong."""
    workers: int = 2
    """Runs side by side."""


@dataclass(frozen=True)
class Row:
    """One spoiled run against the footage as it is; distances in px of the left view."""

    spoil: str
    seed: int
    frames: int
    """Those in which the footage as it is shows the thread."""
    tracked_percent: float
    losses: int
    longest_recovery_s: float
    false_percent: float
    mean_px: float
    """Median over the tracked frames of the mean distance."""
    largest_px: float
    right_percent: float
    """Frames whose curve is right, whatever it is called."""
    update_ms: float
    """Median time that a frame takes, segmented and tracked."""


@dataclass(frozen=True)
class Case:
    """One spoiled run."""

    config: FootageBench
    spoil: str
    seed: int
    curves: tuple[Float64 | None, ...]
    """Of every frame as it is, (_SAMPLES, 3); None where nothing was tracked."""


def run(config: FootageBench, console: Console) -> list[Row]:
    """Prints a row a run, and how much is tracked and false over all."""
    unknown = [name for name in config.spoils if name not in SPOILS]
    if unknown:
        raise InputError(f"no spoil {unknown[0]!r}; there are {', '.join(SPOILS)}")
    check_count("seeds", config.seeds)
    curves = tuple(track(_as_it_is(config), "Tracking as it is", console=console, transient=True))
    if any(all(c is None for c in curves[:: SPOILS[name].step]) for name in config.spoils):
        raise InputError("nothing is tracked in the footage as it is: `suturetrack run` shows why")
    cases = [
        Case(config, name, config.first_seed + k, curves)
        for name in config.spoils
        for k in range(config.seeds)
    ]
    progress = track(
        side_by_side(run_case, cases, config.workers),
        "Tracking",
        total=len(cases),
        console=console,
        transient=True,
    )
    table = sorted(progress, key=lambda r: (config.spoils.index(r.spoil), r.seed))
    report.print_rows(console, f"{config.input.source}, made hard", table)
    frames = sum(r.frames for r in table)
    tracked, false = (
        sum(getattr(r, column) * r.frames for r in table) / frames
        for column in ("tracked_percent", "false_percent")
    )
    console.print(
        f"{len(table)} runs, {frames} frames: {tracked:.1f} % tracked, {false:.2f} % false "
        f"(beyond {config.false_beyond_px:g} px)"
    )
    return table


def _as_it_is(config: FootageBench) -> Iterator[Float64 | None]:
    """The thread in every frame of the footage; None where it is not tracked."""
    footage, rig = open_input(config.input)
    with closing(footage):
        if footage.live or config.input.loop is not None:
            raise InputError(f"source {config.input.source}: use footage with an end")
        pixel = config.seed or next(iter(footage.seeds), None)
        if pixel is None:
            raise InputError("--seed U V is needed: a pixel on the thread in the first left image")
        chain = Chain(rig, Seed(pixel=pixel))
        for i, pair in enumerate(_pairs(footage, config.input.frames)):
            yield _points(chain.step(StereoFrame(Stamp(i, round(i * 1e9 / footage.fps), 0), *pair)))


def run_case(case: Case) -> Row:
    """Tracks the spoiled footage from a place on the thread in its first frame."""
    cv2.setNumThreads(1)
    footage, rig = open_input(case.config.input)
    with closing(footage):
        pairs = list(_pairs(footage, case.config.input.frames))
    spoil, rng = SPOILS[case.spoil], np.random.default_rng(case.seed)
    spoiler = Spoiler(spoil, rig, rng.random(4))
    pairs, truths = pairs[:: spoil.step], case.curves[:: spoil.step]
    threads = _filled(truths)
    shown = spoiler.in_sight(pairs[0], threads[0])
    place = shown[round(rng.uniform(*_SEED_SHARES) * (len(shown) - 1))]
    chain = Chain(rig, _seed_at(rig, place))
    states, milliseconds = [], []
    for number, (pair, thread) in enumerate(zip(pairs, threads, strict=True)):
        seconds = number / footage.fps
        left, right = spoiler.spoiled(pair, thread, seconds)
        began = time.perf_counter()
        states.append(chain.step(StereoFrame(Stamp(number, round(seconds * 1e9), 0), left, right)))
        milliseconds.append(1000 * (time.perf_counter() - began))
    return _row(case, rig, states, truths, milliseconds, footage.fps)


def _filled(curves: Sequence[Float64 | None]) -> list[Float64]:
    """Each curve, or the last one before it where there is none."""
    last = next(curve for curve in curves if curve is not None)
    filled = []
    for curve in curves:
        last = last if curve is None else curve
        filled.append(last)
    return filled


def _seed_at(rig: StereoRig, place: Float64) -> Seed:
    """A seed on the pixel of a (3,) point."""
    u, v = rig.project_raw(place[None])[0][0]
    return Seed(pixel=(float(u), float(v)))


class Chain:
    """Segmenter and tracker of one thread, as the processes run them in lock-step."""

    def __init__(self, rig: StereoRig, seed: Seed) -> None:
        self._rig, self._unlearned = rig, [seed]
        self._segmenter, self._tracker = Segmenter(rig), Tracker(rig)
        self._states: deque[ThreadState] = deque()
        self._adaptation = Adaptation(self._segmenter, rig, self._next, lockstep=True)

    def step(self, frame: StereoFrame) -> ThreadState:
        """The thread in the next frame."""
        while self._unlearned:
            seed = self._unlearned.pop()
            self._segmenter.learn(frame, seed)
            self._tracker.seed(seed)
        self._adaptation.catch_up()
        (state,) = self._tracker.step(self._segmenter.step(frame)).states
        self._states.append(scaled(state, self._rig.metres_per_unit))
        self._adaptation.step(frame)
        return state

    def _next(self, _: float) -> ThreadState | None:
        return self._states.popleft() if self._states else None


def _pairs(footage: Footage, frames: int | None) -> Iterator[Pair]:
    """Both raw images of every frame, or of so many."""
    index = 0
    while index != frames and (exposure := footage.read(index)) is not None:
        yield exposure.left, exposure.right
        index += 1


def _points(state: ThreadState) -> Float64 | None:
    if state.curve is None or state.status is not Status.TRACKING:
        return None
    return nurbs.evaluate(state.curve, nurbs.evenly_spaced(state.curve, _SAMPLES))


def _row(
    case: Case,
    rig: StereoRig,
    states: Sequence[ThreadState],
    truths: Sequence[Float64 | None],
    milliseconds: Sequence[float],
    fps: float,
) -> Row:
    judged = [(s, t) for s, t in zip(states, truths, strict=True) if t is not None]
    distances = np.array([_distances(rig, s, t) for s, t in judged])
    mean, stray = distances[:, 0], distances[:, 1]
    tracked = np.array([s.status is Status.TRACKING for s, _ in judged])
    is_right = stray <= case.config.false_beyond_px
    lost, longest = losses(tracked, fps)
    nan = float("nan")
    return Row(
        spoil=case.spoil,
        seed=case.seed,
        frames=len(judged),
        tracked_percent=100 * float(tracked.mean()),
        losses=lost,
        longest_recovery_s=longest,
        false_percent=100 * float((tracked & ~is_right).mean()),
        mean_px=float(np.median(mean[tracked])) if tracked.any() else nan,
        largest_px=float(stray[tracked].max()) if tracked.any() else nan,
        right_percent=100 * float(is_right.mean()),
        update_ms=float(np.median(milliseconds)),
    )


def _distances(rig: StereoRig, state: ThreadState, truth: Float64) -> tuple[float, float]:
    """Mean distance of the curve's places from the true curve, and the percentile that counts, px."""
    if state.curve is None:
        return float("inf"), float("inf")
    points = nurbs.evaluate(state.curve, nurbs.evenly_spaced(state.curve, _SAMPLES))
    found, true = (rig.project_raw(p)[0] for p in (points, truth))
    distances = polyline_distances(found, true)
    return float(distances.mean()), float(np.percentile(distances, _OUTLIERS))

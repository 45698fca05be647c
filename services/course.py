"""How each thread went over a run, frame by frame, in figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.run_folder import RecordedState, RunFolder
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.metrics import curve_error
from suturetrack.types import Bool, Float64, Status, Truth

ENERGIES = ("image_left", "image_right", "end", "internal")
_SAMPLES = 300


@dataclass(frozen=True, eq=False)
class Course:
    """One thread; every array has an entry for each of its n states, nan where it has no meaning."""

    thread: str
    states: list[RecordedState]
    frames: NDArray[np.int64]
    status: NDArray[Any]
    length_mm: Float64
    true_length_mm: Float64
    control_points: Float64
    energies: dict[str, Float64]
    error_mm: Float64
    """Mean distance between the curve and the true thread."""
    error_px: Float64
    """The same, in pixels at the thread's depth."""

    @property
    def tracking(self) -> Bool:
        """Where the status is `tracking`."""
        return self.status == Status.TRACKING

    @property
    def held(self) -> Bool:
        """Where there is a curve that is not lost."""
        return (self.status != Status.LOST) & np.isfinite(self.length_mm)

    @property
    def worst(self) -> int | None:
        """Index of the held state that is farthest from the truth, else of the worst image energy."""
        energy = self.energies["image_left"] + self.energies["image_right"]
        for badness in (self.error_px, energy):
            badness = np.where(self.held, badness, np.nan)
            if np.isfinite(badness).any():
                return int(np.nanargmax(badness))
        return None


def courses(folder: RunFolder) -> list[Course]:
    """The courses of all threads, by name."""
    rig = folder.rig()
    truths = {(t.thread, t.stamp.frame): t for t in folder.truths()}
    states = sorted(folder.states(), key=lambda s: s.state.thread)
    return [
        _course(thread, list(group), truths, rig)
        for thread, group in groupby(states, key=lambda s: s.state.thread)
    ]


def _course(
    thread: str,
    recorded: list[RecordedState],
    truths: dict[tuple[str, int], Truth],
    rig: StereoRig,
) -> Course:
    states = [r.state for r in recorded]
    truth = [truths.get((thread, s.stamp.frame)) for s in states]
    error = np.array([_error(r, t) for r, t in zip(recorded, truth, strict=True)])
    depth = np.array([np.nan if t is None else np.median(t.points[:, 2]) for t in truth])
    mm_per_unit = rig.mm_per_unit
    return Course(
        thread=thread,
        states=recorded,
        frames=np.array([s.stamp.frame for s in states]),
        status=np.array([s.status for s in states]),
        length_mm=mm_per_unit * np.array([s.length for s in states]),
        true_length_mm=mm_per_unit * np.array([np.nan if t is None else t.length for t in truth]),
        control_points=np.array(
            [np.nan if s.curve is None else len(s.curve.control_points) for s in states], float
        ),
        energies={e: np.array([getattr(s.energies, e) for s in states]) for e in ENERGIES},
        error_mm=mm_per_unit * error,
        error_px=error * rig.focal / depth,
    )


def _error(recorded: RecordedState, truth: Truth | None) -> float:
    curve = recorded.state.curve
    if curve is None or truth is None:
        return float("nan")
    points = nurbs.evaluate(curve, np.linspace(0, 1, _SAMPLES))
    return curve_error(points, truth.points).mean


@dataclass(frozen=True)
class Loss:
    """A thread was lost, and when it was found again."""

    frame: int
    recovered: int | None


def losses(frames: Sequence[int], status: Sequence[Status]) -> list[Loss]:
    """The stretches of lost frames after the first frame that is not lost."""
    found: list[Loss] = []
    seen = False
    for lost, stretch in groupby(
        zip(frames, status, strict=True), key=lambda pair: pair[1] == Status.LOST
    ):
        first, _ = next(stretch)
        if lost and seen:
            found.append(Loss(first, None))
        elif found:
            found[-1] = Loss(found[-1].frame, first)
        seen = seen or not lost
    return found

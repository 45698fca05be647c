"""`suturetrack bench initialization`: first curves against the truth, beside published figures."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from services.bench import report
from services.bench.pool import check_count
from services.sources.footage import read_image
from suturetrack import metrics, nurbs
from suturetrack.calibration import load_calibration
from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationError, initialize
from suturetrack.polylines import polyline_length
from suturetrack.segmentation import Segmenter
from suturetrack.stage import SCENARIOS, Picture, open_scene
from suturetrack.types import Float64, InputError, Nurbs, Seed, Stamp, StereoFrame

_SAMPLES = 600
_ORDER_RADIUS = 0.01
"""How near to the truth a place of the curve is that is in order, as a share of the true length."""
_IN_ORDER_PERCENT = 95.0
_RIGHT_RMS_MM, _RIGHT_END_MM = 0.3, 1.0
_SURE = 0.5
"""Confidence from which a first curve that is not right misleads."""
_ERRORS = ("mean", "largest", "rms", "length", "end", "order")


@dataclass(frozen=True)
class InitializationBench:
    """From one seed pixel to the whole thread: accuracy and time, every case a row."""

    scenarios: tuple[str, ...] = ()
    """Scenes of the bench top; all of them by default, none with --pairs."""
    seeds: int = 12
    """Fresh seeds of each scenario."""
    first_seed: int = 100
    """The seeds count from here."""
    rig: str = "bench"
    """The rig of the scenes."""
    picture: Picture = field(default_factory=Picture)
    """How the scenes are filmed."""
    pairs: Path | None = None
    """A folder of pairs: <name>/{left.png,right.png,calibration.yaml,seed.json,truth.json} and, where
    there are published figures, published.csv with the columns file, ours_len, gt_len, e_mean, e_max."""


@dataclass(frozen=True)
class Row:
    """One first curve; distances in mm on the bench top, in the calibration's unit for pairs."""

    data: str
    seed: int
    solved: bool
    """Mean error below 1 % of the true length and length error below 5 %, as published."""
    right: bool | None
    """RMS of 0.3 mm and ends within 1 mm at most; None for pairs, whose unit may be any."""
    confidence: float
    mean: float
    published_mean: float
    largest: float
    published_largest: float
    rms: float
    length_error_percent: float
    published_length_error_percent: float
    worst_end: float
    in_order_percent: float
    """Share of the thread that is met when curve and thread are walked from end to end."""
    reprojection_px: float
    seconds: float
    reason: str


def rows(config: InitializationBench) -> Iterator[Row]:
    """Every case in turn: the folder's pairs, then the bench top's scenes."""
    check_count("seeds", config.seeds)
    if config.pairs is not None:
        yield from _pairs(config.pairs)
    names = config.scenarios or (() if config.pairs is not None else tuple(SCENARIOS))
    for name in names:
        for k in range(config.seeds):
            yield _scene(name, config.first_seed + k, config)


def run(config: InitializationBench, console: Console) -> list[Row]:
    """Prints the rows and their summary."""
    table = list(track(rows(config), "Initialisation", console=console, transient=True))
    report.print_rows(console, "Initialisation", table)
    solved = [r for r in table if r.solved]
    if solved:
        console.print(
            f"{len(solved)} of {len(table)} solved; median mean error "
            f"{np.median([r.mean for r in solved]):.3g}, worst {max(r.mean for r in solved):.3g}; "
            f"{sum(r.in_order_percent >= _IN_ORDER_PERCENT for r in table)} in order"
        )
    measured = [r for r in table if r.right is not None]
    if measured:
        wrong = [r for r in measured if not r.right]
        console.print(
            f"{len(measured) - len(wrong)} of {len(measured)} right (RMS {_RIGHT_RMS_MM:g} mm, ends "
            f"{_RIGHT_END_MM:g} mm at most); {sum(r.confidence >= _SURE for r in wrong)} of the others "
            f"with a confidence of {_SURE:g} or more"
        )
    return table


def _scene(name: str, seed: int, config: InitializationBench) -> Row:
    scene = open_scene(name, seed, config.rig, picture=config.picture)
    thread = scene.threads[0]
    truth = next(t for t in scene.truth(0) if t.thread == thread)
    frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
    start = Seed(thread, pixel=scene.seed_pixel(0, thread))
    unit = scene.rig.mm_per_unit
    return _row(f"{name}, {config.rig}", seed, frame, scene.rig, start, truth.points, unit, {})


def _pairs(folder: Path) -> Iterator[Row]:
    cases = sorted(p.parent for p in folder.glob("*/calibration.yaml"))
    if not cases:
        raise InputError(f"pairs {folder}: no <name>/calibration.yaml inside")
    published = {}
    if (folder / "published.csv").exists():
        with (folder / "published.csv").open(newline="") as file:
            published = {line["file"]: line for line in csv.DictReader(file)}
    for case in cases:
        left, right = (read_image(case / f"{view}.png") for view in ("left", "right"))
        seed = json.loads((case / "seed.json").read_text())
        truth = None
        if (case / "truth.json").exists():
            content = json.loads((case / "truth.json").read_text())
            curve = nurbs.curve_from(
                content["degree"], np.array(content["knots"]), np.array(content["control_points"])
            )
            truth = _dense(curve)
        yield _row(
            case.name,
            0,
            StereoFrame(Stamp(0, 0, 0), left, right),
            load_calibration(case / "calibration.yaml"),
            Seed(pixel=(seed["u"], seed["v"])),
            truth,
            None,
            published.get(case.name, {}),
        )


def _row(
    data: str,
    number: int,
    frame: StereoFrame,
    rig: StereoRig,
    seed: Seed,
    truth: Float64 | None,
    mm_per_unit: float | None,
    published: dict[str, str],
) -> Row:
    """In mm; where `mm_per_unit` is None in the calibration's unit, and nothing tells what is right."""
    nan, unit = float("nan"), mm_per_unit or 1.0
    segmenter = Segmenter(rig)
    began = time.perf_counter()
    try:
        segmenter.learn(frame, seed)
        first = initialize(segmenter.step(frame), rig, seed)
    except InitializationError as error:
        errors = dict.fromkeys((*_ERRORS, "pixels"), nan)
        reason, confidence = str(error), 0.0
    else:
        errors = _errors(first.curve, truth, unit) | {"pixels": first.reprojection_px}
        reason, confidence = "; ".join(first.reasons), first.confidence
    return Row(
        data=data,
        seed=number,
        solved=_is_solved(errors, truth, unit),
        right=None if mm_per_unit is None else _is_right(errors),
        confidence=confidence,
        mean=errors["mean"],
        published_mean=float(published.get("e_mean", nan)),
        largest=errors["largest"],
        published_largest=float(published.get("e_max", nan)),
        rms=errors["rms"],
        length_error_percent=errors["length"],
        published_length_error_percent=_published_length(published),
        worst_end=errors["end"],
        in_order_percent=errors["order"],
        reprojection_px=errors["pixels"],
        seconds=time.perf_counter() - began,
        reason=reason,
    )


def _errors(curve: Nurbs, truth: Float64 | None, unit: float) -> dict[str, float]:
    if truth is None:
        return dict.fromkeys(_ERRORS, float("nan"))
    found = _dense(curve)
    error = metrics.curve_error(found, truth)
    radius = _ORDER_RADIUS * polyline_length(truth)
    return {
        "mean": unit * error.mean,
        "largest": unit * error.largest,
        "rms": unit * error.rms,
        "length": error.length_percent,
        "end": unit * max(error.ends),
        "order": 100 * metrics.in_order(found, truth, radius),
    }


def _is_right(errors: dict[str, float]) -> bool:
    return bool(errors["rms"] <= _RIGHT_RMS_MM and errors["end"] <= _RIGHT_END_MM)


def _is_solved(errors: dict[str, float], truth: Float64 | None, unit: float) -> bool:
    if truth is None:
        return bool(np.isfinite(errors["pixels"]))
    near = errors["mean"] < 0.01 * unit * polyline_length(truth)
    return bool(near and abs(errors["length"]) < 5)


def _published_length(published: dict[str, str]) -> float:
    if not published.get("gt_len"):
        return float("nan")
    return 100 * (float(published["ours_len"]) / float(published["gt_len"]) - 1)


def _dense(curve: Nurbs) -> Float64:
    return nurbs.evaluate(curve, nurbs.evenly_spaced(curve, _SAMPLES))

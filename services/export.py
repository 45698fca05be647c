"""`suturetrack export`: the states of a run, out of its recordings, as JSON lines or CSV."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TextIO

import tyro

from services.output import opened
from services.run_folder import RecordedState, RunFolder
from suturetrack.types import InputError

Format = Literal["jsonl", "csv"]
_FORMATS: dict[str, Format] = {"": "jsonl", ".jsonl": "jsonl", ".csv": "csv"}
"""By the ending of the output."""


@dataclass(frozen=True)
class ExportConfig:
    """Writes a line for each frame and thread, from the seed on, as it was recorded.

    Columns: frame, capture_time_ns, thread, status (tracking, occluded, lost), degree, knots,
    control_points (x y z, rectified left frame, calibration's unit), length (the same unit), energy
    (image_left, image_right, end), latency_ms (release of the frame to publication of the state).
    JSON has null, and empty lists, where there is no curve yet. In CSV the numbers of a list are
    separated by spaces, and the energies are columns energy_image_left, ...
    """

    run_dir: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    output: Path | None = None
    """The file to write, .jsonl or .csv; standard output when not given."""
    format: Format | None = None
    """What to write; by the ending of the output when not given, JSON lines without an ending."""


def run(config: ExportConfig) -> None:
    """Exports the run.

    Raises:
        InputError: the folder holds no readable recording of states, or the output cannot be made.
    """
    write = _write_csv if _format(config) == "csv" else _write_json
    folder = RunFolder(config.run_dir)
    states = folder.states()
    for problem in folder.problems:
        print(f"export: {problem}", file=sys.stderr)
    if not states:
        raise InputError(f"{config.run_dir}: no states were recorded; was a thread seeded?")
    with opened(config.output) as file:
        write((record(state) for state in states), file)


def record(recorded: RecordedState) -> dict[str, Any]:
    """One line of the export."""
    state, energies = recorded.state, recorded.state.energies
    return {
        "frame": state.stamp.frame,
        "capture_time_ns": state.stamp.capture_ns,
        "thread": state.thread,
        "status": str(state.status),
        "degree": state.curve and state.curve.degree,
        "knots": [] if state.curve is None else state.curve.knots.tolist(),
        "control_points": [] if state.curve is None else state.curve.control_points.tolist(),
        "length": _number(state.length),
        "energy": {
            "image_left": _number(energies.image_left),
            "image_right": _number(energies.image_right),
            "end": _number(energies.end),
        },
        "latency_ms": recorded.latency_ms,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _format(config: ExportConfig) -> Format:
    if config.format is not None:
        return config.format
    suffix = "" if config.output is None else config.output.suffix.lower()
    if suffix not in _FORMATS:
        raise InputError(f"{config.output}: the name must end in .jsonl or .csv, or give --format")
    return _FORMATS[suffix]


def _write_json(records: Iterable[dict[str, Any]], file: TextIO) -> None:
    for line in records:
        file.write(json.dumps(line, allow_nan=False) + "\n")


def _write_csv(records: Iterable[dict[str, Any]], file: TextIO) -> None:
    rows = [_flat(line) for line in records]
    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def _flat(line: dict[str, Any]) -> dict[str, Any]:
    points = [x for point in line["control_points"] for x in point]
    lists = {"knots": line["knots"], "control_points": points}
    flat = line | {name: " ".join(map(repr, numbers)) for name, numbers in lists.items()}
    return flat | {f"energy_{name}": value for name, value in flat.pop("energy").items()}

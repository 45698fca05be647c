"""A run's recordings, read back."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
import warnings
import weakref
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from services.messages import Forget
from services.run_file import APPLICATION, RECORDING_VERSION
from services.writer import Request
from suturetrack.camera import Camera, StereoRig
from suturetrack.segmentation import joined
from suturetrack.types import (
    Colours,
    Energies,
    Float32,
    Float64,
    Image,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

T = TypeVar("T")
Row = dict[str, Any]
"""Columns of one row, with `entity`; lists are NumPy arrays, what was not logged is missing."""
_ROW_ID = "rerun.controls.RowId"
"""Unlike that of any other row of any recording."""


@dataclass(frozen=True, eq=False)
class RecordedState:
    """A state, in the calibration's unit, and when the tracker published it."""

    state: ThreadState
    published_ns: int

    @property
    def latency_ms(self) -> float:
        """From the release of the frame to the publication of the state."""
        return (self.published_ns - self.state.stamp.released_ns) / 1e6


class RunFolder:
    """All recordings of one run.

    Files that a killed process left behind are read as far as they go; files that cannot be read,
    or only in part, are named in `problems`; so is a tracker's that is missing.
    """

    def __init__(self, run_dir: Path | str) -> None:
        """Opens every .rrd file of the folder.

        Raises:
            InputError: no such folder, or nothing in it that can be read.
        """
        self.path = Path(run_dir)
        self.problems: list[str] = []
        if not self.path.is_dir():
            raise InputError(f"no run folder {self.path}; it is what `--run-dir` named")
        files = sorted(self.path.glob("*.rrd"), key=_part)
        if not files:
            raise InputError(f"{self.path}: no recordings (*.rrd) in this folder")
        readers = {file: self._open(file) for file in files}
        self._readers = {file: reader for file, reader in readers.items() if reader is not None}
        if not self._readers:
            raise InputError(f"{self.path}: no recording can be read: {'; '.join(self.problems)}")
        self._check_version()
        if not any(_part(file)[0] == "tracker" for file in files) and "tracker" not in self.about():
            self.problems.append(
                "no recording of the tracker is here: no states, nor what was asked"
            )

    @property
    def files(self) -> list[Path]:
        """The readable recordings as they lie in the folder."""
        return list(self._readers)

    def rows(self, *contents: str) -> Iterator[Row]:
        """Every row of the entities that match (`/plots/**`), in no order across entities.

        Once, too, where somebody has copied or merged files within the folder.

        Raises:
            InputError: a recording is damaged inside.
        """
        given: set[bytes] = set()
        for file, reader in self._readers.items():
            for entity, batch in _batches(file, reader, contents):
                for row in _rows(entity, batch):
                    if row[_ROW_ID] not in given:
                        given.add(row[_ROW_ID])
                        yield row

    def states(self) -> list[RecordedState]:
        """All states of all threads, by frame and thread."""
        rows = (row for row in self.rows("/rig/thread/**") if row["entity"].endswith("/nurbs"))
        states = self._parsed(rows, _state, "states")
        return sorted(states, key=lambda s: (s.state.stamp.frame, s.state.thread))

    def truths(self) -> list[Truth]:
        """Where the synthetic threads really were, by frame and thread; empty for real scenes."""
        rows = (row for row in self.rows("/rig/truth/**") if "frame" in row)
        truths = self._parsed(rows, _truth, "true threads")
        return sorted(truths, key=lambda t: (t.stamp.frame, t.thread))

    def requests(self, process: str) -> list[tuple[int, Request]]:
        """What was asked for while a process ran, in metres, and the frames at which it took effect."""
        rows = sorted(self.rows(f"/run/{process}/request"), key=lambda row: row["log_time"])
        return self._parsed(rows, lambda row: (row["frame"], _request(row)), "requests")

    def handled(self, process: str) -> set[int]:
        """The frames that a process worked on; empty without its recording."""
        found = self.series(f"/plots/latency_ms/{process}").values()
        return {int(frame) for frames, _ in found for frame in frames}

    def series(self, *contents: str) -> dict[str, tuple[Float64, Float64]]:
        """Plotted numbers by entity: ((n,) frames, (n,) or (n, k) values), by frame."""
        found: dict[str, list[tuple[int, Float64]]] = {}
        for row in self.rows(*contents):
            if "Scalars:scalars" in row:
                point = (row.get("frame", -1), row["Scalars:scalars"])
                found.setdefault(row["entity"], []).append(point)
        series = {}
        for entity, points in sorted(found.items()):
            points.sort(key=lambda p: p[0])
            values = np.array([value for _, value in points])
            series[entity] = (
                np.array([frame for frame, _ in points], float),
                values[:, 0] if values.shape[1] == 1 else values,
            )
        return series

    def frames(self) -> Iterator[StereoFrame]:
        """All recorded frames in order, each read when it is asked for; not released yet (0)."""
        for stamp, left, right in self._pairs("image", _image):
            yield StereoFrame(stamp, left, right)

    def fields(self) -> Iterator[RidgeField]:
        """All fields of a full recording in order, each read when it is asked for."""
        for stamp, (left, left_colours), (right, right_colours) in self._pairs("field", _field):
            own = {name: (left[name], right[name]) for name in left if name}
            colours = None
            if left_colours is not None and right_colours is not None:
                colours = left_colours, right_colours
            if own:
                yield joined(stamp, own, colours)
            else:
                yield RidgeField(stamp, left[""], right[""], colours=colours)

    def _parsed(self, rows: Iterable[Row], parse: Callable[[Row], T], what: str) -> list[T]:
        """The values in the rows; what a newer version wrote in another form is left out."""
        parsed, unknown = [], 0
        for row in rows:
            try:
                parsed.append(parse(row))
            except (KeyError, ValueError):
                unknown += 1
        problem = f"{unknown} {what} of an unknown form were left out"
        if unknown and problem not in self.problems:
            self.problems.append(problem)
        return parsed

    def _pairs(self, name: str, read: Callable[[Row], T | None]) -> Iterator[tuple[Stamp, T, T]]:
        """What both views recorded under a name, by frame; chunks come in the order of time."""
        waiting: dict[int, T] = {}
        for row in self.rows(f"/rig/left/{name}", f"/rig/right/{name}"):
            picture = read(row)
            if picture is None:
                continue
            other = waiting.pop(row["frame"], None)
            if other is None:
                waiting[row["frame"]] = picture
            else:
                pair = (picture, other) if "/left/" in row["entity"] else (other, picture)
                yield (Stamp(row["frame"], row["capture"], 0), *pair)

    def images(self, frames: Container[int]) -> dict[tuple[int, str], Image]:
        """The raw images of some frames, by frame and view ("left", "right"); BGR or gray."""
        found = {}
        for row in self.rows("/rig/left/image", "/rig/right/image"):
            image = _image(row) if row.get("frame") in frames else None
            if image is not None:
                found[row["frame"], row["entity"].split("/")[2]] = image
        return found

    def rig(self) -> StereoRig:
        """The cameras of the run.

        Raises:
            InputError: the recordings hold no calibration.
        """
        for row in self.rows("/run/calibration"):
            numbers = {k.split(":")[1]: v for k, v in row.items() if k.startswith("Calibration:")}
            left, right = (_camera(numbers, view) for view in ("left", "right"))
            width, height = numbers["image_size"].tolist()
            return StereoRig((width, height), left, right, float(numbers["metres_per_unit"][0]))
        raise InputError(f"{self.path}: no calibration in the recordings")

    def about(self) -> dict[str, Row]:
        """Versions, machine and level, by process."""
        return {
            row["entity"].split("/")[-1]: {
                key.split(":")[1]: value[0]
                for key, value in row.items()
                if key.startswith("About:")
            }
            for row in self.rows("/run/**")
            if "About:level" in row
        }

    def _open(self, file: Path) -> RrdReader | None:
        reader, reason = _reader(file)
        if reader is None:
            folder = Path(tempfile.mkdtemp(prefix="suturetrack-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            repaired = folder / file.name
            if _repair(file, repaired):
                reader, _ = _reader(repaired)
            if reader is None or not reader.recordings():
                self.problems.append(f"{file.name} is no recording ({reason})")
                return None
            self.problems.append(f"{file.name} is cut off; read up to there")
        owners = {entry.application_id for entry in reader.recordings()}
        if owners != {APPLICATION}:
            self.problems.append(f"{file.name} is a recording of {', '.join(owners) or 'nothing'}")
            return None
        return reader

    def _check_version(self) -> None:
        newest = max((a["recording_version"] for a in self.about().values()), default=0)
        if newest > RECORDING_VERSION:
            self.problems.append(
                f"recorded by a newer suturetrack (version {newest} of the recording's form, "
                f"this one knows {RECORDING_VERSION}); read as far as it can be"
            )


def rerun_program() -> Path:
    """The Rerun viewer itself; `rerun` on the path only starts it, and would leave it behind."""
    spec = find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise InputError("the Rerun viewer is missing; it comes with rerun-sdk")
    return Path(spec.origin).with_name("rerun.exe" if os.name == "nt" else "rerun")


def _reader(file: Path) -> tuple[RrdReader | None, str]:
    with warnings.catch_warnings():
        # Without a footer, the file is scanned.
        warnings.simplefilter("ignore")
        try:
            reader = RrdReader(file)
            reader.recordings()
        except (RuntimeError, ValueError) as error:
            return None, _reason(error)
    return reader, ""


def _reason(error: Exception) -> str:
    """What Rerun says is wrong with a file, in one line, without the file."""
    line = str(error).partition("\n")[0]
    return re.sub(r"^Failed to read RRD file at .*?\.rrd: ", "", line)


def _repair(file: Path, repaired: Path) -> bool:
    """Copies what is whole in a file that ends in the middle of a message."""
    command = [str(rerun_program()), "rrd", "merge", str(file), "-o", str(repaired)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def _batches(
    file: Path, reader: RrdReader, contents: Sequence[str]
) -> Iterator[tuple[str, pa.RecordBatch]]:
    """The chunks of one recording, with their entities; raises InputError."""
    try:
        for chunk in reader.stream().filter(content=list(contents)):
            yield str(chunk.entity_path), chunk.to_record_batch()
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{file} is damaged ({_reason(error)}); move it out of the folder to have the rest read"
        ) from error


def _rows(entity: str, batch: pa.RecordBatch) -> Iterator[Row]:
    columns = dict(zip(batch.schema.names, batch.columns, strict=True))
    for i in range(batch.num_rows):
        row: Row = {"entity": entity}
        for name, column in columns.items():
            if column[i].is_valid:
                row[name] = _value(column[i])
        yield row


def _value(scalar: pa.Scalar) -> Any:
    if isinstance(scalar, pa.ListScalar):
        return _array(scalar.values)
    return scalar.value if isinstance(scalar, pa.TimestampScalar) else scalar.as_py()


def _array(values: pa.Array) -> Any:
    """NumPy arrays for lists of numbers and of vectors; lists of them for lists of lists."""
    if pa.types.is_fixed_size_list(values.type):
        flat = values.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(values), values.type.list_size)
    if pa.types.is_list(values.type):
        return [_array(inner.values) for inner in values]
    if pa.types.is_nested(values.type):
        return values.to_pylist()
    return values.to_numpy(zero_copy_only=False)


def _image(row: Row) -> Image | None:
    if "EncodedImage:blob" in row:
        blob = np.asarray(row["EncodedImage:blob"][0], np.uint8)
        return np.asarray(cv2.imdecode(blob, cv2.IMREAD_UNCHANGED), np.uint8)
    if "Image:buffer" in row:
        form = row["Image:format"][0]
        pixels = np.asarray(row["Image:buffer"][0], np.uint8)
        return pixels.reshape(form["height"], form["width"], -1).squeeze()
    return None


def _field(row: Row) -> tuple[dict[str, Float32], Colours | None] | None:
    """The fields of several threads, by name, or under no name that of all; and the colours."""
    if "RidgeField:vectors" not in row:
        return None
    vectors = row["RidgeField:vectors"].reshape(-1, *row["RidgeField:shape"])
    fields = dict(zip(row.get("RidgeField:threads", ("",)), vectors, strict=True))
    if "RidgeField:pixels" not in row:
        return fields, None
    pixels, bgr = row["RidgeField:pixels"].reshape(-1, 2), row["RidgeField:bgr"].reshape(-1, 3)
    return fields, Colours(pixels, bgr)


def _part(file: Path) -> tuple[str, int]:
    """Sorts the parts of a process by their numbers."""
    process, _, number = file.stem.partition(".")
    return process, int(number) if number.isdecimal() else 0


def _stamp(row: Row, kind: str) -> Stamp:
    return Stamp(
        int(row["frame"]), int(row[f"{kind}:capture_ns"][0]), int(row[f"{kind}:released_ns"][0])
    )


def _state(row: Row) -> RecordedState:
    numbers = {k.split(":")[1]: v for k, v in row.items() if k.startswith("ThreadState:")}
    curve = None
    if "knots" in numbers:
        points = numbers["control_points"].reshape(-1, 3)
        curve = Nurbs(int(numbers["degree"][0]), numbers["knots"], points, numbers["weights"])
    names = ("image_left", "image_right", "end", "internal")
    state = ThreadState(
        stamp=_stamp(row, "ThreadState"),
        thread=str(numbers["thread"][0]),
        status=Status(numbers["status"][0]),
        curve=curve,
        length=float(numbers["length"][0]),
        energies=Energies(*(float(numbers[name][0]) for name in names)),
        sigma=numbers["sigma"],
        seen=numbers["seen"],
        events=tuple(numbers.get("events", ())),
    )
    return RecordedState(state, int(numbers["published_ns"][0]))


def _request(row: Row) -> Request:
    def place(name: str) -> Any:
        return tuple(row[name].tolist()) if name in row else None

    thread = str(row["Request:thread"][0])
    if row["Request:kind"][0] == "Forget":
        return Forget(thread)
    return Seed(thread, place("Request:pixel"), place("Request:point"))


def _truth(row: Row) -> Truth:
    return Truth(
        stamp=_stamp(row, "Truth"),
        thread=str(row["Truth:thread"][0]),
        points=np.array(row["LineStrips3D:strips"][0], float),
        length=float(row["Truth:length"][0]),
        visible=row["Truth:visible"],
    )


def _camera(numbers: Row, view: str) -> Camera:
    shapes: Sequence[tuple[str, tuple[int, ...]]] = (
        ("matrix", (3, 3)),
        ("distortion", (-1,)),
        ("rectification", (3, 3)),
        ("projection", (3, 4)),
    )
    arrays = {name: numbers[f"{view}_{name}"].reshape(shape) for name, shape in shapes}
    return Camera(**arrays, fisheye=bool(np.any(numbers.get(f"{view}_fisheye", False))))

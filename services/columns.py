"""Rows that wait to be written, entity by entity: many in one chunk cost little more than one."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from services.drawing import Entry, Row
from suturetrack.types import Stamp

_LARGEST_BYTES = 1 << 20
"""Of what waits for one entity; images and fields are as large and do not wait."""
_Times = tuple[int, int, int, int]
"""log_time and capture, ns; frame, growth."""


class _Made:
    """The parts of an archetype, in Rerun's interface."""

    def __init__(self, archetype: Any):
        batches = archetype.as_component_batches()
        self.descriptors = [batch.component_descriptor() for batch in batches]
        self.arrays = [batch.as_arrow_array() for batch in batches]


@dataclass
class _Table:
    """Rows with the same components."""

    stamped: bool
    growing: bool
    times: list[_Times] = field(default_factory=list)
    rows: list[list[Row | _Made]] = field(default_factory=list)
    bytes: int = 0

    def indexes(self) -> list[rr.TimeColumn]:
        now, capture, frame, growth = np.array(self.times, np.int64).T
        indexes = [rr.TimeColumn("log_time", timestamp=now.view("datetime64[ns]"))]
        if self.stamped:
            indexes.append(rr.TimeColumn("frame", sequence=frame))
            indexes.append(rr.TimeColumn("capture", timestamp=capture.view("datetime64[ns]")))
        if self.growing:
            indexes.append(rr.TimeColumn("growth", sequence=growth))
        return indexes

    def columns(self) -> list[rr.ComponentColumn]:
        return [column for parts in zip(*self.rows, strict=True) for column in _columns(parts)]


class _Values:
    """Arrow arrays as one, in Rerun's interface."""

    def __init__(self, arrays: Sequence[pa.Array]):
        self._whole = arrays[0] if len(arrays) == 1 else pa.concat_arrays(arrays)

    def component_type(self) -> str | None:
        return None

    def as_arrow_array(self) -> pa.Array:
        return self._whole


def _columns(parts: Sequence[Any]) -> Iterator[rr.ComponentColumn]:
    """The columns of parts that are alike, one a row."""
    if isinstance(parts[0], _Made):
        arrays = zip(*(part.arrays for part in parts), strict=True)
        for what, column in zip(parts[0].descriptors, arrays, strict=True):
            yield rr.ComponentColumn(what, _Values(column), lengths=[len(a) for a in column])
        return
    for batch in Row.joined(parts).as_component_batches():
        what = batch.component_descriptor()
        name = what.component.rpartition(":")[2]
        lengths = [len(part.components[name]) for part in parts]
        yield rr.ComponentColumn(what, _Values([batch.as_arrow_array()]), lengths=lengths)


def _kind(part: Row | _Made) -> tuple[Any, ...]:
    """What parts that go into the same columns have in common."""
    if isinstance(part, Row):
        return part.archetype, *part.components
    return *part.descriptors, *(array.type for array in part.arrays)


def _bytes(part: Row | _Made) -> int:
    """Of the arrays; the lists of rows are short."""
    arrays = part.arrays if isinstance(part, _Made) else part.components.values()
    return sum(getattr(array, "nbytes", 0) for array in arrays)


class Columns:
    """What waits to be written to a stream; `send` writes it."""

    def __init__(self, stream: rr.RecordingStream):
        self._stream = stream
        self._tables: dict[Any, _Table] = {}

    def add(self, stamp: Stamp | None, entries: Iterable[Entry], growth: int | None = None) -> None:
        """Adds a row an entry, at the time of `stamp` and at a step of the timeline `growth`."""
        now = time.time_ns()
        for entity, *what in entries:
            parts = [part if isinstance(part, Row) else _Made(part) for part in what]
            key = (entity, stamp is None, growth is None, *map(_kind, parts))
            table = self._tables.get(key)
            if table is None:
                table = self._tables[key] = _Table(stamp is not None, growth is not None)
            capture, frame = (0, 0) if stamp is None else (stamp.capture_ns, stamp.frame)
            table.times.append((now, capture, frame, growth or 0))
            table.rows.append(parts)
            table.bytes += sum(map(_bytes, parts))
            if table.bytes > _LARGEST_BYTES:
                self._send(entity, self._tables.pop(key))

    def send(self) -> None:
        """Writes all that waits."""
        for key in list(self._tables):
            self._send(key[0], self._tables.pop(key))

    def _send(self, entity: str, table: _Table) -> None:
        rr.send_columns(entity, table.indexes(), table.columns(), recording=self._stream)

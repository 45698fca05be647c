"""Rows that wait to be written, entity by entity: many in one chunk cost little more than one."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from services.drawing import Entry
from suturetrack.types import Stamp

_LARGEST_BYTES = 1 << 20
"""Of what waits for one entity; images and fields are as large and do not wait."""
_Times = tuple[int, int, int, int]
"""log_time and capture, ns; frame, growth."""


@dataclass
class _Table:
    """Rows with the same components."""

    descriptors: list[rr.ComponentDescriptor]
    stamped: bool
    growing: bool
    times: list[_Times] = field(default_factory=list)
    rows: list[list[pa.Array]] = field(default_factory=list)
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
        return [
            rr.ComponentColumn(what, _Values(arrays), lengths=[len(array) for array in arrays])
            for what, *arrays in zip(self.descriptors, *self.rows, strict=True)
        ]


class _Values:
    """Arrow arrays as one, in Rerun's interface."""

    def __init__(self, arrays: list[pa.Array]):
        self._whole = arrays[0] if len(arrays) == 1 else pa.concat_arrays(arrays)

    def component_type(self) -> str | None:
        return None

    def as_arrow_array(self) -> pa.Array:
        return self._whole


class Columns:
    """What waits to be written to a stream; `send` writes it."""

    def __init__(self, stream: rr.RecordingStream):
        self._stream = stream
        self._tables: dict[Any, _Table] = {}

    def add(self, stamp: Stamp | None, entries: Iterable[Entry], growth: int | None = None) -> None:
        """Adds a row an entry, at the time of `stamp` and at a step of the timeline `growth`."""
        now = time.time_ns()
        for entity, *what in entries:
            batches = [batch for part in what for batch in part.as_component_batches()]
            descriptors = [batch.component_descriptor() for batch in batches]
            arrays = [batch.as_arrow_array() for batch in batches]
            shape = (*descriptors, *(array.type for array in arrays))
            key = (entity, stamp is None, growth is None, *shape)
            table = self._tables.get(key)
            if table is None:
                table = _Table(descriptors, stamp is not None, growth is not None)
                self._tables[key] = table
            capture, frame = (0, 0) if stamp is None else (stamp.capture_ns, stamp.frame)
            table.times.append((now, capture, frame, growth or 0))
            table.rows.append(arrays)
            table.bytes += sum(array.nbytes for array in arrays)
            if table.bytes > _LARGEST_BYTES:
                self._send(entity, self._tables.pop(key))

    def send(self) -> None:
        """Writes all that waits."""
        for key in list(self._tables):
            self._send(key[0], self._tables.pop(key))

    def _send(self, entity: str, table: _Table) -> None:
        rr.send_columns(entity, table.indexes(), table.columns(), recording=self._stream)

"""Each process's own Rerun recording of what it saw and decided.

The stream writes to a file and nowhere else, so that no viewer can slow or stop the process.
"""

from __future__ import annotations

import logging
import platform
import time
import uuid
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services import blueprint, drawing
from services.drawing import Entry, Level
from services.messages import Health
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.types import (
    Float64,
    InputError,
    RidgeField,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

APPLICATION = "suturetrack"
RECORDING_VERSION = 1
"""Grows when an older reader could misread a recording."""

_log = logging.getLogger(__name__)
_LONGEST_FLUSH_SECONDS = 0.05
_STALLED_FLUSHES = 30


class Recorder:
    """Writes `<run_dir>/<process>.rrd`; nothing at all without a run folder.

    A recording that cannot go on (full disk, removed folder) is closed with a loud message and a
    `problem`, while the process goes on. Long runs roll over into parts `<process>.1.rrd`, ...;
    so does a process that was started again.
    """

    problem: str | None = None
    """Why nothing is recorded any more."""

    def __init__(
        self,
        run_dir: Path | None,
        process: str,
        level: Level,
        rig: StereoRig,
        config: object = None,
        flush_seconds: float = 1.0,
        part_bytes: int = 1 << 30,
    ) -> None:
        """Opens the file and writes what does not change: cameras, versions and parameters.

        Args:
            run_dir: made when missing; None records nothing.
            process: name of the process.
            level: "light" (JPEG) or "full" (lossless images and fields).
            rig: the calibrated cameras.
            config: the process's parameters, a dataclass.
            flush_seconds: what a killed process loses at most.
            part_bytes: size at which the next part begins.

        Raises:
            InputError: the file cannot be made.
        """
        self.process, self._level, self._rig = process, level, rig
        self._config, self._flush_seconds, self._part_bytes = config, flush_seconds, part_bytes
        self._statuses: dict[str, Status | None] = {}
        self._target: Float64 | None = None
        self._stream: rr.RecordingStream | None = None
        self._stamp: Stamp | None = None
        self._flushed = time.monotonic()
        self._stalls = 0
        if run_dir is None:
            return
        self._run_dir = Path(run_dir)
        try:
            self._run_dir.mkdir(parents=True, exist_ok=True)
            # One name for all processes of the run makes their files one recording.
            run = uuid.uuid5(uuid.NAMESPACE_URL, str(self._run_dir.resolve()))
            self._stream = rr.RecordingStream(APPLICATION, recording_id=str(run))
            self._open_part()
        except (OSError, RuntimeError) as error:
            raise InputError(f"recording: cannot write to {run_dir}: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.close()

    def frame(self, frame: StereoFrame, published_ns: int | None = None) -> None:
        """Records both images; `published_ns` is now when not given."""
        if self._stream is not None:
            self._write(frame.stamp, drawing.frame(frame, self._level))
            self._latency(frame.stamp, published_ns)

    def field(self, field: RidgeField, published_ns: int | None = None) -> None:
        """Records both fields."""
        if self._stream is not None:
            self._write(field.stamp, drawing.field(field, self._rig, self._level))
            self._latency(field.stamp, published_ns)

    def states(self, states: Sequence[ThreadState], published_ns: int | None = None) -> None:
        """Records the states of all threads at one frame; lengths in the calibration's unit."""
        if self._stream is None or not states:
            return
        for state in states:
            self._introduce(state)
        stamp, published_ns = states[0].stamp, published_ns or time.time_ns()
        self._write(stamp, drawing.states(states, self._rig, published_ns))
        self._latency(stamp, published_ns)
        for state in states:
            self._tell(state)

    def initialization(
        self, stamp: Stamp, thread: str, result: Initialization | InitializationError
    ) -> None:
        """Records how a thread was looked for in one field; the timeline `growth` counts the steps."""
        if self._stream is None:
            return
        for step, entries in enumerate(self._growth(thread, result), 1):
            self._stream.set_time("growth", sequence=step)
            self._write(stamp, entries)
        self._stream.disable_timeline("growth")
        if isinstance(result, InitializationError):
            self._write(stamp, drawing.failure(thread, result.candidates, self._rig))
            self.log(f"thread {thread} not found: {result.reason}", "WARN")
        else:
            found = f"thread {thread} found with confidence {result.confidence:.2f}"
            self.log("; ".join((found, *result.reasons)))

    def truth(self, truth: Truth) -> None:
        """Records where a synthetic thread really is."""
        if self._stream is not None:
            self._write(truth.stamp, drawing.truth(truth))

    def health(self, health: Health) -> None:
        """Records the process's heartbeat, at its newest frame."""
        quantities = ("rate_hz", "dropped", "memory_mb")
        self._write(
            health.stamp,
            (
                (f"/plots/{name}/{self.process}", rr.Scalars(getattr(health, name)))
                for name in quantities
            ),
        )

    def log(self, text: str, level: str = "INFO") -> None:
        """Records a line of the process's log (DEBUG, INFO, WARN, ERROR), at the newest frame."""
        self._write(
            self._stamp,
            [(f"/log/{self.process}", rr.TextLog(f"{self.process}: {text}", level=level))],
        )

    def _flush_if_due(self) -> None:
        """When it is time: sends to the disk what is waiting, begins a new part, looks for trouble."""
        if self._stream is None or time.monotonic() - self._flushed < self._flush_seconds:
            return
        self._flushed = time.monotonic()
        trouble = self._flush(self._stream)
        if trouble:
            self.problem = f"recording stopped: {trouble} ({self._path})"
            _log.error("%s; everything else goes on", self.problem)
            self.close()
        elif self._path.stat().st_size >= self._part_bytes:
            self._open_part()

    def close(self) -> None:
        """Completes the file; nothing is recorded afterwards."""
        if self._stream is not None:
            self._stream.disconnect()
        self._stream = None

    def _write(self, stamp: Stamp | None, entries: Iterable[Entry]) -> None:
        if self._stream is None:
            return
        if stamp is not None:
            self._stamp = stamp
            # Times belong to the calling thread, so they are set on every call.
            self._stream.set_time("frame", sequence=stamp.frame)
            self._stream.set_time("capture", timestamp=np.datetime64(stamp.capture_ns, "ns"))
        for entity, *what in entries:
            self._stream.log(entity, *what)
        self._flush_if_due()

    def _write_static(self, entries: Iterable[Entry]) -> None:
        assert self._stream is not None
        for entity, *what in entries:
            self._stream.log(entity, *what, static=True)

    def _flush(self, stream: rr.RecordingStream) -> str | None:
        try:
            stream.flush(timeout_sec=_LONGEST_FLUSH_SECONDS)
            self._stalls = 0
        except RuntimeError as error:
            self._stalls += 1
            if "timed out" not in str(error):
                return "the disk is full or cannot be written"
            if self._stalls >= _STALLED_FLUSHES:
                return "the disk is too slow"
        return None if self._path.exists() else "the file or its folder was removed"

    def _latency(self, stamp: Stamp, published_ns: int | None) -> None:
        latency_ms = ((published_ns or time.time_ns()) - stamp.released_ns) / 1e6
        self._write(stamp, [(f"/plots/latency_ms/{self.process}", rr.Scalars(latency_ms))])

    def _growth(
        self, thread: str, result: Initialization | InitializationError
    ) -> Iterable[list[Entry]]:
        return () if result.growth is None else drawing.growth(thread, result.growth, self._rig)

    def _introduce(self, state: ThreadState) -> None:
        assert self._stream is not None
        if state.thread not in self._statuses:
            self._statuses[state.thread] = None
            self._write_static(drawing.thread_style(state.thread))
            self._target = None
        if self._target is None and state.curve is not None:
            self._target = nurbs.evaluate(state.curve, np.array([0.5]))[0]
            self._stream.send_blueprint(self._blueprint())

    def _tell(self, state: ThreadState) -> None:
        """The state's events and changes of status in words."""
        name = f"thread {state.thread}"
        for event in state.events:
            # Control points come and go all the time, which their plot shows better.
            self.log(f"{name}: {event}", "DEBUG" if event.startswith("control points") else "INFO")
        if state.status != self._statuses[state.thread]:
            self._statuses[state.thread] = state.status
            self.log(f"{name}: {state.status}", "WARN" if state.status is Status.LOST else "INFO")

    def _blueprint(self) -> rrb.Blueprint:
        ahead = np.array([0.0, 0.0, 10 * self._rig.baseline])
        target = ahead if self._target is None else self._target
        return blueprint.blueprint(list(self._statuses), target)

    def _open_part(self) -> None:
        """Directs the stream to the next free file; every part explains itself."""
        assert self._stream is not None
        name, number = self._run_dir / f"{self.process}.rrd", 0
        while name.exists():
            number += 1
            name = self._run_dir / f"{self.process}.{number}.rrd"
        self._path = name
        sink = rr.FileSink(str(name))
        self._stream.set_sinks(sink, default_blueprint=self._blueprint())
        self._stream.send_recording_name(self._run_dir.name)
        self._stream.reset_time()
        self._write_static(drawing.cameras(self._rig))
        self._write_static(drawing.process_style(self.process))
        self._write_static(self._about())
        for thread in self._statuses:
            self._write_static(drawing.thread_style(thread))

    def _about(self) -> list[Entry]:
        about: dict[str, Any] = {
            "recording_version": RECORDING_VERSION,
            "level": self._level,
            "started_ns": time.time_ns(),
            "machine": f"{platform.node()}, {platform.machine()}, {platform.system()}",
            "python": platform.python_version(),
            **{p: version(p) for p in ("suturetrack", "numpy", "opencv-python-headless")},
        }
        settings = {} if self._config is None else msgspec.to_builtins(self._config, enc_hook=str)
        text = msgspec.yaml.encode(settings).decode()
        return [
            (f"/run/{self.process}", drawing.values("About", about)),
            (f"/run/{self.process}/parameters", rr.TextDocument(text)),
        ]

"""Values into a Rerun stream, at their time, one function a type."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services import drawing
from services.blueprint import blueprint
from services.columns import Columns
from services.drawing import Entry, Level
from services.messages import Forget, Health
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.types import (
    Float64,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

Request = Seed | Forget
"""What an operator asks of the processes, lengths in metres."""
_LANE_FRAMES = 10


class Writer:
    """What one process sees and decides, written to a stream; to none once it is closed."""

    def __init__(
        self, stream: rr.RecordingStream, process: str, level: Level, rig: StereoRig
    ) -> None:
        self.process, self.level, self.rig = process, level, rig
        self.stream: rr.RecordingStream | None = stream
        self.columns = Columns(stream)
        self._stamp: Stamp | None = None
        self._statuses: dict[str, Status | None] = {}
        self._before: dict[str, ThreadState] = {}
        self._marked: dict[str, int] = {}
        self._seeds: dict[str, Seed] = {}
        self._seeded: set[str] = set()
        self._true: set[str] = set()
        self._seen: Float64 | None = None

    def describe(self) -> None:
        """Writes what does not change: cameras, and the look of what was introduced so far."""
        self.write_static(drawing.cameras(self.rig))
        self.write_static(drawing.process_style(self.process))
        self.write_static(drawing.overlay_style())
        for thread in self._statuses:
            self.write_static(drawing.thread_style(thread))
        for thread in self._true:
            self.write_static(drawing.truth_style(thread))

    def frame(self, frame: StereoFrame, published_ns: int | None = None) -> None:
        """Records both images; `published_ns` is now when not given."""
        if self.stream is not None:
            self.write(frame.stamp, drawing.frame(frame, self.level))
            self._latency(frame.stamp, published_ns)

    def field(self, field: RidgeField, published_ns: int | None = None) -> None:
        """Records both fields."""
        if self.stream is not None:
            self.write(field.stamp, drawing.field(field, self.rig, self.level))
            self._latency(field.stamp, published_ns)

    def states(self, states: Sequence[ThreadState], published_ns: int | None = None) -> None:
        """Records the states of all threads at one frame; lengths in the calibration's unit."""
        if self.stream is None or not states:
            return
        for state in states:
            self._introduce(state)
        stamp, published_ns = states[0].stamp, published_ns or time.time_ns()
        self.write(stamp, drawing.states(states, self._before, self.rig, published_ns))
        self._latency(stamp, published_ns)
        for state in states:
            self._tell(state)
            self._mark(state)
            self._before[state.thread] = state

    def passed(self, stamp: Stamp, published_ns: int) -> None:
        """Records that a frame was worked on while there was no thread."""
        self._latency(stamp, published_ns)

    def request(self, stamp: Stamp, request: Request) -> None:
        """Records what was asked for while the process ran, in metres, at the frame it took effect."""
        # In metres, as it came: a replay to the bit must not round it.
        numbers = {key: value for key, value in vars(request).items() if value is not None}
        kind = type(request).__name__
        entity = f"/run/{self.process}/request"
        self.write(stamp, [(entity, drawing.values("Request", {"kind": kind, **numbers}))])
        self.log(f"{kind.lower()} for thread {request.thread} came")

    def initializations(
        self,
        field: RidgeField,
        seeds: Mapping[str, Seed],
        results: Mapping[str, Initialization | InitializationError],
    ) -> None:
        """Records how threads were looked for in one field; the timeline `growth` counts the steps."""
        if self.stream is None or not results:
            return
        self.write(field.stamp, drawing.cleared(field, self.rig))
        for thread, result in results.items():
            seed = seeds.get(thread)
            if seed is not None:
                self.write(field.stamp, drawing.seed(seed, self.rig))
                if seed is not self._seeds.get(thread):
                    self._seeds[thread] = seed
                    self._seeded.add(thread)
            self._initialization(field.stamp, thread, result)

    def truth(self, truth: Truth) -> None:
        """Records where a synthetic thread really is."""
        if self.stream is None:
            return
        if truth.thread not in self._true:
            self._true.add(truth.thread)
            self.write_static(drawing.truth_style(truth.thread))
        self.write(truth.stamp, drawing.truth(truth, self.rig))

    def health(self, health: Health) -> None:
        """Records the process's heartbeat, at its newest frame."""
        quantities = ("rate_hz", "dropped", "memory_mb")
        self.write(
            health.stamp,
            (
                (f"/plots/{name}/{health.process}", rr.Scalars(getattr(health, name)))
                for name in quantities
            ),
        )

    def log(self, text: str, level: str = "INFO") -> None:
        """Records a line of the process's log (DEBUG, INFO, WARN, ERROR), at the newest frame."""
        self.write(
            self._stamp,
            [(f"/log/{self.process}", rr.TextLog(f"{self.process}: {text}", level=level))],
        )

    def layout(self) -> rrb.Blueprint:
        """How the viewer shows the threads that were introduced so far."""
        ahead = self.rig.baseline * np.array([[-2.0, -2.0, 8.0], [2.0, 2.0, 12.0]])
        return blueprint(list(self._statuses), ahead if self._seen is None else self._seen)

    def write(
        self, stamp: Stamp | None, entries: Iterable[Entry], growth: int | None = None
    ) -> None:
        """Writes entries at the time of `stamp`, and at a step of the timeline `growth`."""
        if self.stream is None:
            return
        if stamp is not None:
            self._stamp = stamp
        self.columns.add(stamp, entries, growth)
        self.pass_on()

    def pass_on(self) -> None:
        """Sends what was written on its way, at once."""
        self.columns.send()

    def write_static(self, entries: Iterable[Entry]) -> None:
        """Writes entries that hold at all times."""
        assert self.stream is not None
        for entity, *what in entries:
            self.stream.log(entity, *what, static=True)

    def _latency(self, stamp: Stamp, published_ns: int | None) -> None:
        latency_ms = ((published_ns or time.time_ns()) - stamp.released_ns) / 1e6
        self.write(
            stamp,
            [(f"/plots/latency_ms/{self.process}", drawing.row(rr.Scalars, scalars=latency_ms))],
        )

    def _initialization(
        self, stamp: Stamp, thread: str, result: Initialization | InitializationError
    ) -> None:
        if result.growth is not None:
            for step, entries in enumerate(drawing.growth(thread, result.growth, self.rig), 1):
                self.write(stamp, entries, growth=step)
        self.write(stamp, drawing.outcome(stamp, thread, result))
        if isinstance(result, InitializationError):
            self.write(stamp, drawing.failure(thread, result.candidates, self.rig))
            self.log(f"thread {thread} not found: {result.reason}", "WARN")
        else:
            found = f"thread {thread} found with confidence {result.confidence:.2f}"
            self.log("; ".join((found, *result.reasons)))

    def _mark(self, state: ThreadState) -> None:
        """The state's events on the plots, and in their lane for as long as it takes to see them."""
        frame, thread = state.stamp.frame, state.thread
        happened = drawing.kinds(state, seeded=thread in self._seeded)
        self._seeded.discard(thread)
        if happened:
            self.write(state.stamp, drawing.marks(state, happened))
            self.write(state.stamp, drawing.lane(thread, happened[0]))
            self._marked[thread] = frame
        elif frame - self._marked.get(thread, frame) >= _LANE_FRAMES:
            del self._marked[thread]
            self.write(state.stamp, drawing.lane(thread, None))

    def _introduce(self, state: ThreadState) -> None:
        assert self.stream is not None
        if state.thread not in self._statuses:
            self._statuses[state.thread] = None
            self.write_static(drawing.thread_style(state.thread))
            self._seen = None
        if self._seen is None and state.curve is not None:
            self._seen = state.curve.control_points
            self.stream.send_blueprint(self.layout())

    def _tell(self, state: ThreadState) -> None:
        """The state's events and changes of status in words."""
        name = f"thread {state.thread}"
        for event in state.events:
            # Control points come and go all the time, which their plot shows better.
            self.log(f"{name}: {event}", "DEBUG" if event.startswith("control points") else "INFO")
        if state.status != self._statuses[state.thread]:
            self._statuses[state.thread] = state.status
            self.log(f"{name}: {state.status}", "WARN" if state.status is Status.LOST else "INFO")

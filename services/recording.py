"""Each process's own Rerun recording of what it saw and decided.

The stream writes to a file and nowhere else, from a thread of its own, so that neither a viewer nor a
disk can slow or stop the process.
"""

from __future__ import annotations

import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import rerun as rr

from services.drawing import Level
from services.messages import Health
from services.run_file import RunFile
from services.writer import Request
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.types import RidgeField, Seed, Stamp, StereoFrame, ThreadState, Truth

_log = logging.getLogger(__name__)
_BACKLOG = 32
"""Values that may wait for the disk."""
_PICTURE_NS = 90_000_000
"""From one picture of the fields to the next, where it is all that is kept of them: ten a second."""
_TURN_SECONDS = 5e-4
_NICE = 5
"""By how much the recording thread gives way to the loops of all processes."""
_STALL_SECONDS = 5.0
_CLOSING_SECONDS = 10.0


class Recorder:
    """Records one process's values to `<run_dir>/<process>.rrd`; nothing without a run folder.

    Every function returns at once and may be given buffers that are used again. When the disk cannot
    keep up, values are left out and counted; when it fails, recording ends with a loud message. Either
    way there is a `problem`, and the process goes on.
    """

    def __init__(
        self,
        run_dir: Path | None,
        process: str,
        level: Level,
        rig: StereoRig,
        config: object = None,
        *,
        patient: bool = True,
        flush_seconds: float = 0.3,
        part_bytes: int = 1 << 30,
    ) -> None:
        """Opens the file and writes what does not change: cameras, versions and parameters.

        Args:
            run_dir: made when missing; None records nothing.
            process: name of the process.
            level: "light" (JPEG) or "full" (lossless images and fields).
            rig: the calibrated cameras.
            config: the process's parameters, a dataclass.
            patient: wait for a slow disk rather than leave something out.
            flush_seconds: a killed process loses this, and what was being written.
            part_bytes: size at which the next part begins.

        Raises:
            InputError: the file cannot be made.
        """
        self.process = process
        self.left_out = 0
        """Values that were not recorded because the disk could not keep up."""
        self._level, self._pictured = level, float("-inf")
        self._patient, self._pause = patient, max(flush_seconds, 0.01)
        self._stuck = False
        self._busy_since: float | None = None
        self._file: RunFile | None = None
        if run_dir is None:
            return
        # The loop, which does not wait for the recording thread, gets its turn at once.
        sys.setswitchinterval(_TURN_SECONDS)
        self._file = RunFile(run_dir, process, level, rig, config, flush_seconds, part_bytes)
        self._tasks: queue.Queue[Callable[[RunFile], None] | None] = queue.Queue(_BACKLOG)
        self._worker = threading.Thread(
            target=self._work, args=(self._file,), name="recording", daemon=True
        )
        self._worker.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def fault(self) -> str | None:
        """Why nothing is recorded any more, in words."""
        if self._file is None:
            return None
        if self._file.problem is not None:
            return self._file.problem
        if self._stuck or self._is_stuck():
            return f"recording stopped: the disk is full or too slow ({self.process})"
        return None

    @property
    def problem(self) -> str | None:
        """What is wrong with the recording, in words."""
        lacks = f"{self.left_out} values not recorded: the disk is slow" if self.left_out else None
        return self.fault or (lacks if self._file is not None else None)

    def frame(self, frame: StereoFrame, published_ns: int | None = None) -> None:
        """Records both images; `published_ns` is now when not given."""
        if self._file is not None:
            copy = replace(frame, left=frame.left.copy(), right=frame.right.copy())
            at = published_ns or time.time_ns()
            self._hand_over(lambda file: file.frame(copy, at))

    def field(self, field: RidgeField, published_ns: int | None = None) -> None:
        """Records both fields: all of them (full), or a picture ten times a second (light)."""
        at = published_ns or time.time_ns()
        since_ns = abs(field.stamp.capture_ns - self._pictured)
        if self._level == "light" and since_ns < _PICTURE_NS:
            self.passed(field.stamp, at)
        elif self._file is not None:
            self._pictured = field.stamp.capture_ns
            copy = _copied(field if self._level == "full" else replace(field, own={}))
            self._hand_over(lambda file: file.field(copy, at))

    def states(self, states: Sequence[ThreadState], published_ns: int | None = None) -> None:
        """Records the states of all threads at one frame; lengths in the calibration's unit."""
        at = published_ns or time.time_ns()
        self._hand_over(lambda file: file.states(states, at))

    def passed(self, stamp: Stamp, published_ns: int) -> None:
        """Records that a frame was worked on of which there is nothing else to record."""
        self._hand_over(lambda file: file.passed(stamp, published_ns))

    def request(self, stamp: Stamp, request: Request) -> None:
        """Records what was asked for while the process ran, in metres, at the frame it took effect."""
        self._hand_over(lambda file: file.request(stamp, request))

    def initializations(
        self,
        field: RidgeField,
        seeds: Mapping[str, Seed],
        results: Mapping[str, Initialization | InitializationError],
    ) -> None:
        """Records how threads were looked for in one field; the timeline `growth` counts the steps.

        To be called before `states` of the same frame. `seeds` are in the calibration's unit; a
        thread that is taken up again has none.
        """
        if results:
            copy = _copied(field)
            self._hand_over(lambda file: file.initializations(copy, seeds, results))

    def truth(self, truth: Truth) -> None:
        """Records where a synthetic thread really is."""
        self._hand_over(lambda file: file.truth(truth))

    def health(self, health: Health) -> None:
        """Records the process's heartbeat, at its newest frame."""
        self._hand_over(lambda file: file.health(health))

    def log(self, text: str, level: str = "INFO") -> None:
        """Records a line of the process's log (DEBUG, INFO, WARN, ERROR), at the newest frame."""
        self._hand_over(lambda file: file.log(text, level))

    def close(self) -> None:
        """Completes the file; nothing is recorded afterwards."""
        if self._file is None:
            return
        deadline = time.monotonic() + _CLOSING_SECONDS
        while self._worker.is_alive() and time.monotonic() < deadline and not self._gives_up():
            try:
                self._tasks.put(None, timeout=0.1)
                break
            except queue.Full:
                continue
        while self._worker.is_alive() and time.monotonic() < deadline and not self._gives_up():
            self._worker.join(0.1)
        if self._worker.is_alive():
            # What Rerun does at exit would wait for the same disk.
            rr.unregister_shutdown()
        self._file = None

    def _hand_over(self, task: Callable[[RunFile], None]) -> None:
        file = self._file  # which another thread may close
        if file is None or file.problem is not None:
            return
        while not self._gives_up():
            try:
                self._tasks.put(task, block=self._patient, timeout=0.1)
                return
            except queue.Full:
                if not self._patient:
                    break
        self.left_out += 1

    def _gives_up(self) -> bool:
        """Whether the disk has not answered for too long; says so once."""
        if not self._stuck and self._is_stuck():
            self._stuck = True
            if self._file is not None and self._file.problem is None:
                _log.error("%s; everything else goes on", self.problem)
        return self._stuck

    def _is_stuck(self) -> bool:
        since = self._busy_since
        return since is not None and time.monotonic() - since > _STALL_SECONDS

    def _work(self, file: RunFile) -> None:
        """The recording thread: one value after the other, and a look at the file in quiet times."""
        if sys.platform == "linux":  # elsewhere a thread has no priority of its own
            os.nice(_NICE)
        while True:
            try:
                task = self._tasks.get(timeout=self._pause)
            except queue.Empty:
                task = RunFile.pass_on
            self._busy_since = time.monotonic()
            (task or RunFile.close)(file)
            self._busy_since = None
            if task is None:
                return


def _copied(field: RidgeField) -> RidgeField:
    own = {name: (left.copy(), right.copy()) for name, (left, right) in field.own.items()}
    return replace(field, left=field.left.copy(), right=field.right.copy(), own=own)

"""A recording that is started and stopped from the page: `suturetrack record`, as a child process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path

from services.arguments import arguments_of
from services.output import fresh_folder
from services.record import RecordConfig
from services.service import ServiceConfig
from suturetrack.types import InputError

_BEGIN_S = 15.0
"""How long a recording may take until something of it lies in its folder."""
_LOOK_S = 0.05
_STOP_S = 15.0


class Recording:
    """At most one at a time; it ends with the console."""

    def __init__(self, rig: str, zenoh: Path | None):
        self._rig, self._zenoh = rig, zenoh
        self._lock = threading.Lock()
        self._child: subprocess.Popen[str] | None = None
        self._folder = Path()
        self._said = deque[str](maxlen=1)
        """The last line on the child's stderr."""
        self._listener = threading.Thread()
        self._closed = threading.Event()

    @property
    def folder(self) -> Path | None:
        """Where it is recorded to now."""
        child = self._child
        return self._folder if child is not None and child.poll() is None else None

    @property
    def problem(self) -> str:
        """Why it ended by itself, in words; empty when it did not."""
        child = self._child
        return self._failure(child) if child is not None and child.poll() else ""

    def start(self) -> Path:
        """Begins to record to a new folder, and returns when the recording lies there.

        Raises:
            InputError: it records already, or is about to; or nothing is recorded, and the text says why.
        """
        if not self._lock.acquire(blocking=False):
            raise InputError("a recording begins or ends already")
        try:
            if self.folder is not None:
                raise InputError(f"it is recorded already, to {self._folder}")
            self._child = None
            self._folder = fresh_folder("live")
            child = self._launch()
            self._wait_until_begun(child)
            self._child = child
            return self._folder
        finally:
            self._lock.release()

    def stop(self) -> Path:
        """Completes the recording; raises InputError when there is none, or it went wrong."""
        with self._lock:
            child, self._child = self._child, None
            if child is None:
                raise InputError("nothing is recorded")
            self._end(child)
            if child.returncode:
                raise InputError(self._failure(child))
            return self._folder

    def _launch(self) -> subprocess.Popen[str]:
        service = ServiceConfig(
            self._rig, self._zenoh, run_dir=self._folder.absolute(), parent=os.getpid()
        )
        options = arguments_of(RecordConfig(service))
        child = subprocess.Popen(
            [sys.executable, "-m", "services.cli", "record", *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        # A pipe that nobody reads would fill and hold the child up.
        self._said.clear()
        self._listener = threading.Thread(
            target=self._said.extend, args=(child.stderr,), daemon=True
        )
        self._listener.start()
        return child

    def _wait_until_begun(self, child: subprocess.Popen[str]) -> None:
        """Returns when something is recorded; else ends the child and raises InputError."""
        deadline = time.monotonic() + _BEGIN_S
        while not any(self._folder.glob("*.rrd")):
            ended = child.poll() is not None
            if not ended and time.monotonic() < deadline and not self._closed.wait(_LOOK_S):
                continue
            self._end(child)
            if ended:
                raise InputError(self._failure(child))
            raise InputError(f"the recording to {self._folder} did not begin; does a source run?")

    def _end(self, child: subprocess.Popen[str]) -> None:
        with child:
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
            try:
                child.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                child.kill()
            self._listener.join()

    def _failure(self, child: subprocess.Popen[str]) -> str:
        # Who was killed could not say why.
        explains = self._said and child.returncode > 0
        reason = self._said[0].strip() if explains else f"status {child.returncode}"
        return f"the recording to {self._folder} failed: {reason}"

    def close(self) -> None:
        """Completes what still runs."""
        self._closed.set()
        with self._lock:  # whoever waits for a beginning gives up first
            is_recorded = self.folder is not None
        if is_recorded:
            self.stop()

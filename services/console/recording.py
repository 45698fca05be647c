"""A recording that is started and stopped from the page: `suturetrack record`, as a child process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path

from services.arguments import arguments_of
from services.output import fresh_folder
from services.record import RecordConfig
from services.service import ServiceConfig
from suturetrack.types import InputError

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
        """Begins to record to a new folder; raises InputError when it records already."""
        with self._lock:
            if self.folder is not None:
                raise InputError(f"it is recorded already, to {self._folder}")
            self._folder = fresh_folder("live")
            service = ServiceConfig(
                self._rig, self._zenoh, run_dir=self._folder.absolute(), parent=os.getpid()
            )
            options = arguments_of(RecordConfig(service))
            self._child = subprocess.Popen(
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
                target=self._said.extend, args=(self._child.stderr,), daemon=True
            )
            self._listener.start()
            return self._folder

    def stop(self) -> Path:
        """Completes the recording; raises InputError when there is none, or it went wrong."""
        with self._lock:
            child, self._child = self._child, None
            if child is None:
                raise InputError("nothing is recorded")
            with child:
                if child.poll() is None:
                    child.send_signal(signal.SIGINT)
                try:
                    child.wait(_STOP_S)
                except subprocess.TimeoutExpired:
                    child.kill()
                self._listener.join()
            if child.returncode:
                raise InputError(self._failure(child))
            return self._folder

    def _failure(self, child: subprocess.Popen[str]) -> str:
        # Who was killed could not say why.
        explains = self._said and child.returncode > 0
        reason = self._said[0].strip() if explains else f"status {child.returncode}"
        return f"the recording to {self._folder} failed: {reason}"

    def close(self) -> None:
        """Completes what still runs."""
        if self.folder is not None:
            self.stop()

"""The processes of a run as children of the launcher."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

_STOP_S = 5.0
_STOPPED = (-signal.SIGTERM,)
"""Statuses of a process that was stopped before it could say goodbye."""


@dataclass(frozen=True)
class Launch:
    """One process to start."""

    name: str
    arguments: tuple[str, ...]


class Child:
    """A running process and the last that it said."""

    def __init__(self, launch: Launch, say: Callable[[str], None]):
        command = [sys.executable, "-m", "services.cli", launch.name, *launch.arguments]
        self.name = launch.name
        self._say = say
        self._prefix = f"suturetrack {launch.name}: "
        self._last: deque[str] = deque(maxlen=30)
        # A session of its own keeps Ctrl-C for the launcher, which stops all in order.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def status(self) -> int | None:
        """Exit status; negative for a signal; None while it runs."""
        return self._process.poll()

    def complaint(self) -> str:
        """Why it ended, in one line; what it said beyond that has been passed on."""
        self._listener.join(_STOP_S)
        last = self._last[-1] if self._last else ""
        if last.startswith(self._prefix):
            return last.removeprefix(self._prefix)
        status = self.status or 0
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the {self.name} {how}{': ' + last if last else ''}"

    def stop(self) -> None:
        """SIGTERM, and SIGKILL when that does not help."""
        if self.status is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._listener.join(_STOP_S)

    def _listen(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._last.append(line.rstrip())
            if not line.startswith(self._prefix):
                self._say(line.rstrip())


class Fleet:
    """Starts processes, watches them, stops them in the order in which they were named."""

    def __init__(self, launches: list[Launch], say: Callable[[str], None]):
        self._children: list[Child] = []
        try:
            for launch in reversed(launches):
                self._children.insert(0, Child(launch, say))
        except BaseException:
            self.stop()
            raise

    def has_ended(self) -> bool:
        """Whether any process has ended by itself."""
        return any(child.status is not None for child in self._children)

    def complaint(self) -> str | None:
        """Why the run failed; None when every process ended as it should."""
        failed = [child for child in self._children if child.status not in (None, 0, *_STOPPED)]
        return failed[0].complaint() if failed else None

    def stop(self) -> None:
        """Stops all that still run."""
        for child in self._children:
            child.stop()

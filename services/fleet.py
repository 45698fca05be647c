"""The processes of a run as children of the launcher, started again when they die."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

_STOP_S = 5.0
_STOPPED = (-signal.SIGTERM,)
"""Statuses of a process that was stopped before it could say goodbye."""
_MEMORY_S = 60.0
"""Deaths longer ago count neither towards the budget nor for the back-off."""
_BACK_OFF_S = 0.5
_LONGEST_BACK_OFF_S = 10.0


@dataclass(frozen=True)
class Launch:
    """One process to start."""

    name: str
    arguments: tuple[str, ...]


class Spare:
    """A process that has all loaded and waits to be told which one it is; see `services.spare`."""

    def __init__(self) -> None:
        self._process = _start("services.spare", stdin=subprocess.PIPE)

    def become(self, launch: Launch) -> subprocess.Popen[str]:
        """The process, on its way; a fresh one where the spare has died itself."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as told:
            told.write(json.dumps([launch.name, *launch.arguments]) + "\n")
            told.flush()
            if self._process.poll() is None:
                return self._process
        return _start("services.cli", launch.name, *launch.arguments)

    def stop(self) -> None:
        """Ends it, when it became nobody."""
        assert self._process.stdin is not None
        if not self._process.stdin.closed:
            self._process.kill()
            self._process.communicate()


class Child:
    """A running process and the last that it said."""

    def __init__(self, name: str, process: subprocess.Popen[str], say: Callable[[str], None]):
        self.name = name
        self._process = process
        self._say = say
        self._prefix = f"suturetrack {name}: "
        self._last: deque[str] = deque(maxlen=30)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def status(self) -> int | None:
        """Exit status; negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def was_refused(self) -> bool:
        """Whether it ended because what it was given is at fault, which another start cannot mend."""
        self._listener.join(_STOP_S)
        return self._final_line().startswith(self._prefix)

    def complaint(self) -> str:
        """Why it ended, in one line; what it said beyond that has been passed on."""
        self._listener.join(_STOP_S)
        last = self._final_line()
        if last.startswith(self._prefix):
            return last.removeprefix(self._prefix)
        status = self.status or 0
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the {self.name} {how}{': ' + last if last and status > 0 else ''}"

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

    def _final_line(self) -> str:
        return self._last[-1] if self._last else ""

    def _listen(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                self._last.append(line.rstrip())
                if not line.startswith(self._prefix):
                    self._say(line.rstrip())


class Post:
    """One place in the fleet, and who holds it."""

    def __init__(self, launch: Launch, say: Callable[[str], None]):
        self._launch, self._say = launch, say
        self._deaths: deque[float] = deque()
        self._starts = 0
        self._due: float | None = None
        self.child = Child(launch.name, _start("services.cli", launch.name, *launch.arguments), say)

    @property
    def is_vacant(self) -> bool:
        """Whether the process died and is to be started again later."""
        return self._due is not None

    def bury(self, budget: int) -> bool:
        """Plans the next start of a process that died; False when the budget is spent."""
        now = time.monotonic()
        while self._deaths and now - self._deaths[0] > _MEMORY_S:
            self._deaths.popleft()
        if len(self._deaths) >= budget:
            return False
        wait_s = _back_off(len(self._deaths))
        self._deaths.append(now)
        self._due = now + wait_s
        when = f"in {wait_s:g} s" if wait_s else "at once"
        count = f"{len(self._deaths)} of at most {budget} times a minute"
        self._say(
            f"suturetrack run: {self.child.complaint()}; it is started again {when} ({count})"
        )
        return True

    def refill(self, spare: Spare) -> bool:
        """Starts the process again when it is due; whether the spare was used."""
        if self._due is None or time.monotonic() < self._due:
            return False
        self._due = None
        self._starts += 1
        resume = ("--resume", str(self._starts))
        launch = Launch(self._launch.name, (*self._launch.arguments, *resume))
        self.child = Child(launch.name, spare.become(launch), self._say)
        return True


class Fleet:
    """Starts processes, starts those that die again, stops them in the order in which they were named.

    Args:
        launches: what to start.
        say: told what a person should know, line by line.
        budget: how often each process is started again within a minute; 0 is never.
    """

    def __init__(self, launches: list[Launch], say: Callable[[str], None], budget: int):
        self._say, self._budget = say, budget
        self._posts: list[Post] = []
        self._failed: Post | None = None
        self._spare: Spare | None = None
        try:
            for launch in reversed(launches):
                self._posts.insert(0, Post(launch, say))
            self._spare = Spare() if budget else None
        except BaseException:
            self.stop()
            raise

    def tend(self) -> bool:
        """Starts again what has died; False when the run is over, well or not."""
        for post in self._posts:
            if post.is_vacant:
                self._refill(post)
            elif post.child.status is not None and not self._bury(post):
                return False
        return True

    def complaint(self) -> str | None:
        """Why the run failed; None when every process ended as it should."""
        if self._failed is None:
            return None
        complaint = self._failed.child.complaint()
        if self._budget and not self._failed.child.was_refused:
            complaint += (
                f"; it was started again {self._budget} times within a minute, which is all"
            )
        return complaint

    def stop(self) -> None:
        """Stops all that still run."""
        if self._spare is not None:
            self._spare.stop()
        for post in self._posts:
            post.child.stop()

    def _bury(self, post: Post) -> bool:
        if post.child.status in (0, *_STOPPED):
            return False
        if not post.child.was_refused and self._budget and post.bury(self._budget):
            self._refill(post)
            return True
        self._failed = post
        return False

    def _refill(self, post: Post) -> None:
        if self._spare is not None and post.refill(self._spare):
            self._spare = Spare()


def _back_off(deaths: int) -> float:
    """Seconds until the next start after so many other deaths: 0, 0.5, 1, 2, ..."""
    if deaths == 0:
        return 0.0
    return min(_BACK_OFF_S * 2.0 ** (deaths - 1), _LONGEST_BACK_OFF_S)


def _start(*module: str, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
    # A session of its own keeps Ctrl-C for the launcher, which stops all in order.
    return subprocess.Popen(
        [sys.executable, "-m", *module],
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )

"""The processes of a run as children of the launcher, started again when they die."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import IO

from services.pulse import Pulse

_STOP_S = 5.0
_POLL_S = 0.01
_STOPPED = (-signal.SIGTERM,)
"""Statuses of a process that was stopped before it could say goodbye."""
_SET_CHILD_SUBREAPER = 36
_LOADING_S = 300.0
"""Until a nursery that still loads and compiles counts as hung."""
_BIRTH_S = 5.0
"""Until one that has loaded counts as hung, when it is asked for a process."""
_PAUSE_S = 1.0
"""Between two looks until it was the one who looks that stood still."""
_MEMORY_S = 60.0
"""Deaths longer ago count neither towards the budget nor for the back-off."""
_BACK_OFF_S = 0.5
_LONGEST_BACK_OFF_S = 4.0


@dataclass(frozen=True)
class Launch:
    """One process to start."""

    name: str
    arguments: tuple[str, ...]


class Nursery:
    """The process from which all others are forked; another takes its place when it has died.

    Each is told its arguments and a pipe for what it says, on whose first line it tells its process id;
    see `services.nursery`.
    """

    def __init__(self) -> None:
        # Makes the forked ones children of this process.
        ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._looked = time.monotonic()
        self._desk, self._process = self._begin()

    def bear(self, launch: Launch) -> IO[str]:
        """Has a process started; what it says."""
        request = json.dumps([launch.name, *launch.arguments]).encode()
        said, told = os.pipe()
        if self._process.poll() is not None:
            self._desk.close()
            self._desk, self._process = self._begin()
        # Should it have died since, the pipe closes, which is how any stillborn process is noticed.
        with suppress(BrokenPipeError):
            socket.send_fds(self._desk, [request], [told])
        os.close(told)
        return os.fdopen(said, errors="replace")

    def tend(self, *, owes: bool) -> bool:
        """Kills it, with all that it has not begun, where it owes a process and hangs; whether it did.

        To be called several times a second.
        """
        now = time.monotonic()
        passed_s, self._looked = min(now - self._looked, _PAUSE_S), now
        with suppress(BlockingIOError, ConnectionResetError):
            if self._desk.recv(1, socket.MSG_DONTWAIT):
                self._longest_s, self._owed_s = _BIRTH_S, 0.0
        self._owed_s = self._owed_s + passed_s if owes else 0.0
        if self._owed_s <= self._longest_s or self._process.poll() is not None:
            return False
        self._process.kill()
        self._process.wait()
        return True

    def stop(self) -> None:
        """Ends it; what it has not begun yet will not begin."""
        self._desk.close()
        self._process.kill()
        self._process.wait()

    def _begin(self) -> tuple[socket.socket, subprocess.Popen[bytes]]:
        self._longest_s, self._owed_s = _LOADING_S, 0.0
        desk, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # A session of its own keeps Ctrl-C for the launcher, which stops all in order.
        with theirs:
            return desk, subprocess.Popen(
                [sys.executable, "-m", "services.nursery"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )


class Child:
    """A forked process and the last that it said."""

    def __init__(self, name: str, said: IO[str], say: Callable[[str], None]):
        self.name = name
        self._pid: int | None = None
        self._status: int | None = None
        self._hung = ""
        self._say = say
        self._prefix = f"suturetrack {name}: "
        self._last: deque[str] = deque(maxlen=30)
        self._listener = threading.Thread(target=self._listen, args=(said,), daemon=True)
        self._listener.start()

    @property
    def status(self) -> int | None:
        """Exit status; negative for a signal; None while it runs or is about to."""
        silent = not self._listener.is_alive()
        if self._status is None and self._pid is not None:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if pid else None
        elif self._status is None and silent:
            self._last.append("it could not be started")
            self._status = 1
        return self._status

    @property
    def is_unborn(self) -> bool:
        """Whether the nursery has not begun it yet."""
        return self._pid is None and self.status is None

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
        if self._hung:
            return f"the {self.name} hung and was killed: {self._hung}"
        status = self.status or 0
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the {self.name} {how}{': ' + last if last and status > 0 else ''}"

    def end(self, reason: str) -> None:
        """Kills a process that hangs."""
        self._hung = reason
        self._signal(signal.SIGKILL)

    def stop(self) -> None:
        """SIGTERM, and SIGKILL when that does not help."""
        deadline = time.monotonic() + _STOP_S
        told = False
        while self.status is None:
            told = told or self._signal(signal.SIGTERM)
            if time.monotonic() > deadline:
                self._signal(signal.SIGKILL)
            time.sleep(_POLL_S)
        self._listener.join(_STOP_S)

    def _signal(self, number: signal.Signals) -> bool:
        if self._pid is None or self.status is not None:
            return False
        os.kill(self._pid, number)
        return True

    def _final_line(self) -> str:
        return self._last[-1] if self._last else ""

    def _listen(self, said: IO[str]) -> None:
        with said as lines:
            first = lines.readline()
            self._pid = int(first) if first else None
            for line in lines:
                self._last.append(line.rstrip())
                if not line.startswith(self._prefix):
                    self._say(line.rstrip())


class Post:
    """One place in the fleet, and who holds it."""

    def __init__(self, launch: Launch, nursery: Nursery, say: Callable[[str], None]):
        self._launch, self._nursery, self._say = launch, nursery, say
        self._deaths: deque[float] = deque()
        self._due: float | None = None
        self.starts = 0
        """How often the process was started again."""
        self.child = Child(launch.name, nursery.bear(launch), say)

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

    def refill(self) -> None:
        """Starts the process again when it is due."""
        if self._due is None or time.monotonic() < self._due:
            return
        self._due = None
        self.starts += 1
        resume = ("--resume", str(self.starts))
        launch = Launch(self._launch.name, (*self._launch.arguments, *resume))
        self.child = Child(launch.name, self._nursery.bear(launch), self._say)


class Fleet:
    """Starts processes, starts those that die again, stops them in the order in which they were named.

    Args:
        launches: what to start.
        say: told what a person should know, line by line.
        budget: how often each process is started again within a minute; 0 is never.
        pulse: tells which processes hang.
    """

    def __init__(
        self, launches: list[Launch], say: Callable[[str], None], budget: int, pulse: Pulse
    ):
        self._say, self._budget, self._pulse = say, budget, pulse
        self._nursery = Nursery()
        self._failed: Post | None = None
        posts = [Post(launch, self._nursery, say) for launch in reversed(launches)]
        self._posts = posts[::-1]

    def tend(self) -> bool:
        """Starts again what has died; False when the run is over, well or not."""
        self._pulse.look()
        if self._nursery.tend(owes=any(post.child.is_unborn for post in self._posts)):
            self._say("suturetrack run: what starts the processes hung and was killed")
        # All are looked at before the run is called over: who ends well hides nobody's death.
        held = [self._tend(post) for post in self._posts]
        return all(held)

    def complaint(self) -> str | None:
        """Why the run failed; None when every process ended as it should. To be asked after `stop`."""
        for post in self._posts:
            back = not post.starts or self._pulse.is_ready(post.child.name, post.starts)
            if post is not self._failed and (post.is_vacant or not back):
                return f"the {post.child.name} died, and the run ended before it was back"
        if self._failed is None:
            refused = (post.child for post in self._posts if post.child.was_refused)
            return next((child.complaint() for child in refused), None)
        complaint = self._failed.child.complaint()
        if self._budget and not self._failed.child.was_refused:
            complaint += (
                f"; it was started again {self._budget} times within a minute, which is all"
            )
        return complaint

    def stop(self) -> None:
        """Stops all that still run."""
        self._nursery.stop()
        for post in self._posts:
            post.child.stop()

    def _tend(self, post: Post) -> bool:
        """Whether there is still somebody to do the work of a post, now or soon."""
        if post.is_vacant:
            post.refill()
            return True
        if post.child.is_unborn:
            return True
        if post.child.status is None:
            trouble = self._pulse.trouble(post.child.name, post.starts)
            if trouble:
                post.child.end(trouble)
            return True
        return self._bury(post)

    def _bury(self, post: Post) -> bool:
        if post.child.status in (0, *_STOPPED):
            return False
        if not post.child.was_refused and self._budget and post.bury(self._budget):
            post.refill()
            return True
        self._failed = post
        return False


def _back_off(deaths: int) -> float:
    """Seconds until the next start after so many other deaths: 0, 0.5, 1, 2, ..."""
    if deaths == 0:
        return 0.0
    return min(_BACK_OFF_S * 2.0 ** (deaths - 1), _LONGEST_BACK_OFF_S)

"""Zenoh sessions that never keep a program from ending.

Zenoh calls back from threads that it starts in Python, and Python waits for threads before it ends: for
ever, where a session is left open by an exception or out of forgetfulness. It does not wait for daemons,
and the threads that a daemon starts are daemons. But a daemon that is within Zenoh while Python ends takes
the program down, so that every session is closed before that, and its threads are waited for.
"""

from __future__ import annotations

import atexit
import json
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from typing import Any, TypeVar

import zenoh

from services import RUST_LOG

T = TypeVar("T")

_LONGEST_CALL_S = 1.0
"""Until what is under way within Zenoh is given up."""


class Session:
    """A Zenoh session that is closed at the latest when the program ends.

    What waits in here can be interrupted, unlike Zenoh itself.

    Raises:
        zenoh.ZError: it cannot be opened.
    """

    def __init__(self, config: zenoh.Config):
        zenoh.init_log_from_env_or(RUST_LOG)
        self._kept: list[Any] = []
        self._threads: set[threading.Thread] = set()
        self.zenoh = _beside(lambda: zenoh.open(config))
        atexit.register(self.close)

    def keep(self, declare: Callable[[zenoh.Session], Any]) -> Callable[[], None]:
        """Declares something that calls back, until the session is closed or what this returns is called."""

        def declared() -> Any:
            before = set(threading.enumerate())
            made = declare(self.zenoh)
            self._threads |= {t for t in threading.enumerate() if t.daemon} - before
            return made

        def end() -> None:
            self._kept.remove(kept)
            _beside(kept.undeclare)

        kept = _beside(declared)
        self._kept.append(kept)
        return end

    def close(self) -> None:
        """Ends it and the calls back; safe to call twice."""
        atexit.unregister(self.close)
        if not self.zenoh.is_closed():
            self.zenoh.close()  # type: ignore[no-untyped-call]
        deadline = time.monotonic() + _LONGEST_CALL_S
        for thread in self._threads - {threading.current_thread()}:
            thread.join(max(0.0, deadline - time.monotonic()))


def configured(settings: Mapping[str, Any]) -> zenoh.Config:
    """Zenoh's defaults but for some settings, by their paths; raises zenoh.ZError."""
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def _beside(function: Callable[[], T]) -> T:
    """What a function returns or raises that runs in a daemon thread."""
    outcome: Future[T] = Future()

    def run() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    try:
        threading.Thread(target=run, name="zenoh", daemon=True).start()
        return outcome.result()
    finally:
        # After an interrupt it may be within Zenoh still.
        wait([outcome], _LONGEST_CALL_S)

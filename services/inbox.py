"""Where messages wait for the loop that reads them."""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")

# A signal may reach another thread than the main one, which handles it only when it wakes up.
_LONGEST_WAIT_S = 0.25


class Stop:
    """Tells every waiting loop of a process to end."""

    def __init__(self) -> None:
        # Entered by itself: an interrupt on the way into a Condition would leave it locked.
        self.lock = threading.RLock()
        self.is_set = False
        self._conditions: weakref.WeakSet[threading.Condition] = weakref.WeakSet()
        self._stopped = self.condition()

    def condition(self) -> threading.Condition:
        """A condition of `lock` that is notified when the process is asked to stop, too.

        Each who waits has one, so that a message wakes nobody but its reader.
        """
        condition = threading.Condition(self.lock)
        with self.lock:
            self._conditions.add(condition)
        return condition

    def set(self) -> None:
        """Ends all waiting, now and later; not to be called from a signal handler."""
        with self.lock:
            self.is_set = True
            for condition in self._conditions:
                condition.notify_all()

    def wait(self, seconds: float) -> bool:
        """Sleeps, at most until stopped; whether it was stopped."""
        with self.lock:
            return self._stopped.wait_for(lambda: self.is_set, seconds)


class Inbox(Generic[T]):
    """Messages in order, the oldest given up when there are more than `depth`.

    Iterating waits for messages and ends when the process is asked to stop, even if some are left.
    """

    def __init__(self, stop: Stop, depth: int):
        self._stop = stop
        self._arrival = stop.condition()
        self._items: deque[T] = deque()
        self._depth = depth
        self.received = 0
        """Messages put in so far."""
        self.given_up = 0
        """Messages that had to make room for newer ones."""

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T) -> None:
        """Adds a message; never waits for the reader."""
        with self._stop.lock:
            self.received += 1
            if len(self._items) >= self._depth:
                self._items.popleft()
                self.given_up += 1
            self._items.append(item)
            self._arrival.notify()

    def get(self, timeout: float | None = None) -> T | None:
        """The next message; None after `timeout` seconds without one, or when asked to stop."""
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._stop.lock:
            while not self._items and not self._stop.is_set:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return None
                self._arrival.wait(min(left or _LONGEST_WAIT_S, _LONGEST_WAIT_S))
            return None if self._stop.is_set else self._items.popleft()

    def __iter__(self) -> Iterator[T]:
        while (item := self.get()) is not None:
            yield item

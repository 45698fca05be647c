"""The newest exposure of input that does not wait."""

from __future__ import annotations

import threading
import time

from services.sources.footage import Exposure, Stalled
from suturetrack.types import InputError

STALL_S = 1.0
"""Without a frame for so long, people are told."""


class Newest:
    """Hands exposures from the thread that takes them to the one that reads them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._exposure: Exposure | None = None
        self._failure: InputError | None = None
        self._last = time.monotonic()

    def put(self, exposure: Exposure) -> None:
        """Replaces an exposure that nobody has read yet."""
        with self._changed:
            self._exposure, self._last = exposure, time.monotonic()
            self._changed.notify()

    def fail(self, failure: InputError) -> None:
        """Ends the reading."""
        with self._changed:
            self._failure = failure
            self._changed.notify()

    def get(self, timeout: float, complaint: str) -> Exposure:
        """The next exposure.

        Raises:
            Stalled: none came in time; the text begins with the complaint.
            InputError: there will be none any more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._exposure or self._failure, timeout)
            if self._failure is not None:
                raise self._failure
            exposure, self._exposure = self._exposure, None
        if exposure is None:
            raise Stalled(f"{complaint} for {time.monotonic() - self._last:.0f} s")
        return exposure

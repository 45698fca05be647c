"""Time that never runs back, whatever the dates in the stream do."""

from __future__ import annotations

from suturetrack.types import Stamp

# A field older than this does not come late: the source has begun anew.
_LATEST_NS = 1_000_000_000


class StreamClock:
    """Tells which fields are new, and counts the time between them."""

    def __init__(self) -> None:
        self._last: Stamp | None = None
        self.now_ns = 0
        """Time of the last new field; stands still where the dates jump back."""

    def advance(self, stamp: Stamp) -> bool:
        """Whether the field is new.

        It is old if neither its number nor its date is newer than the last new one's, and it is no
        more than a second behind.
        """
        last = self._last
        elapsed = stamp.capture_ns - last.capture_ns if last else 0
        if last and stamp.frame <= last.frame and -_LATEST_NS < elapsed <= 0:
            return False
        self._last = stamp
        self.now_ns += max(elapsed, 0)
        return True

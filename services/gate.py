"""Which fields a tracker may believe: those of its rig, in rising time."""

from __future__ import annotations

from suturetrack.camera import StereoRig
from suturetrack.types import RidgeField, Stamp

_LEAP_NS = 10_000_000_000
_STUBBORN = 5
"""Fields in a row, each following the other, that show that the source's time is another one now."""


class Gate:
    """Refuses fields of another rig's size, and single stamps that lie in the past or far ahead.

    One bad stamp must not make all good ones after it look old. When the stamps go on from where they
    leapt to, as those of a source that was started anew, they are believed.

    Far ahead is what lies much further ahead than the time that passed since the last good one.

    Args:
        rig: whose fields these are.
        ordered: whether time has to rise; in lock-step the source sees to it.
    """

    def __init__(self, rig: StereoRig, *, ordered: bool):
        width, height = rig.image_size
        self._shape = height, width, 2
        self._ordered = ordered
        self._last: Stamp | None = None
        self._passed_ns = 0
        self._strange: Stamp | None = None
        self._in_a_row = 0
        self.began_anew = False
        """Whether the time of the field that was let through last is another one than before."""

    def refusal(self, field: RidgeField, now_ns: int) -> str:
        """Why a field that comes now, by a clock of any origin, is not to be used; empty when it is."""
        self.began_anew = False
        if field.left.shape != self._shape:
            return f"a field of {field.left.shape}, the rig's are {self._shape}"
        waited_ns = now_ns - self._passed_ns
        if self._ordered and self._last and not _follows(self._last, field.stamp, waited_ns):
            follows = self._strange is not None and _follows(self._strange, field.stamp)
            self._in_a_row = self._in_a_row + 1 if follows else 1
            self._strange = field.stamp
            if self._in_a_row < _STUBBORN:
                seconds = (field.stamp.capture_ns - self._last.capture_ns) / 1e9
                return f"frame {field.stamp.frame} lies {seconds:+.3f} s from the last one"
            self.began_anew = True
        self._last, self._passed_ns = field.stamp, now_ns
        self._strange, self._in_a_row = None, 0
        return ""


def _follows(before: Stamp, after: Stamp, waited_ns: int = 0) -> bool:
    return 0 < after.capture_ns - before.capture_ns <= waited_ns + _LEAP_NS

"""What is known of a thread's length, and what a curve of another length means."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from suturetrack import nurbs
from suturetrack.tracking.end_watch import EndWatch
from suturetrack.types import Nurbs

# A thread of which something is hidden has not grown by more.
_GROWTH = 0.02
# A thread that is not alone is neither longer nor shorter by more.
_DETOUR = 0.005
# A thread found again has the length that it had, to this part; to the other one if it is not alone.
_TOLERANCE, _CROWDED_TOLERANCE = 0.05, 0.01
# What is shorter or longer by more has nothing to do with the thread.
_LEAST_LEFT, _MOST_ADDED = 0.65, 1.5
# How long a thread is remembered to have been longer.
_FORGOTTEN_S = 3.0


@dataclass(frozen=True, eq=False)
class KnownLength:
    """What is known of one thread's length after a field; lengths in the calibration's unit."""

    now: float
    """When the thread was last tracked and all of it seen."""
    before_cut: float = 0.0
    """Before an end of it was given up: that may have been hidden only."""
    with_loops: float = 0.0
    """At most, while it was tracked and touched itself: a loop that is drawn in may show again."""
    is_established: bool = False
    """Whether it was steady for long enough, with both ends in the images, to be the thread's own."""
    was_established: bool = False
    """Whether it was so at any time: what the images' border cuts off since makes the rest no longer."""
    is_cut: bool = False
    """Whether a part was cut off the curve that has not been found again."""

    @property
    def possible(self) -> tuple[float, float]:
        """Lengths that the thread may have."""
        return self.now, max(self.now, self.before_cut, self.with_loops)

    def inherited(self, before: KnownLength, *, is_sure: bool) -> KnownLength:
        """Of a thread that was found anew.

        What is found for sure has the length that it has: the thread may have been drawn out since.
        """
        if is_sure:
            return replace(before, now=self.now, before_cut=max(before.possible), is_cut=False)
        return replace(before, is_cut=False)

    def watched(self, ends: EndWatch) -> KnownLength:
        """Established once the ends have settled; what the border cuts off comes in again."""
        is_established = (self.is_established or ends.settled) and not ends.at_border
        was_established = self.was_established or is_established
        return replace(self, is_established=is_established, was_established=was_established)

    def found(self, length: float, ends: EndWatch) -> KnownLength:
        """With a curve that may have what was cut off again."""
        is_lacking = length < (1 - _GROWTH) * self.now and not ends.at_border
        return replace(self, is_cut=self.is_cut and is_lacking)

    def cut(self) -> KnownLength:
        """With a part of the curve cut off, to be found anew."""
        return replace(self, is_cut=self.is_established)

    def given_up(self, length: float) -> KnownLength:
        """With no more left than `length`, as far as anybody knows."""
        return replace(self, now=length, before_cut=max(self.possible), is_cut=False)

    def again(self, length: float) -> KnownLength:
        """With what was hidden in sight again."""
        return replace(self, now=max(self.now, length))

    def looped(self, length: float) -> KnownLength:
        """Tracked with so much of it, where it touches itself."""
        return replace(self, with_loops=max(self.with_loops, length))

    def learned(self, ends: EndWatch, seconds: float, *, is_clear: bool) -> KnownLength:
        """So much later; an end that is lost for a moment makes the thread no shorter, nor do other
        ridges that draw it aside."""
        length = ends.length if is_clear else min(ends.length, self.now)
        longest = max(self.now, length)
        is_told = is_clear and ends.settled
        fading = 0.0 if is_told else math.exp(-max(seconds, 0.0) / _FORGOTTEN_S)
        return replace(self, now=length + (longest - length) * fading)

    def is_outgrown(self, length: float, noise: float) -> bool:
        """Whether a curve is longer than the thread ever was, by more than noise makes of it."""
        return self.is_established and length > (1 + _GROWTH) * max(self.possible) + noise

    def is_exceeded(self, length: float, noise: float) -> bool:
        """Whether a curve beside other ridges, which draw it aside, makes a detour."""
        return self.was_established and length > (1 + _DETOUR) * self.now + noise

    def is_undercut(self, length: float, noise: float) -> bool:
        """Whether it makes a short cut; what the images' border cuts off makes it shorter, too."""
        return self.is_established and length < (1 - _DETOUR) * self.now - noise

    def is_reached(self, length: float) -> bool:
        """Whether a curve lacks nothing of the thread's own length."""
        return self.is_established and length >= self.now

    def is_met(self, length: float, noise: float) -> bool:
        """Whether a curve has the thread's length, to what noise and a bend leave open."""
        return abs(length - self.now) <= _CROWDED_TOLERANCE * self.now + noise

    def is_short(self, length: float) -> bool:
        """Whether a curve lacks what was cut off."""
        return self.is_cut and length < (1 - _TOLERANCE) * self.now

    def is_another(self, length: float, last: float, noise: float, *, is_clear: bool) -> bool:
        """Whether a curve has neither a length that the thread had nor that of the `last` good one."""
        tolerance = _TOLERANCE if is_clear else _CROWDED_TOLERANCE
        lengths = *self.possible, last
        return all(abs(length - known) > tolerance * known + noise for known in lengths)

    def is_beyond_hope(self, length: float) -> bool:
        """Whether a curve has little of the thread's length left, or far too much added."""
        return length < _LEAST_LEFT * self.now or length > _MOST_ADDED * max(self.possible)


def has_length(curve: Nurbs, known_lengths: tuple[float, ...]) -> bool:
    """Whether the curve is as long as the thread is known to be; any is where nothing is known."""
    return not known_lengths or length_error(curve, known_lengths) < _TOLERANCE


def length_error(curve: Nurbs, known_lengths: tuple[float, ...]) -> float:
    """How far the curve's length is from the nearest known one, as a share of that."""
    actual = nurbs.length(curve)
    return min(abs(actual / known - 1) for known in known_lengths)

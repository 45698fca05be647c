"""Whether an end that shows elsewhere than before has moved, is hidden, or runs into something else."""

from __future__ import annotations

import math

import numpy as np

from suturetrack.tracking.ends import EndStep

# What the length of a thread may change by from one field to the next.
_DRAWN_PX = 6.0
# A thread is drawn out steadily: an end that leaps on by more than the first has met a tool. It makes the
# thread longer than it ever was by no more than the second, or not at all along something wider, until it has
# insisted for so long; for twice as long as the length was steady, while that is not known.
_LEAP_PX, _LONGER_PX, _INSISTS_S = 2.5, 1.5, 5.0
# An end that is hidden steps off by at least this much before the curve's own.
_CUT_PX = 3.0
# For how long a new watch believes the ends, and for how long an end that steps off is held.
_SETTLING_S, _HELD_S = 0.3, 1.5
# A length that has kept within this part for so long is the thread's own.
_STEADY = 0.015
_SETTLED_S = 0.7
# One whose mean of late has kept so near to the mean of long for so long does not change at all: one that is
# drawn out slowly does.
_CONSTANT, _CONSTANT_S = 0.002, 1.0
# How long an end shows further on, without a break, until somebody should look.
_ASKS_S = 0.15
# How soon it is forgotten that a thread was longer, and that an end has gone on.
_FORGOTTEN_S = 3.0
_NS = 1e-9


class EndWatch:
    """Decides from field to field whether an end has moved, is hidden, or runs into something else.

    What one end loses and the other gains is the thread sliding along itself. A thread that is
    suddenly shorter at an end is hidden there, one that is suddenly longer than it ever was has met
    something that looks like it: its length is then held for a while, the more firmly the longer it
    was steady. An end that leaps on without growing so much, or goes on where the ridge is wider, is held
    as well, for fear of a tool that it runs on along; not for long where the length was not steady for
    long, for then something has come out of hiding. An end beside which another ridge runs makes good what
    is lacking, and gives back what is too much.

    Args:
        length: of the thread now.
        now_ns: capture time.
        before: a length that it had, and may have again: the rest was hidden.
    """

    def __init__(self, length: float, now_ns: int, before: float = 0.0) -> None:
        self._found_ns = now_ns
        self._last_ns = now_ns
        self._seen_ns = [now_ns, now_ns]
        self._steady_ns = self._changed_ns = now_ns
        self.length = self._longest = self._steady = self._recent = length
        self._before = before
        self._is_known = False
        self._plain_ns = now_ns
        """When neither end was held that showed further on."""
        self.shows_more = False
        """Whether an end that is held has shown further on for a while, of a length that was not steady."""
        self._gone_on = [0.0, 0.0]
        """By how much the ends have gone on of late."""
        self.settled = False
        """Whether the length has been steady for long enough to be the thread's own."""
        self.is_constant = False
        """Whether it has not changed for long, with both ends in sight."""
        self.wanted = length
        """Length that the thread would have if every step at its ends were believed, but for those along
        other threads that are known."""
        self.seen = (True, True)
        """Whether the start and the stop are where they show."""
        self.at_border = False
        """Whether the image's border cuts the thread."""

    def moves(
        self,
        start: EndStep | None,
        stop: EndStep | None,
        length: float,
        now_ns: int,
        *,
        is_known: bool = False,
    ) -> tuple[float, float]:
        """How far to move both ends outward, as parts of the curve's `length`.

        `is_known` says that the thread's length has settled once, before this watch began.
        """
        self._is_known |= is_known
        steps = start, stop
        offsets = [step.offset if step else 0.0 for step in steps]
        believed = [step.offset for step in steps if step and not step.on_another]
        self.wanted = length * (1.0 + sum(believed))
        doubted = self._doubted(steps, offsets, length, now_ns)
        seen = [end not in doubted for end in (0, 1)]
        if not any(_leaps(steps[end]) for end in doubted):
            self._plain_ns = now_ns
        is_steady = (now_ns - self._steady_ns) * _NS > _SETTLING_S
        self.shows_more = not is_steady and (now_ns - self._plain_ns) * _NS > _ASKS_S
        for end in doubted:
            offsets[end] = self._held(end, steps[end], offsets[1 - end], length, seen[1 - end])
        for end in (0, 1):
            if seen[end]:
                self._seen_ns[end] = now_ns
            self._gone_on[end] = self._fading(now_ns) * self._gone_on[end] + offsets[end] * length
        self.seen = seen[0], seen[1]
        self.at_border = any(step and step.at_border for step in steps)
        if doubted:
            self.is_constant, self._changed_ns = False, now_ns
            self._steady_ns += max(now_ns - self._last_ns, 0)
        else:
            self._remember(length * (1.0 + sum(offsets)), now_ns)
        self._last_ns = now_ns
        return offsets[0], offsets[1]

    def _held(
        self, end: int, step: EndStep | None, other: float, length: float, other_is_seen: bool
    ) -> float:
        """The offset of an end whose step does not count, beside the `other` end's."""
        lacking = self.length / length - 1.0 - other
        bound = 0.0 if step is None else _DRAWN_PX * step.pixel
        if step is not None and not step.alone:
            return max(min(max(step.offset, 0.0), lacking), -bound)
        if not other_is_seen:
            return 0.0
        offset = min(max(lacking, -bound), bound)
        if step is None or step.offset_px <= 0:
            return offset
        # What is too long lies elsewhere, but for what either end has gone on.
        gone_on = self._gone_on[end] / length + max(other, 0.0) + _LONGER_PX * step.pixel
        return max(offset, min(-gone_on, 0.0))

    def _doubted(
        self,
        steps: tuple[EndStep | None, EndStep | None],
        offsets: list[float],
        length: float,
        now_ns: int,
    ) -> list[int]:
        """The ends whose steps do not count."""
        doubted = [end for end, step in enumerate(steps) if step is None or not step.alone]
        shown = [step for step in steps if step]
        if doubted or any(step.at_border for step in shown):
            return doubted
        is_new = (now_ns - self._found_ns) * _NS < _SETTLING_S
        unseen_s = [(now_ns - seen_ns) * _NS for seen_ns in self._seen_ns]
        pixel = max(step.pixel for step in shown) * length
        total = length * (1.0 + sum(offsets))
        longer = int(np.argmax(offsets))
        steady_s = (now_ns - self._steady_ns) * _NS
        insists_s = _INSISTS_S if self._is_known else max(2 * steady_s, _SETTLING_S)
        is_held = unseen_s[longer] < insists_s and (shown[longer].widens or not is_new)
        most = max(self.length, self._longest, self._before) + _growth_px(shown[longer]) * pixel
        if is_held and total > most:
            return [longer]
        if is_new:
            return []
        if total < self.length - _DRAWN_PX * pixel:
            doubted = [
                end
                for end, step in enumerate(shown)
                if step.offset_px < -_CUT_PX
                and offsets[end] <= min(offsets) / 2
                # What the other end gains is not hidden.
                and sum(offsets) <= offsets[end] / 2
            ]
        return [end for end in doubted if unseen_s[end] < _HELD_S]

    def _remember(self, length: float, now_ns: int) -> None:
        self._recent += 0.1 * (length - self._recent)
        if abs(self._recent / self._steady - 1) > _CONSTANT or self.at_border:
            self._changed_ns = now_ns
        self.is_constant = (now_ns - self._changed_ns) * _NS > _CONSTANT_S
        if abs(length / self._steady - 1) > _STEADY:
            self._steady, self._recent, self._steady_ns = length, length, now_ns
        self._steady += 0.02 * (length - self._steady)
        self.settled = (now_ns - self._steady_ns) * _NS > _SETTLED_S
        self._is_known |= self.settled
        self.length = self._steady if self.settled else length
        if not self.at_border:
            fading = self._fading(now_ns)
            self._longest = max(length, length + (self._longest - length) * fading)

    def _fading(self, now_ns: int) -> float:
        """What is left of what was remembered at the last field."""
        return math.exp(-max(now_ns - self._last_ns, 0) * _NS / _FORGOTTEN_S)


def _leaps(step: EndStep | None) -> bool:
    """Whether an end shows further on, by itself, than a thread is drawn out."""
    return step is not None and step.alone and step.offset_px > _LEAP_PX


def _growth_px(step: EndStep) -> float:
    """By how much a step may make the thread longer than it ever was."""
    if step.widens:
        return 0.0
    return _LONGER_PX if step.offset_px > _LEAP_PX else _DRAWN_PX

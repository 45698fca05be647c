"""Whether what was heard last may still be acted on.

Zenoh promises no deadlines, and a process that hangs keeps its liveliness token. So a consumer judges
by time alone: the stamp of every state says when the source released its frame and how soon the next
one is due, and `Freshness` weighs both against the clock at the moment of use.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Self

from suturetrack.types import Stamp

PERIODS = 3
"""Frame periods after the release of a frame until what is known of it is stale."""
_SILENCE = 2.5
"""Frame periods without another message until the last one is stale. It holds where the clocks of two
machines disagree, and leaves half a period for the message's way."""


@dataclass(frozen=True)
class Freshness:
    """How old a message is at one moment, and whether it is live.

    To be taken anew whenever the message is used: nothing tells a consumer that a process went silent
    but that time goes by. After the source, the segmenter or the tracker went silent, the last state
    is stale within three frame periods, however they ended: nothing has to be received for it.

        state = states.get(0.1)                                 # a `services.bus.Reader`
        ...
        if not Freshness.of(state.stamp, states.arrived_ns).live:
            ...                                                 # do not move
    """

    age_ns: int
    """Since the source released the frame, by this machine's clock; negative when that is ahead."""
    silence_ns: int
    """Since the message arrived on this machine, whatever the clocks."""
    period_ns: int
    """Between two frames, as the source promised; 0 when it promised nothing."""

    @classmethod
    def of(
        cls,
        stamp: Stamp,
        arrived_ns: int,
        *,
        now_ns: int | None = None,
        monotonic_ns: int | None = None,
    ) -> Self:
        """The freshness of a message now.

        Args:
            stamp: the message's own.
            arrived_ns: when it arrived, by `time.monotonic_ns`; `Reader.arrived_ns` tells.
            now_ns: the moment in question by the wall clock; now when not given.
            monotonic_ns: the same moment by `time.monotonic_ns`.
        """
        now_ns = time.time_ns() if now_ns is None else now_ns
        monotonic_ns = time.monotonic_ns() if monotonic_ns is None else monotonic_ns
        return cls(now_ns - stamp.released_ns, monotonic_ns - arrived_ns, stamp.period_ns)

    @property
    def live(self) -> bool:
        """Whether the message may be acted on."""
        return not self.reason

    @property
    def left_ns(self) -> int:
        """Until the message is stale if nothing else comes; 0 when it is."""
        if not self.live:
            return 0
        by_age = PERIODS * self.period_ns - self.age_ns
        return min(by_age, round(_SILENCE * self.period_ns) - self.silence_ns)

    @property
    def reason(self) -> str:
        """Why the message is stale, in words; empty when it is live."""
        if self.period_ns <= 0:
            return "the source promises no rate, as in lock-step"
        if self.age_ns < -self.period_ns:
            return f"its stamp lies {-self.age_ns / 1e6:.0f} ms ahead; do the clocks agree?"
        if self.age_ns > PERIODS * self.period_ns:
            return f"its frame is {self.age_ns / 1e6:.0f} ms old"
        if self.silence_ns > _SILENCE * self.period_ns:
            return f"nothing came for {self.silence_ns / 1e6:.0f} ms"
        return ""

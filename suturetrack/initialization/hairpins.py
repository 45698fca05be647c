"""Hairpins: where a strand turns round in the line of sight, it looks like a stub that leads nowhere."""

from __future__ import annotations

from suturetrack.initialization.joints import Joints, inward
from suturetrack.initialization.pricing import FEW_ENDS, HIGHEST
from suturetrack.initialization.segments import ARM
from suturetrack.polylines import unit

_LONGEST = 60
"""Points of a stub at most."""
_CLEAR = 4
"""Points at the ends of two strands that draw each other's crests aside there."""
_TOGETHER = 0.7
"""Cosine of the angle at which they come together at most."""
_SMOOTH = 0.5
"""Price of a merge up to which a strand runs on smoothly into a stub."""
_SHARP = 1.4
"""And up to which it may where hardly anything but the thread is there."""


def double_stubs(joints: Joints) -> None:
    """Leads strands into stubs and out of them again where a second end waits at the mouth.

    Two strands that come together at a small angle and both end there would be a coincidence.
    """
    partner, price = joints.partner, joints.price
    while True:
        free = joints.free
        most = _SMOOTH if len(free) > FEW_ENDS else _SHARP
        stubs = {end ^ 1 for end in free if len(joints.segments[end // 2]) <= _LONGEST}
        ways = [
            (cost, mouth, waiting)
            for (mouth, waiting), cost in price.items()
            if mouth in stubs
            and mouth in partner
            and waiting not in partner
            and waiting not in (mouth ^ 1, joints.other_end(mouth ^ 1))
            and max(cost, price[mouth, partner[mouth]]) < most
            and _come_together(joints, partner[mouth], waiting)
        ]
        if not ways:
            return
        _, mouth, waiting = min(ways)
        _double(joints, mouth, waiting)


def _come_together(joints: Joints, one: int, other: int) -> bool:
    """Whether the strands of two ends come to them at a small angle."""
    arms = [inward(joints.segments, end)[_CLEAR : ARM + _CLEAR] for end in (one, other)]
    if min(map(len, arms)) < 2:
        return True
    headings = [unit(arm[0] - arm[-1]) for arm in arms]
    return bool(headings[0] @ headings[1] > _TOGETHER)


def _double(joints: Joints, mouth: int, waiting: int) -> None:
    """Leads a strand round at the tip of the stub with the end `mouth`, and back to the end `waiting`."""
    back = 2 * joints.copy(mouth // 2) + mouth % 2
    joints.copy_prices({mouth: back})
    joints.join(mouth ^ 1, back ^ 1, HIGHEST)
    joints.join(back, waiting)

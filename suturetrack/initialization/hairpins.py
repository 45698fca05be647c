"""Hairpins: where a strand turns round in the line of sight, it looks like a stub that leads nowhere."""

from __future__ import annotations

from suturetrack.initialization.paths import other_end
from suturetrack.initialization.pricing import FREE_END
from suturetrack.types import Float64

_LONGEST = 60
"""Points of a stub at most."""
_SMOOTH = 0.5
"""Price of a merge up to which a strand runs on smoothly into a stub."""
_SHARP = 1.4
"""And up to which it may where hardly anything but the thread is there."""
_FEW_ENDS = 6
"""Free ends of a view that shows hardly anything else: a thread has but two."""


def double_stubs(
    segments: tuple[Float64, ...],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
) -> tuple[Float64, ...]:
    """Leads strands into stubs and out of them again where a second end waits at the mouth.

    Two strands that come together at a small angle and both end there would be a coincidence.
    """
    copies = list(segments)
    while True:
        free = [end for end in range(2 * len(copies)) if end not in partner]
        most = _SMOOTH if len(free) > _FEW_ENDS else _SHARP
        stubs = {end ^ 1 for end in free if len(copies[end // 2]) <= _LONGEST}
        ways = [
            (cost, mouth, waiting)
            for (mouth, waiting), cost in price.items()
            if mouth in stubs
            and mouth in partner
            and waiting not in partner
            and waiting not in (mouth ^ 1, other_end(mouth ^ 1, partner))
            and max(cost, price[mouth, partner[mouth]]) < most
        ]
        if not ways:
            return tuple(copies)
        _, mouth, waiting = min(ways)
        _double(mouth, waiting, copies, partner, price)


def _double(
    mouth: int,
    waiting: int,
    copies: list[Float64],
    partner: dict[int, int],
    price: dict[tuple[int, int], float],
) -> None:
    """Leads a strand round at the tip of the stub with the end `mouth`, and back to the end `waiting`."""
    tip, back = mouth ^ 1, 2 * len(copies) + (mouth & 1)
    copies.append(copies[mouth // 2])
    price |= {(back, j): cost for (i, j), cost in price.items() if i == mouth}
    price |= {(i, back): cost for (i, j), cost in price.items() if j == mouth}
    for i, j in ((tip, back ^ 1), (back, waiting)):
        partner[i], partner[j] = j, i
    price[tip, back ^ 1] = price[back ^ 1, tip] = 2 * FREE_END

"""What happens to a thread, as marks on its plots and as a lane of its own."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

import numpy as np
import rerun as rr
from rerun.components import MarkerShape

from services.drawing.common import GRAY, GREEN, RED, TURQUOISE, WHITE, YELLOW, Entry, part
from suturetrack.types import ThreadState

MARKS = {
    "lost": (RED, MarkerShape.Cross),
    "found": (GREEN, MarkerShape.Up),
    "seed": (WHITE, MarkerShape.Diamond),
    "forgotten": (GRAY, MarkerShape.Down),
    "inserted": (TURQUOISE, MarkerShape.Plus),
    "removed": (YELLOW, MarkerShape.Square),
}
"""The kinds of events and what marks them, the one that matters most first."""
_FOUND = (
    *("found", "found again", "found elsewhere", "found for sure"),
    *("put right", "recovered", "taken back"),
)
_CONTROL_POINTS = re.compile(r"control points: (\d+) inserted, (\d+) removed")


def event_style(thread: str) -> Iterator[Entry]:
    """Marks and colours of one thread's events; all of it static."""
    for kind, (color, marker) in MARKS.items():
        points = rr.SeriesPoints(names=kind, colors=color, markers=marker, marker_sizes=6.0)
        yield f"/plots/{part(thread)}/energy/event/{kind}", points
    colors = [(*color, 255) for color, _ in MARKS.values()]
    lane = rr.StateConfiguration(values=list(MARKS), colors=colors)
    yield f"/plots/{part(thread)}/event", lane


def kinds(state: ThreadState, *, seeded: bool) -> list[str]:
    """The kinds of what happened to the thread in one frame, the one that matters most first."""
    found = {"seed"} if seeded else set()
    for event in state.events:
        if event in _FOUND:
            found.add("found")
        elif event in ("lost", "forgotten"):
            found.add(event)
        elif (counts := _CONTROL_POINTS.fullmatch(event)) is not None:
            names = zip(("inserted", "removed"), counts.groups(), strict=True)
            found |= {name for name, count in names if count != "0"}
    return [kind for kind in MARKS if kind in found]


def marks(state: ThreadState, happened: Iterable[str]) -> Iterator[Entry]:
    """Marks at the height of the image energies, or of no match where there is no curve."""
    energy = np.mean([state.energies.image_left, state.energies.image_right])
    height = float(np.nan_to_num(energy))
    for kind in happened:
        yield f"/plots/{part(state.thread)}/energy/event/{kind}", rr.Scalars(height)


def lane(thread: str, kind: str | None) -> Iterator[Entry]:
    """What the lane says from now on."""
    change = rr.StateChange.from_fields(state=kind, clear_unset=True)
    yield f"/plots/{part(thread)}/event", change

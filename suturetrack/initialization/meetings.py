"""Where strands touch, in both views: whether these had better go on as each other does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from suturetrack.initialization.contacts import CLEARLY, Arm, Contact, Ways, contacts
from suturetrack.initialization.depth import Depth
from suturetrack.initialization.segments import Ridges
from suturetrack.initialization.threads import Thread
from suturetrack.types import Float64

_MOST_EXCHANGES = 4
_SAME_PX = 10.0
"""How far from each other, at most, two views show the same contact."""
_ON_PX, _APART_PX = 3.0, 1.5
"""How far from its strand, in the median, an arm of the other view is found at most, and how much nearer to
it than to the other strand at least."""
_CONTRADICTED = 5.0
"""Energy from which on two views that are both clear do not mean the same place if they differ."""


@dataclass(frozen=True, eq=False)
class Meeting:
    """A place where two strands touch, in the left and in the right view."""

    contacts: tuple[Contact | None, Contact | None]
    """None where that view alone does not show it, or its arms are not told."""
    are_same: bool = True
    """Whether the strands leave it with the same arms in both views."""

    def lead(self, view: int) -> float:
        """By how much less well, as both views tell, the strands of one would fit if they left it with each
        other's arm; infinite where that view does not show it."""
        own, other = self.contacts[view], self.contacts[1 - view]
        if own is None:
            return np.inf
        if other is None:
            return own.energy
        return own.energy + (other.energy if self.are_same else -other.energy)

    def ways(self, view: int) -> Ways:
        """Where the strands of a view had better go on as each other does."""
        contact = self.contacts[view]
        if contact is None:
            return []
        least = -CLEARLY if self.are_same else 0.0
        return contact.ways if self.lead(view) < least else contact.sides

    @property
    def is_shown_by_both(self) -> bool:
        """Whether both views tell of it."""
        return None not in self.contacts


def untangled(
    threads: tuple[Thread, Thread],
    ridges: tuple[Ridges, Ridges],
    depths: tuple[Depth, Depth],
    places: tuple[Float64, Float64],
) -> tuple[Thread, Thread]:
    """A thread in the left and in the right view, after exchanging the ways on of strands that touch for as
    long as both views together ask for that, and with the doubts about these settled.

    Args:
        threads: as each view by itself has it.
        ridges: of each view.
        depths: of arms in each view.
        places: (2,) pixels on it.
    """
    left, right = threads
    found_left, found_right = map(contacts, threads, ridges, depths)
    decided = list[Meeting]()
    for _ in range(_MOST_EXCHANGES):
        found = meetings(found_left, found_right)
        wrong = [meeting for meeting in found if meeting.ways(0) or meeting.ways(1)]
        if not wrong:
            break
        # What one view shows by itself may be put right by what both do.
        worst = min(wrong, key=lambda m: (not m.is_shown_by_both, min(m.lead(0), m.lead(1))))
        decided.append(worst)
        if worst.ways(0):
            left = left.exchanged(worst.ways(0), places[0])
            found_left = contacts(left, ridges[0], depths[0])
        if worst.ways(1):
            right = right.exchanged(worst.ways(1), places[1])
            found_right = contacts(right, ridges[1], depths[1])
    found = meetings(found_left, found_right)
    # An exchange is no surer than what it was decided by.
    leads = [
        [*_leads(found, view), *((pixels, abs(lead)) for pixels, lead in _leads(decided, view))]
        for view in (0, 1)
    ]
    return left.told(leads[0]), right.told(leads[1])


def _leads(found: list[Meeting], view: int) -> list[tuple[Float64, float]]:
    """The pixels (k, 2) of all contacts of a view, and their leads."""
    seen = [(meeting.contacts[view], meeting.lead(view)) for meeting in found]
    return [(contact.pixels, lead) for contact, lead in seen if contact is not None]


def meetings(left: list[Contact], right: list[Contact]) -> list[Meeting]:
    """The contacts of both views, those of the same place together."""
    alone, found = list(right), list[Meeting]()
    for contact in left:
        partner = _partner(contact, alone)
        are_same = None if partner is None else _are_same(contact, partner)
        if partner is None or are_same is None:
            found.append(Meeting((contact, None)))
        else:
            alone.remove(partner)
            found.append(Meeting((contact, partner), are_same))
    return found + [Meeting((None, contact)) for contact in alone]


def _partner(contact: Contact, others: list[Contact]) -> Contact | None:
    """That of the other view's contacts which is the same place."""
    there = contact.pixels - (contact.disparity, 0)
    if not np.isfinite(there).all() or not others:
        return None
    tree = cKDTree(there)
    apart = [float(np.min(tree.query(other.pixels)[0])) for other in others]
    nearest = int(np.argmin(apart))
    return others[nearest] if apart[nearest] < _SAME_PX else None


def _are_same(contact: Contact, other: Contact) -> bool | None:
    """Whether the strands of two views leave a place with the same arms; None where that is not told."""
    sides = [_side(arm, other) for arm in contact.own]
    is_same = None if None in sides else sides[0] == sides[1]
    if is_same is False and min(contact.energy, other.energy) > _CONTRADICTED:
        return None
    return is_same


def _side(arm: Arm, contact: Contact) -> bool | None:
    """Whether the arm of another view is one of the thread's; None if it is none of either strand."""
    if not len(arm.there):
        return None
    own, other = (
        min(np.median(cKDTree(a.pixels).query(arm.there)[0]) for a in arms)
        for arms in (contact.own, contact.other)
    )
    return None if min(own, other) > _ON_PX or abs(own - other) < _APART_PX else bool(own < other)

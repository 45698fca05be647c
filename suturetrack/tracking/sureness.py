"""How sure it is that the curve that is followed is the thread, as looks add up."""

from __future__ import annotations

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, PlacedDoubts, remaining
from suturetrack.nurbs import evaluate
from suturetrack.polylines import nearest_index, polyline_distances, resample
from suturetrack.tracking.length import has_length
from suturetrack.tracking.sampling import length_of
from suturetrack.types import Float64, Nurbs

SURE = 0.5
"""Confidence of a single look from which its curve may be called the thread."""
# And that of a first one that needs no other.
_AT_ONCE = 0.75
SINGLE = 0.9
"""Confidence of a look that is enough alone, whatever others were in doubt of."""
# Votes that make a curve sure, if no doubt stays: of a sure look one, and half of one of others; and of one
# that was looked at often, against the number of looks.
_ENOUGH, _OFTEN_ENOUGH = 1.5, 0.3
# Votes below which a curve is not worth looking from, and a look settles no doubts.
_HOPELESS = 0.01
# How far apart two doubts about one place are, and by how much the lengths of what is one curve differ: the
# thread keeps its length as it moves, and what it makes up with another one does not.
_SAME_PLACE, _SAME_LENGTH = 0.12, 0.002
# Two looks see the same if they are nowhere further apart, and another thing if they are somewhere.
_SAME_PX, _OTHER_PX = 5.0, 15.0
# Share of one curve along which another one has little of it.
_LITTLE = 0.3
# How much the thread has to bend between two looks that both count.
_BENT_PX = 2.0
_PLACES = 64
# What a curve may lack at an end, as a part of the thread.
_LACKING = 0.15
# Looks that follow the first one at once: any picture may be an unlucky one.
_FIRST_LOOKS = 2
# The pause before another one. It doubles after every few looks, so often at most where the thread
# moves and at rest.
_PAUSE_NS = 250_000_000
_FEW = 4
_MOVING, _RESTING = 2, 4


class Sureness:
    """What the looks at a thread say together.

    A look votes for the curve that is followed if it finds the same one, from end to end in the same
    order but for what the curve may lack at an end, and against it if it finds another. A sure look has
    one vote, any other the square of its confidence against that. What is voted down gives way to what
    the last look found. Looks are added up along one length only, unless both are sure: what has another
    one counts instead, if it has more votes, or alone a sure look. A look at the same picture says nothing
    new: it counts only if the thread has bent since the last one that did, or if it is sure by itself.

    A place that one look doubts may be clear in another one that finds the same: of each doubt of the
    first look only the least is left that any has there. No votes outweigh one that stays.

    A curve that was sure and is revoked stands accused until it moves: what lies still and is no thread
    looks the same in every look.

    Args:
        found: what the first look found.
        curve: where it is followed.
        now_ns: capture time of the field.
        rig: the cameras.
        before: how sure it was of what was followed before.
        is_known: whether it has the length of a thread that was sure: any sure look that finds it so long
            is enough then.
    """

    def __init__(
        self,
        found: Initialization,
        curve: Nurbs,
        now_ns: int,
        rig: StereoRig,
        before: Sureness | None = None,
        *,
        is_known: bool = False,
    ) -> None:
        self._rig = rig
        self._begin(found, _votes(found.confidence))
        self._accused: Float64 | None = None if before is None else before._accused
        self._is_revoked = False
        """Whether it was sure of the curve that is followed, and is no more."""
        self._known_length = length_of(found.curve) if is_known else None
        enough = SURE if is_known else _AT_ONCE
        self.is_sure = found.confidence >= enough and not self._is_accused(curve)
        """Whether the curve that is followed may be called the thread."""
        self._shape = self._outline(curve)
        self._first_looks, self._looks, self._last_ns = 0, 0, now_ns

    @property
    def is_hopeless(self) -> bool:
        """Whether next to nothing speaks for the curve that is followed."""
        return self._votes < _HOPELESS

    def ask_at_once(self) -> None:
        """Has what was found from a seed looked at again without a pause."""
        self._first_looks = _FIRST_LOOKS

    @property
    def is_new(self) -> bool:
        """Whether what is followed is in doubt, and has hardly been looked at yet."""
        return not self.is_sure and self._first_looks > 0

    def asks_for_look(self, curve: Nurbs, now_ns: int) -> bool:
        """Whether it is time to look again at what is followed."""
        if self.is_new:
            self._first_looks -= 1
            return True
        passed, doublings = now_ns - self._last_ns, -(-self._looks // _FEW)
        if self.is_sure or passed < _PAUSE_NS << min(doublings, _MOVING):
            return False
        if passed < _PAUSE_NS << min(doublings, _RESTING) and not self._has_bent(curve):
            return False
        self._looks, self._last_ns = self._looks + 1, now_ns
        return True

    def revoke(self, curve: Nurbs, now_ns: int) -> None:
        """Makes what was sure open again: looks have to tell."""
        if self.is_sure:
            self._accused, self._is_revoked = self._outline(curve), True
            self.is_sure, self._votes, self._known_length = False, _HOPELESS, None
            self._length = 0.0
            self._first_looks, self._looks, self._last_ns = 0, 0, now_ns

    def reinstate(self) -> None:
        """Takes back what was revoked: the accusation was about something else."""
        if self._is_revoked:
            self._accused, self._is_revoked = None, False
            self.is_sure, self._votes = True, _ENOUGH

    def weigh(self, found: Initialization, followed: Nurbs) -> bool:
        """Adds a look; whether what it found, in the direction of what is followed, takes its place."""
        is_sure, votes = found.confidence >= SURE, _votes(found.confidence)
        apart = self._away(found.curve, followed)
        agrees = apart < _SAME_PX or self.is_same(found.curve, followed)
        if agrees and self._is_accused(followed):
            return False
        if not is_sure and (votes < _HOPELESS or not self._has_bent(followed)):
            return False
        if not agrees and apart < _OTHER_PX:
            agrees = is_sure
            if not is_sure and (self._accused is None or self.is_sure):
                return False
        if agrees:
            self._agree(found, votes)
            self._shape = self._outline(followed)
            return is_sure and apart >= _SAME_PX
        self._votes -= votes
        is_outvoted = self._votes < 0
        if is_outvoted:
            self._begin(found, -self._votes)
            self._is_revoked = False
        self.is_sure = is_outvoted and found.confidence >= SINGLE
        self._shape = self._outline(found.curve if is_outvoted else followed)
        return is_outvoted

    def outweighs(
        self, found: Initialization, now: Nurbs, followed: Nurbs, *, makes_detour: bool
    ) -> bool:
        """Whether a look that found a curve of the thread's length, which is followed to where it is now,
        tells that this runs elsewhere: any that is sure, and one beside what makes a detour."""
        away = self._away(now, followed)
        is_likely = found.confidence >= SURE or (makes_detour and away < _OTHER_PX)
        return is_likely and away >= _SAME_PX

    def is_same(self, found: Nurbs, followed: Nurbs, *, may_move: bool = False) -> bool:
        """Whether what was found is what is followed, which may lack a little at its ends.

        Args:
            found, followed: the curves.
            may_move: it may have moved a little as a whole since it was followed.
        """
        both = zip(self._lines(found), self._lines(followed), strict=True)
        moved_px = _OTHER_PX if may_move else 0.0
        return max(_apart(whole, part, moved_px) for whole, part in both) < _SAME_PX

    def is_elsewhere(self, found: Nurbs, followed: Nurbs) -> bool:
        """Whether what was found has little of what is followed."""
        there, here = self._lines(found)[0], self._lines(followed)[0]
        return bool(np.mean(polyline_distances(here, there) < _SAME_PX) < _LITTLE)

    def is_part(self, part: Nurbs, whole: Nurbs) -> bool:
        """Whether one curve lies on another one, as far as it reaches."""
        both = zip(self._lines(part), self._lines(whole), strict=True)
        return all(polyline_distances(*lines).max() < _SAME_PX for lines in both)

    def lacks_more(self, found: Nurbs, followed: Nurbs) -> bool:
        """Whether what was found is a part of what is followed, and lacks more than a little."""
        is_short = length_of(found) <= (1 - _LACKING) * length_of(followed)
        return is_short and self.is_part(found, followed)

    def _begin(self, found: Initialization, votes: float) -> None:
        """With what speaks for another curve."""
        self._votes = votes
        self.confidence = found.confidence
        """The best of a look that found what is followed."""
        self._doubts, self._length = found.doubts, length_of(found.curve)

    def _agree(self, found: Initialization, votes: float) -> None:
        """With a look at what is followed: its votes, and the doubts that it shares."""
        length = length_of(found.curve)
        is_as_long = abs(length - self._length) <= _SAME_LENGTH * self._length
        if is_as_long or min(found.confidence, self.confidence) >= SURE:
            doubts = _lessened(self._doubts, found.doubts) if is_as_long else found.doubts
            self._votes, self._doubts, self._length = self._votes + votes, doubts, length
            self.confidence = max(self.confidence, found.confidence)
        elif votes > self._votes or found.confidence >= SURE > self.confidence:
            self._begin(found, votes)
        enough = max(_ENOUGH, _OFTEN_ENOUGH * self._looks)
        is_enough = self._votes >= enough and remaining(self._doubts) >= SURE
        is_known = self._known_length is not None and has_length(found.curve, (self._known_length,))
        self.is_sure = is_enough or found.confidence >= (SURE if is_known else SINGLE)

    def _is_accused(self, curve: Nurbs) -> bool:
        """Whether it is a curve that was revoked, and has not moved."""
        accused = self._accused
        return accused is not None and _farthest(self._outline(curve), accused) < _SAME_PX

    def _has_bent(self, curve: Nurbs) -> bool:
        """Whether its left image is no more the one that counted last, moved, turned and enlarged."""
        now, before = (
            p - p.mean()
            for p in (view[0] @ [1, 1j] for view in (self._outline(curve), self._shape))
        )
        along = abs(np.vdot(before, now)) ** 2 / np.vdot(before, before).real
        rest = np.vdot(now, now).real - along
        return bool(rest >= len(now) * _BENT_PX**2)

    def _away(self, found: Nurbs, followed: Nurbs) -> float:
        """How far two curves are apart, px."""
        return _farthest(self._outline(found), self._outline(followed))

    def _outline(self, curve: Nurbs) -> Float64:
        """(2, k, 2) px, evenly spaced along the left and along the right image of the curve."""
        return np.stack([resample(view, _PLACES) for view in self._lines(curve)])

    def _lines(self, curve: Nurbs) -> tuple[Float64, Float64]:
        """Its left and its right image, each (n, 2) px."""
        s: Float64 = np.linspace(0, 1, 8 * _PLACES)
        return self._rig.project(evaluate(curve, s))


def _apart(whole: Float64, part: Float64, moved_px: float) -> float:
    """How far two lines, each (n, 2), are apart from end to end without what the second one lacks, once
    it is moved by so much at most."""
    reach = round(_LACKING * len(whole))
    start, stop = (
        nearest_index(tip, end)
        for tip, end in ((whole[:reach], part[0]), (whole[: -reach - 1 : -1], part[-1]))
    )
    steps = resample(whole[start : len(whole) - stop], _PLACES) - resample(part, _PLACES)
    moved = np.median(steps, axis=0)
    moved *= min(moved_px / max(float(np.linalg.norm(moved)), 1e-9), 1.0)
    return _farthest(steps, moved)


def _farthest(one: Float64, other: Float64) -> float:
    """Distance of those of (..., 2) points that are the farthest apart."""
    return float(np.linalg.norm(one - other, axis=-1).max())


def _lessened(doubts: PlacedDoubts, later: PlacedDoubts) -> PlacedDoubts:
    """What is left of doubts once another look at the same curve has had its own."""
    left, right = (
        tuple(
            (s, max(rest, min((r for at, r in now if abs(at - s) < _SAME_PLACE), default=1.0)))
            for s, rest in before
        )
        for before, now in zip(doubts, later, strict=True)
    )
    return left, right


def _votes(confidence: float) -> float:
    return min((confidence / SURE) ** 2, 1.0)

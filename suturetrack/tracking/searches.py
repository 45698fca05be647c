"""The ways in which a thread is looked for; none depends on what changes meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.length import has_length, length_error
from suturetrack.tracking.overlaps import doubting_ends, known_as, lies_on, means_no_other
from suturetrack.tracking.pursuit import Pursuit
from suturetrack.tracking.recovery import Setup, directed, find_again, find_elsewhere, starts_on
from suturetrack.tracking.sampling import length_of
from suturetrack.tracking.strands import Neighbours
from suturetrack.tracking.sureness import SINGLE
from suturetrack.types import InputError, Nurbs, RidgeField, Seed

Found = Initialization | InitializationError | None
"""What a look found; None for nothing that could be the thread."""


@dataclass(frozen=True, eq=False)
class FromSeed:
    """The search for a thread that nobody has found yet."""

    seed: Seed
    setup: Setup
    toward: Nurbs | None
    """A curve that tells its direction."""
    is_urgent: ClassVar[bool] = False

    def find(self, field: RidgeField) -> Found:
        """The thread through the seed, or why there is none."""
        try:
            found = self.setup.look(field, self.seed)
        except InitializationError as error:
            return error
        return found if self.toward is None else directed(found, self.toward)

    def beside(self, others: Neighbours, found: Initialization) -> Found:
        """What was found, unless it is a thread that is tracked under another name."""
        rig = self.setup.rig_of(found)
        if name := known_as(found, others, rig):
            reason = f"that is thread {name} already"
            return InitializationError(reason, np.empty((0, 2)), found.growth)
        if means_no_other(found, self.seed, others, rig):
            found = found.meaning(either=False)
        return doubting_ends(found, others, rig)

    def pursue(self, found: Initialization, field: RidgeField) -> Pursuit:
        """Follows the first curve."""
        return Pursuit(found, field, self.seed, self.setup)


@dataclass(frozen=True, eq=False)
class Again:
    """The search for a thread that was lost."""

    seed: Seed
    setup: Setup
    last: Nurbs
    """Where it was held last."""
    known_lengths: tuple[float, ...]
    """What its length has to be one of, if anything."""
    rig: StereoRig
    """With the rows on which the last curve was held."""
    before: tuple[Follower, ...] = ()
    """Who knows how long the thread is."""
    level: float | None = None
    """How clearly the left view showed it, where it may be anywhere by now; None while it is held."""
    turn: int | None = None
    """From which of the places a brief search begins; None for one that takes all the time."""
    is_urgent: ClassVar[bool] = True

    def find(self, field: RidgeField) -> Found:
        """A thread of the known length."""
        starts = starts_on(self.last, self.seed, field, self.rig)
        first = (self.turn or 0) % len(starts)
        starts = starts[first:] + starts[:first]
        last, known, setup = self.last, self.known_lengths, self.setup
        found = find_again(last, known, starts, field, setup, is_brief=self.turn is not None)
        if found is not None or self.level is None:
            return found
        return find_elsewhere(last, known, self.level, field, setup, self.seed.thread)

    def beside(self, others: Neighbours, found: Initialization) -> Found:
        """What was found, unless it is one of the other threads."""
        return _none_of(others, found, self.rig)

    def pursue(self, found: Initialization, field: RidgeField) -> Pursuit:
        """Follows the thread, with what was known of its length."""
        before = _who_knew(found.curve, self.before)
        return Pursuit(found, field, self.seed, self.setup, before, is_fresh=True)


@dataclass(frozen=True, eq=False)
class Closer:
    """Another look at a thread that is followed, but not for sure."""

    seed: Seed
    """On the thread where it was found at first."""
    setup: Setup
    followed: Nurbs
    """Where it is followed."""
    before: tuple[Follower, ...]
    """Who knows how long the thread is."""
    is_urgent: bool = False
    """Whether it does not wait for the fields to come: the thread has just been found."""

    def find(self, field: RidgeField) -> Found:
        """A thread of the known length through the place of the seed."""
        try:
            found = self.setup.look(field, self.seed)
        except (InitializationError, InputError):  # The place may have left the image.
            return None
        return directed(found, self.followed) if self._may_be(found) else None

    def _may_be(self, found: Initialization) -> bool:
        return has_length(found.curve, lengths(self.before))

    def beside(self, others: Neighbours, found: Initialization) -> Found:
        """What was found, unless it is one of the other threads."""
        return _none_of(others, found, self.setup.rig_of(found))

    def pursue(self, found: Initialization, field: RidgeField) -> Pursuit:
        """Follows what this look found."""
        before = _who_knew(found.curve, self.before)
        return Pursuit(found, field, self.seed, self.setup, before)


@dataclass(frozen=True, eq=False)
class Further(Closer):
    """A look at a thread that is followed for sure, but shows beyond an end: it is longer than was known, and
    nothing else tells that it is the thread."""

    def _may_be(self, found: Initialization) -> bool:
        is_longer = length_of(found.curve) > length_of(self.followed)
        return is_longer and found.confidence >= SINGLE and not super()._may_be(found)


def _none_of(others: Neighbours, found: Initialization, rig: StereoRig) -> Initialization | None:
    surer = others.as_sure_as(found.confidence)
    if known_as(found, others, rig) or lies_on(found.curve, surer, rig):
        return None
    return doubting_ends(found, others, rig)


Search = FromSeed | Again | Closer


def lengths(followers: tuple[Follower, ...]) -> tuple[float, ...]:
    """What the length of the thread may be, by those who know it."""
    return tuple(known for follower in followers for known in follower.known_length.possible)


def _who_knew(curve: Nurbs, before: tuple[Follower, ...]) -> Follower | None:
    """Who knew a length that is nearest to that of the curve; None where nobody knew any."""
    return min(before, key=lambda f: length_error(curve, f.known_length.possible), default=None)

"""The three ways in which a thread is looked for; none depends on what changes meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.pursuit import Pursuit
from suturetrack.tracking.recovery import (
    Setup,
    directed,
    find_again,
    has_length,
    lies_on,
    starts_on,
)
from suturetrack.tracking.strands import Neighbours
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

    def find(self, field: RidgeField, _: Neighbours) -> Found:
        """The thread through the seed, or why there is none."""
        try:
            found = self.setup.look(field, self.seed)
        except InitializationError as error:
            return error
        if self.toward is None:
            return found
        return directed(found, self.toward)

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
    before: Follower | None
    """As it was who lost the thread."""
    turn: int | None
    """From which of the places a brief search begins; None for one that takes all the time."""

    def find(self, field: RidgeField, others: Neighbours) -> Found:
        """A thread of the known length that is none of the others."""
        starts = starts_on(self.last, self.seed, field, self.rig)
        is_brief, first = self.turn is not None, (self.turn or 0) % len(starts)
        starts = starts[first:] + starts[:first]
        found = find_again(
            self.last, self.known_lengths, starts, field, self.setup, is_brief=is_brief
        )
        return None if found is None or lies_on(found.curve, others, self.rig) else found

    def pursue(self, found: Initialization, field: RidgeField) -> Pursuit:
        """Follows the thread, with what was known of its length."""
        return Pursuit(found, field, self.seed, self.setup, self.before, is_fresh=True)


@dataclass(frozen=True, eq=False)
class Closer:
    """Another look at a thread that is followed, but not for sure."""

    seed: Seed
    """On the thread where it was found at first."""
    setup: Setup
    followed: Nurbs
    """Where it is followed."""
    before: Follower | None
    """As it was who follows the thread, if its length is known."""

    def find(self, field: RidgeField, others: Neighbours) -> Found:
        """A thread of the known length through the place of the seed that is none of the others."""
        try:
            found = self.setup.look(field, self.seed)
        except (InitializationError, InputError):  # The place may have left the image.
            return None
        known_lengths = () if self.before is None else self.before.known_lengths
        rig = self.setup.rig.with_row_offset(found.row_offset_px)
        if lies_on(found.curve, others, rig) or not has_length(found.curve, known_lengths):
            return None
        return directed(found, self.followed)

    def pursue(self, found: Initialization, field: RidgeField) -> Pursuit:
        """Follows what this look found."""
        return Pursuit(found, field, self.seed, self.setup, self.before)


Search = FromSeed | Again | Closer

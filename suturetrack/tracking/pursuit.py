"""A thread that is followed from where it was found."""

from __future__ import annotations

from dataclasses import replace

from suturetrack.initialization import Initialization
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.overlaps import lies_on
from suturetrack.tracking.recovery import Setup, find_again, starts_on
from suturetrack.tracking.strands import Neighbours
from suturetrack.tracking.sureness import SURE
from suturetrack.types import RidgeField, Seed, Status, ThreadState

# A thread that was just found has no velocity yet: if it runs away it is found once more.
_JUST_NS = 110_000_000


class Pursuit:
    """Follows what a look found.

    Args:
        found: what was found in `field`.
        seed: from where the thread was looked for at first; names it.
        before: who followed the thread before, if its length is known.
        is_fresh: whether it may run away before its velocity is known.
    """

    def __init__(
        self,
        found: Initialization,
        field: RidgeField,
        seed: Seed,
        setup: Setup,
        before: Follower | None = None,
        *,
        is_fresh: bool = False,
    ) -> None:
        self._seed, self._setup = seed, setup
        self.follower = setup.follower(found, field, before)
        self.found = found
        """What is followed, as it was found."""
        self._found_at = (field.stamp.capture_ns, found.curve) if is_fresh else None

    def step(self, field: RidgeField, others: Neighbours) -> ThreadState:
        """The thread in the next field; if it has just been found and runs away, where it is found."""
        state = self.follower.step(field, self._seed.thread, others)
        if state.status is Status.TRACKING or not self._is_fresh(field):
            return state
        return self._find_once_more(state, field, others) or state

    def lies_on(self, others: Neighbours) -> bool:
        """Whether what is followed now is one of the other threads."""
        surer = others.as_sure_as(self.found.confidence)
        return lies_on(self.follower.model.curve, surer, self.follower.rig)

    def _is_fresh(self, field: RidgeField) -> bool:
        return (
            self._found_at is not None and 0 < field.stamp.capture_ns - self._found_at[0] < _JUST_NS
        )

    def _find_once_more(
        self, state: ThreadState, field: RidgeField, others: Neighbours
    ) -> ThreadState | None:
        """Where the thread is found twice in a row, the step between tells its velocity."""
        assert self._found_at is not None
        old = self.follower
        starts = starts_on(old.last_good, self._seed, field, old.rig)
        found = find_again(old.last_good, old.known_length.possible, starts, field, self._setup)
        if found is None or lies_on(found.curve, others, old.rig):
            return None
        if state.status is Status.OCCLUDED and found.confidence < SURE:
            return None
        follower = self._setup.follower(found, field, old)
        again = follower.step(field, self._seed.thread, others)
        if again.status is not Status.TRACKING:
            return None
        before_ns, before = self._found_at
        follower.came_from(before, (field.stamp.capture_ns - before_ns) * 1e-9)
        self.follower, self.found = follower, found
        self._found_at = field.stamp.capture_ns, follower.model.curve
        return replace(again, events=("found again", *again.events))

"""One seeded thread: looked for, followed, looked at again."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.nurbs import evaluate
from suturetrack.polylines import nearest_index
from suturetrack.tracking.clearness import Clearness
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import has_length
from suturetrack.tracking.looks import Look, Outcome
from suturetrack.tracking.overlaps import doubting_ends
from suturetrack.tracking.pursuit import Pursuit
from suturetrack.tracking.recovery import Setup
from suturetrack.tracking.reliability import RELIABILITY_SAMPLES
from suturetrack.tracking.searches import Again, Closer, FromSeed, Further, Search, lengths
from suturetrack.tracking.springs import sprung_in_depth
from suturetrack.tracking.strands import Neighbours
from suturetrack.tracking.strangers import Strangers
from suturetrack.tracking.sureness import SURE, Sureness
from suturetrack.types import Energies, Float64, Nurbs, RidgeField, Seed, Stamp, Status, ThreadState

# An attempt to find a thread again takes as long as many fields: so many are followed in between,
# and more of them after so many attempts.
_REST = 4
_QUICK_ATTEMPTS = 6
_RAREST = 3
# After so many in vain, some 5 s, it may have been cut or drawn out meanwhile: what is sure to be a thread
# may have any length, at every other attempt.
_ATTEMPTS = 12
# And so many in vain at one that is followed, a second: it may be another one that had its length.
_LOOKS = 2
# A thread that was never sure is no stub of what it was found as with some hope, against the longest.
_STUB = 0.5
# The pause between looks at a curve that other ridges may draw aside.
_PAUSE_NS = 500_000_000
# And at one that shows further on.
_FURTHER_NS = 250_000_000
FOUND, GIVEN_UP = "found", "given up"
"""Events of what came of a seed."""
_NOWHERE = np.full(RELIABILITY_SAMPLES, np.inf)


class Thread:
    """What is known of one seeded thread.

    Args:
        seed: names it; where it was found first, if it was.
        last: where another tracker left it.
    """

    def __init__(self, seed: Seed, setup: Setup, last: ThreadState | None = None) -> None:
        self.name, self.looked_ns = seed.thread, -1
        self._seed, self._sought, self._setup = seed, seed, setup
        state = last or not_found(seed.thread, Stamp(0, 0, 0), ())
        self._state = self._followed = replace(state, status=Status.LOST, events=())
        self._patience = 0
        """Fields in which it is still looked for from the seed."""
        self._know_nothing()
        self._was_sure = last is not None and last.status is Status.TRACKING

    def _know_nothing(self) -> None:
        self._pursuit: Pursuit | None = None
        self._sureness: Sureness | None = None
        self._strangers = Strangers()
        self._was_sure = False
        self._known: Follower | None = None
        """As it was who followed the thread when that was sure last."""
        self._longest = 0.0
        """Length of a curve that was found with some hope, at most."""
        self._seeded_at = 0.5
        """Parameter of the curve at which it was found."""
        self._is_seed_shared = False
        """Whether another thread may be meant: no look can tell, but one that shows no other."""
        self._fields_to_rest = self._attempts = self._looks_in_vain = 0
        self._clearness = Clearness()

    def seek(self, seed: Seed) -> None:
        """Has the thread looked for from a seed; until it is found there, it is held where it is."""
        self._sought, self._patience = seed, self._setup.tracking.patience

    @property
    def is_known(self) -> bool:
        """Whether there is a curve, which may be lost."""
        return self._state.curve is not None

    @property
    def is_held(self) -> bool:
        """Whether there is a curve that is not lost."""
        return self._state.status is not Status.LOST

    @property
    def is_tracked(self) -> bool:
        """Whether it is held for sure, and most of it is seen."""
        return self._state.status is Status.TRACKING

    @property
    def is_astray(self) -> bool:
        """Whether it has to be found again."""
        is_doubtful = self.follower is not None and self.follower.is_doubtful
        return not self.is_held or (self._state.status is Status.OCCLUDED and is_doubtful)

    @property
    def is_sought(self) -> bool:
        """Whether it has not been found from the last seed yet, nor been given up."""
        return self._patience > 0

    @property
    def follower(self) -> Follower | None:
        """Who follows the thread, once it has been found."""
        return None if self._pursuit is None else self._pursuit.follower

    @property
    def confidence(self) -> float:
        """The best of a look at the curve that is followed; 0 without one."""
        return 0.0 if self._sureness is None else self._sureness.confidence

    def state_at(self, stamp: Stamp, is_new: bool) -> ThreadState:
        """What has become of the thread."""
        events = self._state.events if is_new else ("not newer than the last field",)
        return replace(self._state, stamp=stamp, events=events)

    def follow(self, field: RidgeField, others: Neighbours, all_held: bool) -> None:
        """Goes on to the next field, as far as the thread can be followed.

        Args:
            others: strands of the other threads that are held.
            all_held: whether these are all; what moves may be one that is not held.
        """
        if self._pursuit is None:
            self._state = replace(self._state, events=())
            return
        state = self._pursuit.step(field, others)
        was_lost, is_lost = not self.is_held, state.status is Status.LOST
        self._clearness.step(field, self._pursuit.follower.model.levels, is_lost=is_lost)
        if is_lost != was_lost:
            state = replace(state, events=("lost" if is_lost else "recovered", *state.events))
        if all_held and not is_lost:
            self._look_for_strangers(state, field, others)
        else:
            self._strangers = self._strangers.of_another()
        self._come_to(state)
        if not self.is_astray:
            self._fields_to_rest = self._attempts = 0

    def _look_for_strangers(
        self, state: ThreadState, field: RidgeField, others: Neighbours
    ) -> None:
        """Where the thread may have left the curve, nothing that was sure of the curve still is."""
        assert self.follower is not None
        assert self._sureness is not None
        model, rig = self.follower.model, self.follower.rig
        images = Images(field, rig, model.levels)
        self._strangers = self._strangers.step(model.curve, state.seen, images, others)
        if self._strangers.is_found:
            self._sureness.revoke(model.curve, field.stamp.capture_ns)
        elif self._strangers.are_gone and state.status is Status.TRACKING:
            self._sureness.reinstate()

    def _come_to(self, state: ThreadState) -> None:
        """What is not sure to be the thread is not called so."""
        self._followed = state
        is_sure = self._is_sure and not self._strangers.is_found
        if is_sure:
            self._was_sure, self._known = True, copy.copy(self.follower)
            self._looks_in_vain = 0
        if state.status is Status.TRACKING and not is_sure:
            state = replace(state, status=Status.OCCLUDED)
        self._state = state

    def search(self, now_ns: int, is_beside: bool) -> Search | None:
        """How the thread is to be looked for now; None for not at all.

        Args:
            is_beside: whether others are tracked beside, so that it should not take long.
        """
        if self.is_sought:
            search = self._search_from_seed()
        elif not self.is_known:
            search = None
        elif self.is_astray:
            search = self._search_again(is_beside)
        else:
            search = self._search_closer(now_ns)
        if search is not None:
            self.looked_ns = now_ns
        return search

    def _search_from_seed(self) -> Search:
        self._patience -= 1
        return FromSeed(self._sought, self._setup, self._state.curve)

    def _search_again(self, is_beside: bool) -> Search | None:
        if self._rests():
            return None
        seed, setup, held = self._seed, self._setup, self.follower
        turn = self._attempts - 1 if is_beside else None
        if held is None:
            assert self._state.curve is not None
            known = (self._state.length,) if self._attempts <= _QUICK_ATTEMPTS else ()
            return Again(seed, setup, self._state.curve, known, setup.rig, turn=turn)
        knows = self._looks_in_vain < _LOOKS
        knows &= self._attempts <= _ATTEMPTS or self._attempts % 2 == 0
        before = self._who_knows_its_length() if knows else ()
        level = None if self.is_held else held.model.levels[0]
        return Again(seed, setup, held.last_good, lengths(before), held.rig, before, level, turn)

    def _rests(self) -> bool:
        """Whether this field is one between two attempts; counts both."""
        if self._fields_to_rest <= 0:
            self._fields_to_rest = _REST << min(max(self._attempts - _QUICK_ATTEMPTS, 0), _RAREST)
            self._attempts += 1
            return False
        self._fields_to_rest -= 1
        return not self._clearness.is_back

    def _search_closer(self, now_ns: int) -> Search | None:
        assert self.follower is not None
        assert self._sureness is not None
        curve = self.follower.model.curve
        is_due = self._may_be_aside and now_ns - self.looked_ns >= _PAUSE_NS
        is_new = self._sureness.is_new
        if not (is_due or self._sureness.asks_for_look(curve, now_ns)):
            return self._search_further(now_ns)
        before = self._who_knows_its_length() if self._looks_in_vain < _LOOKS else ()
        return Closer(self._place_to_look_from(curve), self._setup, curve, before, is_urgent=is_new)

    def _search_further(self, now_ns: int) -> Search | None:
        """Of a thread whose length was never steady only a part may have been found."""
        assert self.follower is not None
        held = self.follower
        curve, ends = held.model.curve, held.model.ends
        may_be_part = self._is_sure and not held.known_length.was_established
        if not (may_be_part and ends.shows_more) or now_ns - self.looked_ns < _FURTHER_NS:
            return None
        place = self._place_to_look_from(curve)
        return Further(place, self._setup, curve, (copy.copy(held),))

    def _who_knows_its_length(self) -> tuple[Follower, ...]:
        """Who follows the thread, and who did when that was sure last: another curve may have been taken
        for it since. Nobody, where it never was sure."""
        if not self._was_sure:
            return ()
        return tuple(copy.copy(f) for f in (self._known, self.follower) if f is not None)

    def _place_to_look_from(self, curve: Nurbs) -> Seed:
        """The place of the curve at which it was found: another thread may lie on the seed's pixel by now."""
        x, y, z = (float(c) for c in evaluate(curve, np.array([self._seeded_at]))[0])
        return Seed(self.name, point=(x, y, z))

    def take_up(self, look: Look, others: Neighbours) -> bool:
        """Goes on with what a look found, if that is worth more; whether it tells anything new.

        Who was lost when the look began may be held by now where it has led.
        """
        was_sure, before = self._is_sure, self._pursuit
        outcome, search = look.outcome(), look.search
        if isinstance(search, Again):
            self._fields_to_rest = max(self._fields_to_rest - look.fields + 1, 0)
        if isinstance(search, FromSeed):
            self._take_first(outcome, look.fields)
        elif outcome.pursuit is None or outcome.pursuit.lies_on(others):
            self._looks_in_vain += isinstance(search, Closer) and not self._is_sure
        elif isinstance(search, Again):
            self._take_again(outcome, search.known_lengths)
        elif isinstance(search, Further):
            self._take_further(search, outcome)
        else:
            self._take_closer(search, outcome)
        return not was_sure or self._pursuit is not before

    def doubt_beside(self, others: Neighbours, now_ns: int) -> None:
        """Calls a curve open, and its length unknown, whose end runs on along threads that are surer."""
        if self._pursuit is None or self._sureness is None or not self._sureness.is_sure:
            return
        curve, rig = self._pursuit.follower.model.curve, self._pursuit.follower.rig
        found = replace(self._pursuit.found, curve=curve, confidence=self.confidence)
        doubted = doubting_ends(found, others, rig)
        if doubted.confidence < SURE:
            self._sureness = Sureness(doubted, curve, now_ns, rig, self._sureness)
            self._was_sure, self._known = False, None
            self._come_to(self._followed)

    def _take_first(self, outcome: Outcome, fields: int) -> None:
        if isinstance(outcome.found, InitializationError):
            # The first field was counted, and the last one is the first of the next look.
            self._patience -= max(fields - 2, 0)
            given_up = () if self.is_sought else (GIVEN_UP,)
            events = (f"not found: {outcome.found.reason}", *given_up, *self._state.events)
            self._state = replace(self._state, events=events)
            return
        assert outcome.found is not None
        self._know_nothing()
        self._seed, self._patience = self._sought, 0
        self._seeded_at = _nearest(outcome.found.curve, self._seed, self._setup.rig)
        self._is_seed_shared = outcome.found.is_seed_shared
        self._hold(outcome, FOUND)
        assert self._sureness is not None
        self._sureness.ask_at_once()

    def _take_again(self, outcome: Outcome, known_lengths: tuple[float, ...]) -> None:
        """A thread that is held still gives way only to a curve that is sure."""
        pursuit, state = outcome.pursuit, outcome.state
        assert pursuit is not None
        assert state is not None
        if state.curve is None or self._is_another(state.curve):
            return
        is_sure = pursuit.found.confidence >= SURE
        # Where any length was looked for, nothing else tells that it is the thread.
        has_no_length = self.follower is not None and self._was_sure and not known_lengths
        may_be_unsure = not (self.is_held or has_no_length)
        is_worse = self._state.status is not Status.TRACKING and (is_sure or may_be_unsure)
        # What is followed may have shrunk from what was found.
        is_whole = has_length(state.curve, known_lengths) and not self._is_stub(state)
        if is_worse and is_whole and state.status is Status.TRACKING:
            is_same = self._was_followed_for_sure(state.curve)
            before = self._sureness if is_same else None
            is_known = self._was_sure and bool(known_lengths)
            self._hold(outcome, "found again", before, is_known=is_known)

    def _is_another(self, found: Nurbs) -> bool:
        """Whether it is another thread, which may be as long: the one that is held was sure, and is in sight
        elsewhere."""
        if not (self.is_held and self._was_sure and self._sureness and self.follower):
            return False
        curve = self.follower.model.curve
        return self.follower.is_in_sight and self._sureness.is_elsewhere(found, curve)

    def _was_followed_for_sure(self, found: Nurbs) -> bool:
        """Whether it is what was followed for sure before it was lost, and beside the search."""
        if self.follower is None or self._sureness is None or not self._sureness.is_sure:
            return False
        before = self.follower.model.curve, self.follower.last_good
        rig, nowhere = self._setup.rig, np.zeros(RELIABILITY_SAMPLES, bool)
        return any(
            self._sureness.is_same(found, curve, may_move=True)
            and not sprung_in_depth(curve, found, rig, nowhere).any()
            for curve in before
        )

    def _is_stub(self, found: ThreadState) -> bool:
        """Whether a thread that was never sure would be far shorter than it was found before."""
        return not self._was_sure and found.length < _STUB * self._longest

    def _take_closer(self, search: Closer, outcome: Outcome) -> None:
        assert isinstance(outcome.found, Initialization)
        assert self._sureness is not None
        found, state = outcome.found, outcome.state
        if state is None or state.status is Status.LOST or self._is_stub(state):
            return
        # The rest may be hidden.
        if self._was_sure and self._sureness.lacks_more(found.curve, search.followed):
            return
        if found.is_alone and found.confidence >= SURE:
            self._is_seed_shared = False
        if self._puts_right(found, state):
            self._hold(outcome, "put right", self._sureness)
            return
        was_sure, may_be_unsure = self._is_sure, bool(search.before) or not self._was_sure
        if was_sure or not (may_be_unsure or found.confidence >= SURE):
            return
        if self._sureness.weigh(found, search.followed):
            self._seeded_at = _nearest(found.curve, search.seed, self._setup.rig)
            event = "found for sure" if self._is_sure else "found elsewhere"
            self._hold(outcome, event, self._sureness)
        elif self._is_sure:
            self._come_to(
                replace(self._followed, events=("found for sure", *self._followed.events))
            )

    def _take_further(self, search: Further, outcome: Outcome) -> None:
        assert isinstance(outcome.found, Initialization)
        assert self._sureness is not None
        found, state = outcome.found, outcome.state
        if state is None or state.status is not Status.TRACKING or state.curve is None:
            return
        if self._sureness.is_part(search.followed, found.curve):
            self._hold(outcome, "found further on")

    def _hold(
        self,
        outcome: Outcome,
        event: str,
        sureness: Sureness | None = None,
        *,
        is_known: bool = False,
    ) -> None:
        assert outcome.pursuit is not None
        assert outcome.state is not None
        self._pursuit, state = outcome.pursuit, outcome.state
        self._strangers = self._strangers.of_another()
        self._sureness = sureness or Sureness(
            outcome.pursuit.found,
            outcome.pursuit.follower.model.curve,
            state.stamp.capture_ns,
            self._setup.rig,
            self._sureness,
            is_known=is_known,
        )
        self._fields_to_rest = self._attempts = 0
        if not self._sureness.is_hopeless:
            self._longest = max(self._longest, state.length)
        self._come_to(replace(state, events=(event, *state.events)))

    def _puts_right(self, found: Initialization, state: ThreadState) -> bool:
        """Whether other ridges have drawn the curve aside, and a look finds where it should run."""
        assert self.follower is not None
        assert self._sureness is not None
        assert state.curve is not None
        if state.status is not Status.TRACKING or not self._may_be_aside:
            return False
        known, curve = self.follower.known_length, self.follower.model.curve
        if known.is_another(state.length, known.now, 0.0, is_clear=False):
            return False
        if known.is_exceeded(state.length, 0.0):
            return False
        makes_detour = self.follower.makes_detour
        return self._sureness.outweighs(found, state.curve, curve, makes_detour=makes_detour)

    @property
    def _may_be_aside(self) -> bool:
        held = self.follower
        return held is not None and (held.makes_detour or (self._is_sure and held.is_crowded))

    @property
    def _is_sure(self) -> bool:
        if self._sureness is None or self._is_seed_shared:
            return False
        return self._sureness.is_sure


def _nearest(curve: Nurbs, seed: Seed, rig: StereoRig) -> float:
    """Parameter of the curve's point that is nearest to the seed."""
    s: Float64 = np.linspace(0, 1, 400)
    points = evaluate(curve, s)
    places = points if seed.pixel is None else rig.project_raw(points)[0]
    wanted = np.array(seed.point if seed.pixel is None else seed.pixel)
    return float(s[nearest_index(places, wanted)])


def not_found(name: str, stamp: Stamp, events: tuple[str, ...]) -> ThreadState:
    """The state of a thread that has no curve."""
    return ThreadState(
        stamp=stamp,
        thread=name,
        status=Status.LOST,
        curve=None,
        length=float("nan"),
        energies=Energies(),
        sigma=_NOWHERE,
        seen=np.zeros(RELIABILITY_SAMPLES, bool),
        events=events,
    )

"""Holds the threads of one rig."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization import (
    Initialization,
    InitializationConfig,
    InitializationError,
    initialize,
)
from suturetrack.nurbs import evaluate
from suturetrack.tracking.clock import StreamClock
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.follower import Follower
from suturetrack.tracking.recovery import directed, find_again, has_length, lies_on
from suturetrack.tracking.reliability import RELIABILITY_SAMPLES
from suturetrack.tracking.strands import NOBODY, Neighbours
from suturetrack.types import Energies, Float64, Nurbs, RidgeField, Seed, Stamp, Status, ThreadState

FORGOTTEN = "forgotten"
"""Event of the last state of a thread that was dropped."""
# An attempt to find a thread again takes as long as many fields: so many are followed in between,
# and more of them after so many attempts.
_REST = 4
_QUICK_ATTEMPTS = 6
_RAREST = 3
# A thread that was just found has no velocity yet: if it runs away it is found once more.
_JUST_NS = 110_000_000
# A first curve of less confidence is followed, but not called the thread until a later look is surer.
_SURE = 0.5
_BETWEEN_LOOKS_NS = 250_000_000
_NOWHERE = np.full(RELIABILITY_SAMPLES, np.inf)


@dataclass(frozen=True, eq=False)
class TrackerStep:
    """What one field gave."""

    states: tuple[ThreadState, ...]
    """One for each seeded thread, in the order of the seeds."""
    initializations: dict[str, Initialization | InitializationError]
    """By thread: what came of looking for it from its seed in this field."""


@dataclass
class _Thread:
    seed: Seed
    attempts: int
    follower: Follower | None = None
    last: ThreadState | None = None
    toward: Nurbs | None = None
    """Curve of the thread that had the name before."""
    rest: int = 0
    """Fields in which the lost thread is not looked for again."""
    failures: int = 0
    """How often it was looked for in vain."""
    found: tuple[int, Nurbs] | None = None
    """When it was last found by looking for it, and where."""
    is_sure: bool = False
    """Whether the curve that is followed may be called the thread."""
    next_look_ns: int = 0
    """When a doubtful thread is looked at again."""
    looks: int = 0
    """How often it was."""
    was_sure: bool = False
    """Whether it ever was, so that the thread's length is known."""
    seeded_at: float = 0.5
    """Parameter of the curve at the seed."""
    rows: int = 0
    """How much lower than the calibration says the right view shows the thread, px."""


class Tracker:
    """Finds seeded threads and follows them from field to field."""

    def __init__(
        self,
        rig: StereoRig,
        config: TrackingConfig = TrackingConfig(),
        initialization: InitializationConfig = InitializationConfig(),
    ) -> None:
        self._rig, self._config, self._initialization = rig, config, initialization
        self._threads: dict[str, _Thread] = {}
        self._forgotten: list[str] = []
        self._clock = StreamClock()

    def seed(self, seed: Seed) -> None:
        """Looks for the thread from the next field on, for up to `config.patience` fields.

        A thread of the same name is looked for anew, and keeps its direction.
        """
        before, thread = self._threads.get(seed.thread), _Thread(seed, self._config.patience)
        if before is not None:
            thread.toward = (before.last and before.last.curve) or before.toward
        self._threads[seed.thread] = thread

    def resume(self, seed: Seed, last: ThreadState) -> None:
        """Takes a thread up where another tracker left it, lost until it is found again.

        Args:
            seed: from where it was looked for at first; names the thread.
            last: its last state, with a curve.

        It keeps the direction of the last curve, and counts as found if it has the same length; after
        some attempts in vain whatever its length is, for the last state may have been a bad one.
        """
        last = replace(last, status=Status.LOST, events=())
        self._threads[seed.thread] = _Thread(seed, 0, None, last, was_sure=True)

    def forget(self, thread: str) -> bool:
        """Drops the thread; the next step tells so in a last state without a curve.

        Returns whether there was such a thread.
        """
        known = self._threads.pop(thread, None) is not None
        if known:
            self._forgotten.append(thread)
        return known

    def step(self, field: RidgeField) -> TrackerStep:
        """The seeded threads in the next field.

        A field that is not newer than the last one changes nothing: its states are the last ones.
        Dates may jump; time then goes on from where it was.
        """
        is_new = self._clock.advance(field.stamp)
        dated = replace(field, stamp=replace(field.stamp, capture_ns=self._clock.now_ns))
        initializations: dict[str, Initialization | InitializationError] = {}
        states = [_not_found(name, field.stamp, (FORGOTTEN,)) for name in self._forgotten]
        self._forgotten.clear()
        for name, thread in self._threads.items():
            if thread.follower is not None and thread.last is not None and not is_new:
                state = replace(thread.last, events=("not newer than the last field",))
            elif thread.follower is not None:
                state = self._follow(name, thread, thread.follower, dated)
            elif thread.last is not None and thread.last.curve is not None:
                state = self._regain(name, thread, thread.last.curve, thread.last, dated)
            else:
                state = self._find(name, thread, dated, initializations)
            thread.was_sure |= thread.is_sure
            if state.status is Status.TRACKING and not thread.is_sure:
                state = replace(state, status=Status.OCCLUDED)
            thread.last = replace(state, stamp=field.stamp)
            states.append(thread.last)
        return TrackerStep(tuple(states), initializations)

    def _follow(
        self, name: str, thread: _Thread, follower: Follower, field: RidgeField
    ) -> ThreadState:
        if not thread.is_sure and self._look_closer(name, thread, follower, field):
            assert thread.follower is not None
            state = thread.follower.step(field, name, self._others(name, field))
            return replace(state, events=("found for sure", *state.events))
        state = follower.step(field, name, self._others(name, field))
        was_lost = thread.last is not None and thread.last.status is Status.LOST
        doubtful = follower.is_doubtful or self._just_found(thread, field)
        if state.status is Status.OCCLUDED and doubtful:
            last, length = follower.last_good, follower.known_length
            again = self._look_again(name, thread, last, length, field, is_held=True)
            return again or state
        if state.status is not Status.LOST:
            thread.rest = thread.failures = 0
            return replace(state, events=("recovered", *state.events)) if was_lost else state
        if not was_lost:
            state = replace(state, events=("lost", *state.events))
        again = self._look_again(name, thread, follower.last_good, follower.known_length, field)
        return again or state

    def _look_closer(
        self, name: str, thread: _Thread, follower: Follower, field: RidgeField
    ) -> bool:
        """Whether a new look from where the seed was is sure; what it finds is followed then."""
        if field.stamp.capture_ns < thread.next_look_ns:
            return False
        thread.next_look_ns = field.stamp.capture_ns + (_BETWEEN_LOOKS_NS << min(thread.looks, 4))
        thread.looks += 1
        curve = follower.model.curve
        x, y, z = (float(c) for c in evaluate(curve, np.array([thread.seeded_at]))[0])
        try:
            found = initialize(field, self._rig, Seed(name, point=(x, y, z)), self._initialization)
        except InitializationError:
            return False
        known_length = follower.known_length if thread.was_sure else None
        thread.is_sure = (
            found.confidence >= _SURE
            and has_length(found.curve, known_length)
            and not lies_on(found.curve, self._others(name, field), self._rig)
        )
        if thread.is_sure:
            thread.rest = thread.failures = thread.looks = 0
            thread.follower = self._follower(thread, directed(found.curve, curve), field)
            if thread.was_sure:
                thread.follower.remember(follower)
        return thread.is_sure

    def _regain(
        self, name: str, thread: _Thread, curve: Nurbs, last: ThreadState, field: RidgeField
    ) -> ThreadState:
        known_length = last.length if thread.failures < _QUICK_ATTEMPTS else None
        again = self._look_again(name, thread, curve, known_length, field)
        return again or replace(last, stamp=field.stamp)

    def _look_again(
        self,
        name: str,
        thread: _Thread,
        last: Nurbs,
        known_length: float | None,
        field: RidgeField,
        *,
        is_held: bool = False,
    ) -> ThreadState | None:
        """The state of a thread that is found again, every now and then looked for.

        One that is held still gives way only to a curve that is sure.
        """
        if thread.rest > 0 and not self._just_found(thread, field):
            thread.rest -= 1
            return None
        thread.rest = _REST << min(max(thread.failures - _QUICK_ATTEMPTS, 0), _RAREST)
        thread.failures += 1
        found = find_again(last, known_length, thread.seed, field, self._rig, self._initialization)
        others = self._others(name, field)
        if found is None or lies_on(found.curve, others, self._rig):
            return None
        is_sure = found.confidence >= _SURE
        if is_held and not is_sure:
            return None
        follower = self._follower(thread, found.curve, field)
        if thread.follower is not None:
            follower.remember(thread.follower)
        state = follower.step(field, name, others)
        if state.status is not Status.TRACKING:
            return None
        thread.follower, thread.is_sure, thread.looks = follower, is_sure, 0
        self._take_velocity(thread, field)
        return replace(state, events=("found again", *state.events))

    def _just_found(self, thread: _Thread, field: RidgeField) -> bool:
        return thread.found is not None and field.stamp.capture_ns - thread.found[0] < _JUST_NS

    def _take_velocity(self, thread: _Thread, field: RidgeField) -> None:
        """Where the thread was found twice in a row, the step between tells its velocity."""
        assert thread.follower is not None
        now, curve = field.stamp.capture_ns, thread.follower.model.curve
        if thread.found is not None and self._just_found(thread, field):
            before_ns, before = thread.found
            thread.follower.came_from(before, (now - before_ns) * 1e-9)
        thread.found = now, curve

    def _follower(self, thread: _Thread, curve: Nurbs, field: RidgeField) -> Follower:
        return Follower(curve, field, self._rig.with_row_offset(thread.rows), self._config)

    def _others(self, name: str, field: RidgeField) -> Neighbours:
        """The strands of the threads that are held, but for one."""
        left, right = NOBODY
        for other, thread in self._threads.items():
            if other == name or thread.follower is None or thread.last is None:
                continue
            if thread.last.status is not Status.LOST:
                strands = thread.follower.strands(field.stamp.capture_ns)
                left, right = left.joined(strands[0]), right.joined(strands[1])
        return left, right

    def _find(
        self,
        name: str,
        thread: _Thread,
        field: RidgeField,
        initializations: dict[str, Initialization | InitializationError],
    ) -> ThreadState:
        if thread.attempts <= 0:
            return _not_found(name, field.stamp, ())
        thread.attempts -= 1
        try:
            found = initialize(field, self._rig, thread.seed, self._initialization)
        except InitializationError as error:
            initializations[name] = error
            return _not_found(name, field.stamp, (f"not found: {error.reason}",))
        if thread.toward is not None:
            found = replace(found, curve=directed(found.curve, thread.toward))
        initializations[name] = found
        thread.rows = found.row_offset_px
        thread.is_sure = found.confidence >= _SURE
        thread.seeded_at = _nearest(found.curve, thread.seed, self._rig)
        thread.next_look_ns = field.stamp.capture_ns + _BETWEEN_LOOKS_NS
        thread.follower = self._follower(thread, found.curve, field)
        state = thread.follower.step(field, name, self._others(name, field))
        return replace(state, events=("found", *state.events))


def _nearest(curve: Nurbs, seed: Seed, rig: StereoRig) -> float:
    """Parameter of the curve's point that is nearest to the seed."""
    s: Float64 = np.linspace(0, 1, 400)
    points = evaluate(curve, s)
    places = points if seed.pixel is None else rig.project_raw(points)[0]
    wanted = np.array(seed.point if seed.pixel is None else seed.pixel)
    return float(s[np.argmin(np.linalg.norm(places - wanted, axis=1))])


def _not_found(name: str, stamp: Stamp, events: tuple[str, ...]) -> ThreadState:
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

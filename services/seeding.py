"""Seeds that come in as questions, and what becomes of them."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from services import topics
from services.bus import Bus, Request
from services.messages import Forget, Forgotten, SeedReply
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationError
from suturetrack.tracking import Tracker
from suturetrack.tracking.tracker import FORGOTTEN
from suturetrack.types import InputError, Seed, Stamp, ThreadState

log = logging.getLogger("suturetrack")
_MOST_REASONS = 3
"""Of what lowers the confidence in a thread, in a terminal."""
_LONGEST_WAIT = 10
"""Fields: where the clocks of two machines disagree, a seed does not wait forever."""
_ON_ITS_WAY_NS = 5_000_000


@dataclass
class _Case:
    seed: Seed
    request: Request[Seed, SeedReply] | None
    reason: str = "no field came in which to look for the thread"
    waits: int = 0
    """Fields for which it waits at most until the segmenter has learned from it."""
    learned_ns: int = 0
    """Frames that were released from then on are segmented by what was learned."""


class SeedDesk:
    """Hands seeds to the tracker, and tells whoever asked what was found.

    Args:
        at_once: look in the next field, for lock-step, instead of the first one that was segmented with
            the thread's colour known.
    """

    def __init__(self, bus: Bus, tracker: Tracker, rig: StereoRig, *, at_once: bool = False):
        self._at_once = at_once
        self._bus, self._tracker, self._rig = bus, tracker, rig
        self._requests = bus.requests(topics.SEED)
        self._forgets = bus.requests(topics.FORGET)
        self._cases: dict[str, _Case] = {}

    @property
    def seeds(self) -> dict[str, Seed]:
        """From where threads are looked for now, by thread; in the calibration's unit."""
        return {thread: case.seed for thread, case in self._cases.items() if not case.waits}

    def seed(self, seed: Seed, request: Request[Seed, SeedReply] | None = None) -> None:
        """Has a thread looked for from the next field on; raises InputError outside the image."""
        self._open(seed, request)
        self._tracker.seed(seed)

    def _open(self, seed: Seed, request: Request[Seed, SeedReply] | None) -> _Case:
        self._rig.locate(seed)
        if seed.point is not None:
            self._check_depth(seed.point[2])
        before = self._cases.pop(seed.thread, None)
        if before is not None:
            _answer(before, SeedReply(seed.thread, False, "another seed took its place"))
        case = self._cases[seed.thread] = _Case(seed, request)
        return case

    def _check_depth(self, depth: float) -> None:
        """Raises InputError for what is far out of what the cameras see, as millimetres for metres are."""
        nearest, farthest = self._rig.depths
        if not nearest <= depth <= farthest:
            at, least, most = (d * self._rig.metres_per_unit for d in (depth, nearest, farthest))
            raise InputError(
                f"the seed is {at:.3g} m away, but the cameras see from {least:.3g} to {most:.3g} m; "
                "a point is in metres"
            )

    def resume(self, given: Iterable[Seed], held: Iterable[ThreadState] = ()) -> None:
        """Takes up the threads of a tracker that died, or of another time: from their last states, else
        from their seeds.

        Args:
            given: seeds from the start.
            held: states of this tracker.
        """
        to_units = 1 / self._rig.metres_per_unit
        asked = [scaled(seed, to_units) for seed in self._bus.last(topics.SEEDING)]
        heard = [scaled(state, to_units) for state in self._bus.last(topics.STATE)]
        last = {state.thread: state for state in (*heard, *held)}
        # A seed may have gone with the source that kept it.
        lying = [seed_on(state) for state in last.values() if state.curve is not None]
        # So may the word that a thread was dropped; every other thread has a state in each frame.
        wanted = [seed for seed in given if not last or seed.thread in last]
        for seed in {seed.thread: seed for seed in (*lying, *wanted, *asked)}.values():
            state = last.get(seed.thread)
            if state is not None and FORGOTTEN in state.events:
                continue
            if state is None or state.curve is None:
                self._tracker.seed(seed)
            else:
                self._tracker.resume(seed, state)

    def take_requests(self, stamp: Stamp) -> list[Seed]:
        """Takes the seeds that have come in; those that are looked for from this field on, in metres."""
        while (request := self._requests.get(0)) is not None:
            seed = scaled(request.question, 1 / self._rig.metres_per_unit)
            try:
                case = self._open(seed, request)
            except InputError as error:
                request.answer(SeedReply(seed.thread, False, str(error)))
            else:
                self._bus.publish(topics.SEEDING, request.question)
                case.waits, case.learned_ns = _LONGEST_WAIT, time.time_ns() + _ON_ITS_WAY_NS
        begun = [self._begin(case, stamp) for case in self._cases.values()]
        return [seed for seed in begun if seed is not None]

    def _begin(self, case: _Case, stamp: Stamp) -> Seed | None:
        """The seed, in metres, if its thread is looked for from this field on."""
        if case.request is None or not case.waits:
            return None
        learned = self._at_once or stamp.released_ns >= case.learned_ns
        case.waits = 0 if learned else case.waits - 1
        if case.waits:
            return None
        self._tracker.seed(case.seed)
        return case.request.question

    def take_forgets(self) -> list[Forget]:
        """Drops the threads that somebody wants to be dropped; those that there were."""
        taken = []
        while (request := self._forgets.get(0)) is not None:
            thread = request.question.thread
            case = self._cases.pop(thread, None)
            if case is not None:
                _answer(case, SeedReply(thread, False, "the thread was dropped"))
            known = self._tracker.forget(thread)
            self._bus.publish(topics.DROPPED, request.question)
            request.answer(Forgotten(thread, known))
            if known:
                taken.append(request.question)
        return taken

    def settle(
        self, stamp: Stamp, results: Mapping[str, Initialization | InitializationError]
    ) -> None:
        """Answers the seeds whose thread was found, or has been looked for long enough.

        Raises:
            InputError: a seed that nobody asked for, but that was given at the start, is on no thread.
        """
        for thread, result in results.items():
            case = self._cases.get(thread)
            if case is None or case.waits:
                continue
            if isinstance(result, Initialization):
                _answer(case, self._found(thread, stamp, result))
                if case.request is None:
                    log.info("thread %s: %s", thread, self._outcome(result, _MOST_REASONS))
            else:
                case.reason = result.reason
                if self._tracker.is_sought(thread):
                    continue
                if case.request is None:
                    raise InputError(_failure(case))
                is_kept = self._tracker.is_known(thread)
                if not is_kept:
                    self._tracker.forget(thread)
                    self._bus.publish(topics.DROPPED, Forget(thread))
                _answer(case, self._not_found(thread, stamp, result, is_kept=is_kept))
            del self._cases[thread]

    def close(self) -> None:
        """Tells what has become of the seeds that are still open; raises InputError as `settle`."""
        for thread, case in self._cases.items():
            _answer(case, SeedReply(thread, False, f"the tracker ended; {case.reason}"))
        given = [case for case in self._cases.values() if case.request is None]
        if given:
            raise InputError(_failure(given[0]))

    def _found(self, thread: str, stamp: Stamp, found: Initialization) -> SeedReply:
        curve = scaled(found.curve, self._rig.metres_per_unit)
        return SeedReply(thread, True, self._outcome(found), stamp, curve)

    def _outcome(self, found: Initialization, most: int | None = None) -> str:
        """In words, with so many reasons at most."""
        length_mm = nurbs.length(found.curve) * self._rig.mm_per_unit
        outcome = f"found {length_mm:.1f} mm with confidence {found.confidence:.2f}"
        said = found.reasons[:most]
        unsaid = len(found.reasons) - len(said)
        return "; ".join((outcome, *said, *([f"and {unsaid} more"] if unsaid else [])))

    def _not_found(
        self, thread: str, stamp: Stamp, error: InitializationError, *, is_kept: bool
    ) -> SeedReply:
        raw = self._rig.raw_pixels(error.candidates)
        candidates = tuple((float(u), float(v)) for u, v in raw)
        reason = f"{error.reason}; thread {thread} goes on as before" if is_kept else error.reason
        return SeedReply(thread, False, reason, stamp, candidates=candidates)


def seed_on(state: ThreadState) -> Seed:
    """The middle of what is seen of a thread's curve, or of the whole."""
    assert state.curve is not None
    everywhere = np.linspace(0, 1, len(state.seen))
    shown = everywhere[state.seen] if state.seen.any() else everywhere
    x, y, z = nurbs.evaluate(state.curve, shown[[len(shown) // 2]])[0].tolist()
    return Seed(state.thread, point=(x, y, z))


def _answer(case: _Case, reply: SeedReply) -> None:
    if case.request is not None:
        case.request.answer(reply)


def _failure(case: _Case) -> str:
    return f"seed {case.seed.pixel}: {case.reason}"

"""Holds the threads of one rig."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationConfig, InitializationError
from suturetrack.tracking.clock import StreamClock
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.looks import Look
from suturetrack.tracking.recovery import Setup
from suturetrack.tracking.searches import Closer, FromSeed
from suturetrack.tracking.strands import Neighbour, Neighbours
from suturetrack.tracking.thread import Thread, not_found
from suturetrack.types import RidgeField, Seed, Stamp, ThreadState

FORGOTTEN = "forgotten"
"""Event of the last state of a thread that was dropped."""


@dataclass(frozen=True, eq=False)
class TrackerStep:
    """What one field gave."""

    states: tuple[ThreadState, ...]
    """One for each seeded thread, in the order of the seeds."""
    initializations: dict[str, Initialization | InitializationError] = field(default_factory=dict)
    """By thread: what came of looking for it from its seed."""
    looked_in: dict[str, RidgeField] = field(default_factory=dict)
    """By thread: the field of its initialization, which may be an earlier one."""


class Tracker:
    """Finds seeded threads and follows them from field to field.

    While a thread is held, others are looked for beside the tracking, in a worker thread, one at a
    time. What was begun with one field is taken up with the first that was captured 0.3 s later, so
    that the same fields always give the same states. Fields that nobody may write to are kept for so
    long, others copied.
    """

    def __init__(
        self,
        rig: StereoRig,
        config: TrackingConfig = TrackingConfig(),
        initialization: InitializationConfig = InitializationConfig(),
    ) -> None:
        self._setup = Setup(rig, config, initialization)
        self._threads: dict[str, Thread] = {}
        self._forgotten: list[str] = []
        self._clock = StreamClock()
        self._worker = ThreadPoolExecutor(1, "look")
        self._look: Look | None = None

    def seed(self, seed: Seed) -> None:
        """Looks for the thread from the next field on, for up to `config.patience` fields.

        A thread of the same name is held where it is until it is found there, and keeps its direction.
        """
        self._threads.setdefault(seed.thread, Thread(seed, self._setup)).seek(seed)
        self._drop_look(seed.thread)

    def resume(self, seed: Seed, last: ThreadState) -> None:
        """Takes a thread up where another tracker left it, lost until it is found again.

        Args:
            seed: from where it was looked for at first; names the thread.
            last: its last state, with a curve.

        It keeps the direction of the last curve, and counts as found if it has the same length; after
        some attempts in vain whatever its length is, for the last state may have been a bad one. What was
        not tracked for sure is no surer than before.
        """
        self._threads[seed.thread] = Thread(seed, self._setup, last)
        self._drop_look(seed.thread)

    def forget(self, thread: str) -> bool:
        """Drops the thread; the next step tells so in a last state without a curve.

        Returns whether there was such a thread.
        """
        known = self._threads.pop(thread, None) is not None
        self._drop_look(thread)
        if known:
            self._forgotten.append(thread)
        return known

    def is_known(self, thread: str) -> bool:
        """Whether there is a curve of the thread, held or lost."""
        return thread in self._threads and self._threads[thread].is_known

    def is_sought(self, thread: str) -> bool:
        """Whether the thread has been seeded, not been found there yet, and not been given up."""
        return thread in self._threads and self._threads[thread].is_sought

    def step(self, field: RidgeField) -> TrackerStep:
        """The seeded threads in the next field.

        A field that is not newer than the last one changes nothing: its states are the last ones.
        Dates may jump; time then goes on from where it was.
        """
        is_new = self._clock.advance(field.stamp)
        forgotten = [not_found(name, field.stamp, (FORGOTTEN,)) for name in self._forgotten]
        self._forgotten.clear()
        threads = self._threads.values()
        done: list[Look] = []
        if is_new:
            dated = replace(field, stamp=replace(field.stamp, capture_ns=self._clock.now_ns))
            held = {name for name, thread in self._threads.items() if thread.is_held}
            for thread in threads:
                all_held = not self._threads.keys() - held - {thread.name}
                thread.follow(dated.of(thread.name), self._others(thread, dated.stamp), all_held)
            done = [*self._go_on_looking(dated), *self._begin_to_look(dated, held)]
        states = [thread.state_at(field.stamp, is_new) for thread in threads]
        first = {look.thread: look for look in done if isinstance(look.search, FromSeed)}
        return TrackerStep(
            (*forgotten, *states),
            {name: found for name, look in first.items() if (found := look.outcome().found)},
            {name: look.field for name, look in first.items()},
        )

    def _go_on_looking(self, field: RidgeField) -> Iterator[Look]:
        """Hands the field to the look that is being made; gives it when it is due."""
        look = self._look
        if look is None:
            return
        thread = self._threads[look.thread]
        others = self._others(thread, field.stamp)
        look.add(self._worker, field.of(look.thread), others)
        if field.stamp.capture_ns >= look.due_ns:
            self._look = None
            self._take_up(look, others, field.stamp)
            yield look

    def _begin_to_look(self, field: RidgeField, held: set[str]) -> Iterator[Look]:
        """Looks for threads, those first that have waited longest; gives looks that are over at once.

        Args:
            held: the threads that were held before this field, which must not be held up.
        """
        at_once: list[tuple[float, Thread, Look]] = []
        for thread in sorted(self._threads.values(), key=lambda thread: thread.looked_ns):
            is_beside = bool(held - {thread.name})
            # A look at what is followed holds no recovery up.
            is_urgent = thread.is_astray and not is_beside
            is_free = self._look is None or (is_urgent and isinstance(self._look.search, Closer))
            search = thread.search(field.stamp.capture_ns, is_beside) if is_free else None
            if search is None:
                continue
            own = field.of(thread.name)
            look = Look(search, own)
            if is_beside or (thread.is_held and not search.is_urgent):
                look.add(self._worker, own, self._others(thread, field.stamp))
                self._look = look
            else:
                at_once.append((look.at_once(), thread, look))
        for _, thread, look in sorted(at_once, key=lambda found: -found[0]):
            others = self._others(thread, field.stamp)
            look.follow(others)
            self._take_up(look, others, field.stamp)
            yield look

    def _take_up(self, look: Look, others: Neighbours, stamp: Stamp) -> None:
        """Takes up what a look found; whoever is less sure and runs along it comes to be doubted."""
        if not self._threads[look.thread].take_up(look, others):
            return
        for other in self._threads.values():
            if other.name != look.thread and other.is_held:
                other.doubt_beside(self._others(other, stamp), stamp.capture_ns)

    def _others(self, thread: Thread, stamp: Stamp) -> Neighbours:
        """The strands of the other threads that are held."""
        held = (
            Neighbour(
                *other.follower.strands(stamp.capture_ns),
                other.confidence,
                other.name if other.is_tracked else "",
            )
            for other in self._threads.values()
            if other is not thread and other.follower is not None and other.is_held
        )
        return Neighbours(tuple(held))

    def _drop_look(self, thread: str) -> None:
        if self._look is not None and self._look.thread == thread:
            self._look = None

"""Looks for threads that are made beside the tracking, and brought to the present."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace

from suturetrack.initialization import Initialization
from suturetrack.tracking.pursuit import Pursuit
from suturetrack.tracking.searches import Found, Search
from suturetrack.tracking.strands import Neighbours
from suturetrack.types import Float32, RidgeField, ThreadState, read_only

# By when a look should be over, with other threads to be followed at the same time.
_DELAY_NS = 300_000_000


@dataclass
class Outcome:
    """What came of a look."""

    found: Found = None
    """In the field with which it began."""
    pursuit: Pursuit | None = None
    """Who has followed it through the fields since."""
    state: ThreadState | None = None
    """Of the pursuit, in the last field."""


class Look:
    """Searches one field, and follows what is there through the fields that come in meanwhile.

    It is taken up at a time of the stream and not when it happens to be done: the same fields give the
    same states.

    Args:
        search: what is looked for.
        field: in which it is looked for.
    """

    def __init__(self, search: Search, field: RidgeField) -> None:
        self.search, self.field = search, field
        self.due_ns = field.stamp.capture_ns + _DELAY_NS
        """Capture time from which it is taken up."""
        self.fields = 1
        """With how many fields."""
        self._outcome = Outcome()
        self._tasks: list[Future[None]] = []

    @property
    def thread(self) -> str:
        """The name of the thread."""
        return self.search.seed.thread

    def at_once(self) -> float:
        """Looks while the caller waits; how sure it is of what was found, for `follow` to go on with."""
        found = self._outcome.found = self.search.find(self.field)
        return found.confidence if isinstance(found, Initialization) else 0.0

    def follow(self, others: Neighbours) -> None:
        """Goes on with what was found at once, beside what is held by now."""
        self._go_on(self.field, others)

    def add(self, worker: Executor, field: RidgeField, others: Neighbours) -> None:
        """Hands on the next field, the one of the look first, to a worker that keeps their order."""
        kept = replace(field, left=_frozen(field.left), right=_frozen(field.right))
        if self._tasks:
            self.fields += 1
            self._tasks.append(worker.submit(self._follow, kept, others))
        else:
            self.field = kept
            self._tasks.append(worker.submit(self._begin, kept, others))

    def outcome(self) -> Outcome:
        """What came of it, with the last field that was added; waits until the worker is done."""
        for task in self._tasks:
            task.result()
        return self._outcome

    def _begin(self, field: RidgeField, others: Neighbours) -> None:
        self._outcome.found = self.search.find(field)
        self._go_on(field, others)

    def _go_on(self, field: RidgeField, others: Neighbours) -> None:
        if isinstance(self._outcome.found, Initialization):
            self._outcome.found = self.search.beside(others, self._outcome.found)
        found = self._outcome.found
        if isinstance(found, Initialization):
            self._outcome.pursuit = self.search.pursue(found, field)
            self._follow(field, others)

    def _follow(self, field: RidgeField, others: Neighbours) -> None:
        if self._outcome.pursuit is not None:
            self._outcome.state = self._outcome.pursuit.step(field, others)


def _frozen(view: Float32) -> Float32:
    """The view, copied unless nobody may write to it."""
    return read_only(view.copy()) if view.flags.writeable else view

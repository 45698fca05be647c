"""What the tracker holds shows the segmenter how the threads move and, once a second, how they look by now.

Where all of them are lost they may have faded: they are looked for as if they stood out less and less. One
whose seed taught nothing, such as in the first, dark pictures of a camera, is learned where it is seen.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from services.seeding import seed_on
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.segmentation import Segmenter
from suturetrack.tracking.thread import FOUND, GIVEN_UP
from suturetrack.types import InputError, Stamp, Status, StereoFrame, ThreadState

_PERIOD_NS = 1_000_000_000
"""Of capture time, so that a recording adapts as the live run did."""
_SOON_NS = 250_000_000
"""And the first period while there is a seeded thread of which nothing was learned yet."""
_SEEN = 0.9
"""Share of a curve that has to be seen for its thread to be learned."""
_ALONG = np.linspace(0, 1, 64)
_LONGEST_WAIT_S = 2.0
"""Lock-step: for states that are on their way."""


class Adaptation:
    """Keeps a frame until its states are sure to be there, then has the segmenter learn from both.

    Args:
        states: the next state of the rig, in metres, waiting so many seconds for it; None if none comes.
        lockstep: wait for states, so that the same frames always give the same fields.
    """

    def __init__(
        self,
        segmenter: Segmenter,
        rig: StereoRig,
        states: Callable[[float], ThreadState | None],
        *,
        lockstep: bool,
    ):
        self._segmenter, self._rig, self._next_state = segmenter, rig, states
        self._patience = _LONGEST_WAIT_S if lockstep else 0.0
        self._pause_ns = _SOON_NS
        """Until the next look at threads of which nothing was learned yet."""
        self._sample: StereoFrame | None = None
        self._awaited: set[str] = set()
        self._arrived: list[ThreadState] = []
        self._latest: dict[str, Stamp] = {}
        """Of the last state of each thread."""
        self._segmented: list[Stamp] = []
        """The last two frames."""

    def catch_up(self) -> None:
        """To be called before a frame is segmented: takes in the states that have come and, in lock-step,
        those of the last frame that are still to come."""
        self._take_in_all()
        reported = {t for t in self._segmenter.threads if self._latest.get(t) in self._segmented}
        self._wait_while(lambda: any(self._latest[t] != self._segmented[-1] for t in reported))

    def step(self, frame: StereoFrame) -> None:
        """To be called once for every frame that was segmented, after its field was published."""
        self._take_in_all()
        self._segmented = [*self._segmented[-1:], frame.stamp]
        sample = self._sample
        period = self._pause_ns if self._segmenter.unlearned else _PERIOD_NS
        age = period if sample is None else frame.stamp.capture_ns - sample.stamp.capture_ns
        if 0 <= age < period:
            return
        if sample is not None and age > 0:
            self._learn(sample)
        self._sample = frame
        self._awaited = {*self._segmenter.threads, *self._segmenter.unlearned}
        self._arrived = list(self._of(frame).values())

    def _learn(self, sample: StereoFrame) -> None:
        self._wait_while(lambda: bool(self._awaited - self._of(sample).keys()))
        states = self._of(sample)
        all_lost = all(state.status is Status.LOST for state in states.values())
        for thread, message in sorted(states.items()):
            state = scaled(message, 1 / self._rig.metres_per_unit)
            if state.curve is None:
                continue
            if thread in self._segmenter.unlearned:
                if state.status is not Status.LOST and np.mean(state.seen) > _SEEN:
                    self._learn_first(sample, state)
            elif state.status is Status.TRACKING:
                shown = np.linspace(0, 1, len(state.seen))[state.seen]
                pixels = self._rig.project_raw(nurbs.evaluate(state.curve, shown))[0]
                self._segmenter.adapt(sample, pixels, thread)
            elif all_lost:
                self._segmenter.fade(thread)

    def _wait_while(self, lacks: Callable[[], bool]) -> None:
        """In lock-step: takes in states for as long as some lack, and come."""
        while (
            self._patience and lacks() and (state := self._next_state(self._patience)) is not None
        ):
            self._take_in(state)

    def _take_in_all(self) -> None:
        while (state := self._next_state(0)) is not None:
            self._take_in(state)

    def _take_in(self, state: ThreadState) -> None:
        self._arrived.append(state)
        self._latest[state.thread] = state.stamp
        if FOUND in state.events or GIVEN_UP in state.events:
            self._segmenter.settle(state.thread, is_found=FOUND in state.events)
        follow(self._segmenter, scaled(state, 1 / self._rig.metres_per_unit))

    def _learn_first(self, sample: StereoFrame, state: ThreadState) -> None:
        """Learns a thread at last; what teaches nothing is tried less and less often, for it takes long."""
        # Who says that a curve is seen may be wrong: it may lie outside the picture.
        with suppress(InputError):
            self._segmenter.learn(sample, seed_on(state))
        in_vain = state.thread in self._segmenter.unlearned
        self._pause_ns = min(2 * self._pause_ns, _PERIOD_NS) if in_vain else _SOON_NS

    def _of(self, frame: StereoFrame) -> dict[str, ThreadState]:
        return {state.thread: state for state in self._arrived if state.stamp == frame.stamp}


def follow(segmenter: Segmenter, state: ThreadState) -> None:
    """Tells the segmenter where a thread that is held was; lengths in the calibration's unit."""
    if state.curve is not None and state.status is not Status.LOST:
        points = nurbs.evaluate(state.curve, _ALONG)
        segmenter.follow(state.stamp.capture_ns, points, state.thread)

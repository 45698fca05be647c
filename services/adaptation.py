"""What the tracker holds shows the segmenter, once a second, how the threads look by now.

Where all of them are lost they may have faded: they are looked for as if they stood out less and less.
"""

from __future__ import annotations

import numpy as np

from services.bus import Reader
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.segmentation import Segmenter
from suturetrack.types import Status, StereoFrame, ThreadState

_PERIOD_NS = 1_000_000_000
"""Of capture time, so that a recording adapts as the live run did."""
_LONGEST_WAIT_S = 2.0
"""Lock-step: for states that are on their way."""


class Adaptation:
    """Keeps a frame until its states are sure to be there, then has the segmenter learn from both.

    Args:
        states: every state of the rig, in metres.
        lockstep: wait for states, so that the same frames always give the same fields.
    """

    def __init__(
        self, segmenter: Segmenter, rig: StereoRig, states: Reader[ThreadState], *, lockstep: bool
    ):
        self._segmenter, self._rig, self._states = segmenter, rig, states
        self._patience = _LONGEST_WAIT_S if lockstep else 0.0
        self._sample: StereoFrame | None = None
        self._awaited: set[str] = set()
        self._arrived: list[ThreadState] = []

    def step(self, frame: StereoFrame) -> None:
        """To be called once for every frame that was segmented, after its field was published."""
        while (state := self._states.get(0)) is not None:
            self._arrived.append(state)
        sample = self._sample
        age = _PERIOD_NS if sample is None else frame.stamp.capture_ns - sample.stamp.capture_ns
        if 0 <= age < _PERIOD_NS:
            return
        if sample is not None and age > 0:
            self._learn(sample)
        self._sample = frame
        self._awaited = set(self._segmenter.threads)
        self._arrived = list(self._of(frame).values())

    def _learn(self, sample: StereoFrame) -> None:
        while self._patience and self._awaited - self._of(sample).keys():
            state = self._states.get(self._patience)
            if state is None:
                break
            self._arrived.append(state)
        states = self._of(sample)
        all_lost = all(state.status is Status.LOST for state in states.values())
        for thread, message in sorted(states.items()):
            state = scaled(message, 1 / self._rig.metres_per_unit)
            if state.status is Status.TRACKING and state.curve is not None:
                shown = np.linspace(0, 1, len(state.seen))[state.seen]
                pixels = self._rig.project_raw(nurbs.evaluate(state.curve, shown))[0]
                self._segmenter.adapt(sample, pixels, thread)
            elif all_lost and state.curve is not None:
                self._segmenter.fade(thread)

    def _of(self, frame: StereoFrame) -> dict[str, ThreadState]:
        return {state.thread: state for state in self._arrived if state.stamp == frame.stamp}

"""Where grasp queries come in, and what is answered."""

from __future__ import annotations

import time
from collections.abc import Iterable

from services import topics
from services.bus import Bus
from services.freshness import Freshness
from services.messages import GraspReply, GraspRequest
from services.wire import scaled
from suturetrack.camera import StereoRig
from suturetrack.grasping import grasp
from suturetrack.types import InputError, ThreadState


class GraspDesk:
    """Tells where to take a thread from the newest states, beside the tracker's own loop.

    So a request is answered at once, and refused when the loop gets no fields any more.
    """

    def __init__(self, bus: Bus, rig: StereoRig):
        self._metres = rig.metres_per_unit
        self._states: dict[str, ThreadState] = {}
        self._updated_ns = 0
        bus.answer(topics.GRASP, self.reply)

    def update(self, states: Iterable[ThreadState]) -> None:
        """Takes the states of all threads at the newest frame; lengths in the calibration's unit."""
        self._states, self._updated_ns = {s.thread: s for s in states}, time.monotonic_ns()

    def reply(self, request: GraspRequest) -> GraspReply:
        """A pose, or why there is none; both in metres."""
        state = self._states.get(request.thread)
        if state is None:
            return GraspReply(request.thread, None, self._unknown(request.thread))
        stale = Freshness.of(state.stamp, self._updated_ns).reason
        if stale:
            return GraspReply(request.thread, None, f"the state is stale: {stale}")
        try:
            where = scaled(request, 1 / self._metres).where
            pose = grasp(state, where, request.approach)
        except InputError as error:
            return GraspReply(request.thread, None, str(error))
        return GraspReply(request.thread, scaled(pose, self._metres))

    def _unknown(self, thread: str) -> str:
        there = ", ".join(self._states)
        return f"no thread {thread!r}; there is {there}" if there else "no thread; seed one first"

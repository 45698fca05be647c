"""What a running system sees and decides, to the Rerun viewer or to a recording while it goes on.

A process of its own that only listens: a slow viewer costs the pictures that it misses, never the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Self

import rerun as rr

from services import topics
from services.bus import Bus
from services.recording import Recorder
from services.wire import scaled
from services.writer import Writer
from suturetrack.camera import StereoRig

_WAIT_S = 0.02


class LiveView:
    """Writes what is published on a rig, in the name of those who publish it.

    Args:
        bus: of a process that only listens.
        rig: the calibrated cameras.
        writers: one for what each of `topics.PROCESSES` publishes, in this order.
    """

    def __init__(self, bus: Bus, rig: StereoRig, writers: Sequence[Writer | Recorder]) -> None:
        self._rig = rig
        self._source, self._segmenter, self._tracker = writers
        self._frames = bus.newest(topics.FRAME, at_leisure=True)
        self._fields = bus.newest(topics.FIELD, at_leisure=True)
        self._states = bus.every(topics.STATE)
        self._truths = bus.every(topics.TRUTH)
        self._healths = bus.every(topics.HEALTH)

    @classmethod
    def on(cls, bus: Bus, rig: StereoRig, stream: rr.RecordingStream) -> Self:
        """Writes to one stream."""
        writers = [Writer(stream, process, "light", rig) for process in topics.PROCESSES]
        for writer in writers:
            writer.describe()
        stream.send_blueprint(writers[-1].layout())
        return cls(bus, rig, writers)

    def step(self) -> None:
        """Shows what has arrived, after waiting a little for a frame."""
        frame = self._frames.get(_WAIT_S)
        if frame is not None:
            self._source.frame(frame)
        field = self._fields.get(0)
        if field is not None:
            self._segmenter.field(field)
        while (truth := self._truths.get(0)) is not None:
            self._source.truth(scaled(truth, 1 / self._rig.metres_per_unit))
        arrived = iter(lambda: self._states.get(0), None)
        for _, of_frame in groupby(arrived, key=lambda state: state.stamp):
            self._tracker.states([scaled(s, 1 / self._rig.metres_per_unit) for s in of_frame])
        while (health := self._healths.get(0)) is not None:
            self._tracker.health(health)

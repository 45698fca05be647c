"""The process that turns stereo frames into ridge vector fields."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import tyro

from services import topics
from services.adaptation import Adaptation
from services.bus import Bus
from services.seeding import seed_on
from services.service import Service, ServiceConfig, Stopped, compiling
from services.wire import scaled
from suturetrack.camera import StereoRig
from suturetrack.segmentation import SegmentationConfig, Segmenter
from suturetrack.types import (
    InputError,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
)

_KEPT_FRAMES = 12
"""Frames that were segmented since a slow tracker was given the one whose states come next."""
_SEEN = 0.5
"""Share of a curve that must be seen to tell the thread's colour."""


@dataclass(frozen=True)
class SegmenterConfig:
    """Turns stereo frames into ridge vector fields."""

    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)
    seed: tuple[tuple[float, float], ...] = ()
    """U V of a pixel on the thread in the raw left image of the first frame, to learn its colour;
    another pair for every further thread."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)


def run(service: Service, config: SegmenterConfig) -> None:
    """Segments the newest frame, again and again; frames of another rig are refused."""
    bus = service.bus
    rig = service.calibrated_rig()
    segmenter = Segmenter(rig, config.segmentation)

    def learn(seed: Seed, frame: StereoFrame) -> None:
        """A seed that cannot be costs no frame."""
        try:
            segmenter.learn(frame, seed)
        except InputError as error:
            service.complain(f"thread {seed.thread}: nothing is learned of it: {error}")

    with compiling():
        segmenter.warm_up()
        example = warm_up(rig, config)
    bus.make_room(example)
    recorder = service.record(rig, config)
    seedings, drops = bus.every(topics.SEEDING), bus.every(topics.DROPPED)
    states = bus.every(topics.STATE)
    adaptation = Adaptation(segmenter, rig, states.get, lockstep=config.service.lockstep)
    given = [Seed(str(i), pixel=pixel) for i, pixel in enumerate(config.seed)]
    held = _Held(bus, rig) if config.service.resume else None
    if held is not None:
        given = [seed for seed in given if seed.thread not in held.threads]
    bus.keep(topics.STEP)
    with service.waiting("tracker"):
        if not bus.wait_for_alive("tracker"):
            raise Stopped
    frames = bus.newest(topics.FRAME)
    service.ready()
    for frame in frames:
        try:
            segmenter.check(frame)
        except InputError as error:
            frames.refuse(str(error))
            continue
        while given:
            learn(given.pop(0), frame)
        for place, shown in held.seeds(frame) if held is not None else ():
            learn(place, shown)
        while (drop := drops.get(0)) is not None:
            segmenter.forget(drop.thread)
            recorder.request(frame.stamp, drop)
        while (seed := seedings.get(0)) is not None:
            segmenter.remember(seed.thread)
            learn(scaled(seed, 1 / rig.metres_per_unit), frame)
            recorder.request(frame.stamp, seed)
        adaptation.catch_up()
        ridges = segmenter.step(frame)
        bus.publish(topics.FIELD, ridges)
        recorder.field(ridges, service.finished(frame.stamp))
        adaptation.step(frame)


class _Held:
    """The threads that the tracker holds, from which a segmenter that is started again learns."""

    def __init__(self, bus: Bus, rig: StereoRig):
        self._states = bus.every(topics.STATE)
        self._rig = rig
        self._recent: deque[StereoFrame] = deque(maxlen=_KEPT_FRAMES)
        self.threads = {s.thread for s in bus.last(topics.STATE) if s.curve is not None}
        """Names of those of which nothing was learned yet."""

    def seeds(self, frame: StereoFrame) -> Iterator[tuple[Seed, StereoFrame]]:
        """A place on every further thread that was seen, and the frame in which it was.

        Without its colour the tracker may hold a thread and yet not be sure of it.

        Args:
            frame: the next one, kept for the states that are still to come.
        """
        while (state := self._states.get(0)) is not None:
            is_seen = state.status is not Status.LOST and np.mean(state.seen) > _SEEN
            shown = next((f for f in self._recent if f.stamp == state.stamp), None)
            if shown is not None and is_seen and state.thread in self.threads:
                self.threads.remove(state.thread)
                yield seed_on(scaled(state, 1 / self._rig.metres_per_unit)), shown
        if self.threads:
            self._recent.append(frame)
        else:
            self._recent.clear()


def warm_up(rig: StereoRig, config: SegmenterConfig) -> RidgeField:
    """Learns from and segments noise, so that the first frame is not late."""
    width, height = rig.image_size
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    frame = StereoFrame(Stamp(0, 0, 0), noise, noise)
    segmenter = Segmenter(rig, config.segmentation)
    segmenter.learn(frame, Seed(pixel=(width / 2, height / 2)))
    return segmenter.step(frame)

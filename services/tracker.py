"""The process that holds the threads: fields in, states out, seeds answered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from services import topics
from services.seeding import SeedDesk
from services.service import Service, ServiceConfig, Stopped
from services.wire import scaled
from suturetrack.initialization import InitializationConfig
from suturetrack.tracking import Tracker, TrackingConfig
from suturetrack.types import Seed


@dataclass(frozen=True)
class TrackerConfig:
    """Finds the seeded threads and holds a curve on each."""

    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)
    seed: tuple[tuple[float, float], ...] = ()
    """U V of a pixel on the thread in the raw left image of the first frame; another pair for every
    further thread. They are named 0, 1, ..."""
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)


def run(service: Service, config: TrackerConfig) -> None:
    """Tracks on the newest field, again and again; raises InputError for a seed on no thread."""
    bus = service.bus
    rig = service.calibrated_rig()
    tracker = Tracker(rig, config.tracking, config.initialization)
    desk = SeedDesk(bus, tracker, rig, config.tracking.patience)
    for i, pixel in enumerate(config.seed):
        desk.seed(Seed(str(i), pixel=pixel))
    recorder = service.record(rig, config)
    if config.service.lockstep and not bus.wait_for_readers(topics.STEP):
        raise Stopped
    fields = bus.newest(topics.FIELD)
    service.ready()
    for ridges in fields:
        desk.take_requests()
        step = tracker.step(ridges)
        for state in step.states:
            bus.publish(topics.STATE, scaled(state, rig.metres_per_unit))
        bus.publish(topics.STEP, ridges.stamp)
        published_ns = service.finished(ridges.stamp)
        recorder.states(step.states, published_ns)
        for thread, result in step.initializations.items():
            recorder.initialization(ridges.stamp, thread, result)
        desk.settle(ridges.stamp, step.initializations)

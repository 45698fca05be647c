"""The process that holds the threads: fields in, states out, seeds answered."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated

import cv2
import numpy as np
import tyro

from services import topics
from services.gate import Gate
from services.grasping import GraspDesk
from services.seeding import SeedDesk
from services.service import Service, ServiceConfig, Stopped, compiling
from services.wire import scaled
from suturetrack.camera import StereoRig
from suturetrack.initialization import Initialization, InitializationConfig, InitializationError
from suturetrack.segmentation import joined
from suturetrack.tracking import Tracker, TrackerStep, TrackingConfig
from suturetrack.types import RidgeField, Seed, Stamp, ThreadState, read_only

# A look in the worker thread must give way to the threads that are held at once.
_SWITCH_INTERVAL_S = 5e-4


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
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    bus = service.bus
    rig = service.calibrated_rig()
    tracker = Tracker(rig, config.tracking, config.initialization)
    desk = SeedDesk(bus, tracker, rig, at_once=config.service.lockstep)
    grasps = GraspDesk(bus, rig)
    with compiling():
        warm_up(rig, config)
    given = [Seed(str(i), pixel=pixel) for i, pixel in enumerate(config.seed)]
    if config.service.resume:
        desk.resume(given)
    else:
        for seed in given:
            desk.seed(seed)
    recorder = service.record(rig, config)
    if config.service.lockstep:
        with service.waiting("source"):
            if not bus.wait_for_readers(topics.STEP):
                raise Stopped
    fields = bus.newest(topics.FIELD)
    service.ready()
    gate = Gate(rig, ordered=not config.service.lockstep)
    states: tuple[ThreadState, ...] = ()
    for ridges in fields:
        refusal = gate.refusal(ridges, time.monotonic_ns())
        if refusal:
            fields.refuse(refusal)
            continue
        if gate.began_anew:
            desk.resume(given, states)
        for seed in desk.take_requests(ridges.stamp):
            recorder.request(ridges.stamp, seed)
        for forget in desk.take_forgets():
            recorder.request(ridges.stamp, forget)
        step = tracker.step(ridges)
        states = step.states
        for state in states:
            bus.publish(topics.STATE, scaled(state, rig.metres_per_unit))
        grasps.update(states)
        published_ns = service.finished(ridges.stamp)
        for looked_in, found in _by_field(step):
            recorder.initializations(looked_in, desk.seeds, found)
        if states:
            recorder.states(states, published_ns)
        else:
            recorder.passed(ridges.stamp, published_ns)
        for looked_in, found in _by_field(step):
            desk.settle(looked_in.stamp, found)
        # The last word: in lock-step, all that was said of this frame is there before the next one.
        bus.publish(topics.STEP, ridges.stamp)
    desk.close()


def _by_field(
    step: TrackerStep,
) -> Iterator[tuple[RidgeField, dict[str, Initialization | InitializationError]]]:
    """What came of looking for threads, by the field in which they were looked for."""
    for looked_in in dict.fromkeys(step.looked_in.values()):
        names = [name for name, other in step.looked_in.items() if other is looked_in]
        yield looked_in, {name: step.initializations[name] for name in names}


def warm_up(rig: StereoRig, config: TrackerConfig) -> None:
    """Compiles (or loads) the kernels on a drawn thread, so that the first frame is not late."""
    width, height = rig.image_size
    z = rig.focal * rig.baseline / (0.1 * width)
    x = np.linspace(-0.25, 0.25, 200) * width * z / rig.focal
    y = 0.1 * height * z / rig.focal * np.sin(np.linspace(0, 5, 200))
    thread = np.column_stack([x, y, np.full(200, z)])
    views = []
    for pixels in rig.project(thread):
        view = np.zeros((height, width, 2), np.float32)
        for start, end in itertools.pairwise(pixels):
            direction = (end - start) / np.linalg.norm(end - start)
            first, last = np.rint([start, end]).astype(int).tolist()
            cv2.line(view, first, last, direction.tolist(), 3)
        view = cv2.GaussianBlur(view, (0, 0), 1.5)
        view /= 1.001 * np.abs(view).max() + 1e-6
        views.append(read_only(view))
    tracker = Tracker(rig, config.tracking, config.initialization)
    u, v = rig.project_raw(thread[100])[0]
    tracker.seed(Seed(pixel=(float(u), float(v))))
    for frame in range(3):
        tracker.step(RidgeField(Stamp(frame, frame * 33_333_333, 0), views[0], views[1]))
    nothing = read_only(np.zeros_like(views[0]))
    tracker.step(joined(Stamp(3, 100_000_000, 0), dict.fromkeys("01", (nothing, nothing))))

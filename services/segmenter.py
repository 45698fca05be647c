"""The process that turns stereo frames into ridge vector fields."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import tyro

from services import topics
from services.service import Service, ServiceConfig, Stopped
from services.wire import scaled
from suturetrack.camera import StereoRig
from suturetrack.segmentation import SegmentationConfig, Segmenter
from suturetrack.types import InputError, RidgeField, Seed, Stamp, StereoFrame


@dataclass(frozen=True)
class SegmenterConfig:
    """Turns stereo frames into ridge vector fields."""

    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)
    seed: tuple[tuple[float, float], ...] = ()
    """U V of a pixel on the thread in the raw left image of the first frame, to learn its colour;
    another pair for every further thread."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)


def run(service: Service, config: SegmenterConfig) -> None:
    """Segments the newest frame, again and again; raises InputError for frames of another rig."""
    bus = service.bus
    rig = service.calibrated_rig()
    segmenter = Segmenter(rig, config.segmentation)
    segmenter.warm_up()
    bus.make_room(_warm_up(rig, config))
    recorder = service.record(rig, config)
    seedings = bus.every(topics.SEEDING)
    seeds = [Seed(str(i), pixel=pixel) for i, pixel in enumerate(config.seed)]
    if not bus.wait_for_alive("tracker"):
        raise Stopped
    frames = bus.newest(topics.FRAME)
    service.ready()
    for frame in frames:
        while (seeding := seedings.get(0)) is not None:
            seeds.append(scaled(seeding, 1 / rig.metres_per_unit))
        try:
            while seeds:
                segmenter.learn(frame, seeds.pop(0))
            ridges = segmenter.step(frame)
        except InputError as error:
            frames.refuse(str(error))
            continue
        bus.publish(topics.FIELD, ridges)
        recorder.field(ridges, service.finished(frame.stamp))


def _warm_up(rig: StereoRig, config: SegmenterConfig) -> RidgeField:
    """Learns from and segments noise, so that the first frame is not late."""
    width, height = rig.image_size
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    frame = StereoFrame(Stamp(0, 0, 0), noise, noise)
    segmenter = Segmenter(rig, config.segmentation)
    segmenter.learn(frame, Seed(pixel=(width / 2, height / 2)))
    return segmenter.step(frame)

"""Another publisher in the place of our source: it answers for the calibration and sends frames."""

from __future__ import annotations

import time

from services import segmenter, topics, tracker
from services.segmenter import SegmenterConfig
from services.service import ServiceConfig
from services.tracker import TrackerConfig
from suturetrack.stage import open_scene
from suturetrack.types import Stamp, Status, StereoFrame
from tests.conftest import wait_until
from tests.test_tiny import Rig


def test_frames_of_another_publisher_are_tracked() -> None:
    scene = open_scene("figure8-107")
    rig = Rig()
    camera = rig.connect("my-own-grabber")
    states = camera.every(topics.STATE)
    camera.answer(topics.CALIBRATION, lambda _: scene.rig)
    shared = ServiceConfig()
    rig.start("segmenter", segmenter, SegmenterConfig(shared, seed=(scene.seed_pixel(0),)))
    rig.start("tracker", tracker, TrackerConfig(shared, seed=(scene.seed_pixel(0),)))
    wait_until(lambda: rig.errors or camera.alive() >= {"segmenter", "tracker"}, 60)
    assert not rig.errors
    for i in range(3):
        now = time.time_ns()
        camera.publish(topics.FRAME, StereoFrame(Stamp(i, now, now), *scene.render(i)))
        state = states.get(20)
        assert state is not None
        assert state.stamp.frame == i
        assert state.status is Status.TRACKING
    rig.stop()
    assert not rig.errors

"""The live view shows what is published, in the calibration's unit, also when it is started late."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from services import topics, view
from services.bus import Bus
from services.live import LiveView
from services.memory_transport import Hub
from services.run_folder import RunFolder
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import (
    Energies,
    Nurbs,
    RidgeField,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)


def publish_frame(bus: Bus, i: int, curve: Nurbs, rig: StereoRig) -> None:
    """What the processes of a rig with two threads publish for one frame."""
    stamp, image = Stamp(i, i, 10**18), np.full((480, 640, 3), 100, np.uint8)
    bus.publish(topics.FRAME, StereoFrame(stamp, image, image))
    field = np.zeros((480, 640, 2), np.float32)
    bus.publish(topics.FIELD, RidgeField(stamp, field, field))
    truth = Truth(stamp, "a", nurbs.evaluate(curve, np.linspace(0, 1, 9)), 200.0, np.ones(9, bool))
    bus.publish(topics.TRUTH, scaled(truth, rig.metres_per_unit))
    for name in ("a", "b"):
        state = ThreadState(
            *(stamp, name, Status.TRACKING, curve, 200.0, Energies(-0.9, -0.8, -1, 2)),
            *(np.full(9, 0.1), np.ones(9, bool)),
        )
        bus.publish(topics.STATE, scaled(state, rig.metres_per_unit))


def test_what_is_published_is_shown(tmp_path: Path, rig: StereoRig, curve: Nurbs) -> None:
    hub = Hub()
    speaker, listener = (Bus(hub.connect(), "rig", name) for name in ("tracker", "view"))
    publish_frame(speaker, 0, curve, rig)  # too early for the view
    stream = rr.RecordingStream("suturetrack", recording_id="live")
    stream.set_sinks(rr.FileSink(str(tmp_path / "live.rrd")))
    live = LiveView.on(listener, rig, stream)
    for i in (1, 2):
        publish_frame(speaker, i, curve, rig)
        live.step()
    stream.disconnect()
    listener.close()
    speaker.close()

    folder = RunFolder(tmp_path)
    states = folder.states()
    assert [(s.state.stamp.frame, s.state.thread) for s in states] == [
        *((1, "a"), (1, "b"), (2, "a"), (2, "b"))
    ]
    assert states[0].state.length == 200.0
    shown = states[-1].state.curve
    assert shown is not None
    assert np.allclose(shown.control_points, curve.control_points, rtol=1e-12)
    assert len(folder.truths()) == 2
    assert np.allclose(folder.truths()[0].points[0], curve.control_points[0], atol=1e-4)
    assert set(folder.images({1, 2})) == {(i, v) for i in (1, 2) for v in ("left", "right")}
    overlays = [r for r in folder.rows("/rig/left/image/curve") if "frame" in r]
    assert [len(r["LineStrips2D:strips"]) for r in overlays] == [2, 2]
    assert [r for r in folder.rows("/rig/left/image/direction") if "frame" in r]


class Window:
    """A viewer that is closed after some looks at whether it is."""

    def __init__(self, looks: int):
        self.looks = looks

    def poll(self) -> int | None:
        self.looks -= 1
        return None if self.looks >= 0 else 0

    def terminate(self) -> None: ...

    def wait(self) -> None: ...


def test_a_view_of_no_rig_waits_for_one_without_haste(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus(Hub().connect(), "rig", "view")
    monkeypatch.setattr(view.subprocess, "Popen", lambda *_, **__: Window(10))
    began = time.monotonic()
    view._follow(bus, web=True)
    assert time.monotonic() - began > 0.5
    bus.close()

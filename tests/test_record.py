"""A running system is recorded from outside, for as long as one likes."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from services import record, topics
from services.bus import Bus
from services.memory_transport import Hub
from services.record import RecordConfig
from services.run_folder import RunFolder
from services.service import Service, ServiceConfig
from suturetrack.calibration import load_calibration
from suturetrack.camera import StereoRig
from suturetrack.types import InputError, Nurbs
from tests.test_live import publish_frame


@pytest.fixture
def system(tmp_path: Path, rig: StereoRig) -> Iterator[tuple[Bus, Service]]:
    """Who speaks, and who records it to `run`."""
    hub, config = Hub(), ServiceConfig(run_dir=tmp_path / "run")
    speaker = Bus(hub.connect(), "rig", "tracker")
    speaker.answer(topics.CALIBRATION, lambda _: rig)
    service = Service("record", config, Bus(hub.connect(), "rig", "record"))
    yield speaker, service
    service.bus.close()
    speaker.close()


def test_what_is_published_meanwhile_is_recorded(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, system: tuple[Bus, Service]
) -> None:
    folder, (speaker, service) = tmp_path / "run", system
    config = RecordConfig(service.config)
    recording = threading.Thread(target=record.run, args=(service, config), daemon=True)
    recording.start()
    assert speaker.wait_for_alive("record", 30)
    for i in range(3):
        publish_frame(speaker, i, curve, rig)
        time.sleep(0.05)
    service.bus.stop.set()
    recording.join(30)
    assert not recording.is_alive()

    found = RunFolder(folder)
    assert not found.problems
    frames = [(s.state.stamp.frame, s.state.thread) for s in found.states()]
    assert {"a", "b"} == {thread for _, thread in frames}
    assert found.images({frame for frame, _ in frames})
    assert load_calibration(folder / "calibration.yaml").image_size == rig.image_size


def test_a_recording_that_cannot_go_on_ends_with_the_reason(
    tmp_path: Path, rig: StereoRig, curve: Nurbs, system: tuple[Bus, Service]
) -> None:
    speaker, service = system
    with ThreadPoolExecutor(1) as pool:
        recording = pool.submit(record.run, service, RecordConfig(service.config))
        assert speaker.wait_for_alive("record", 30)
        publish_frame(speaker, 0, curve, rig)
        shutil.rmtree(tmp_path / "run")
        try:
            with pytest.raises(InputError, match="recording stopped: the file or its folder was"):
                recording.result(30)
        finally:
            service.bus.stop.set()


def test_a_folder_that_holds_a_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "source.rrd").touch()
    config = RecordConfig(ServiceConfig(run_dir=tmp_path))
    service = Service("record", config.service, Bus(Hub().connect(), "rig", "record"))
    with pytest.raises(InputError, match="holds a run already"):
        record.run(service, config)
    service.bus.close()

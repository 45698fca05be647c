"""systemd hears of a process as long as it moves, and only then."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from services import console, record, tooltip, topics
from services.bus import Bus
from services.memory_transport import Hub
from services.messages import Health
from services.service import Service, ServiceConfig
from services.watchdog import Watchdog
from suturetrack.camera import StereoRig
from suturetrack.types import Nurbs
from tests.test_live import publish_frame
from tests.test_pulse import beat, unready

SAID = b"READY=1\nWATCHDOG=1"


class Systemd:
    """The socket that systemd would listen on."""

    def __init__(self, path: Path):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))

    def is_told(self, watchdog: Watchdog, health: Health, *, work_waits: bool = True) -> bool:
        """Whether a heartbeat feeds the watchdog."""
        watchdog.feed(health, work_waits=work_waits)
        self.socket.setblocking(False)
        try:
            return self.socket.recv(100) == SAID
        except BlockingIOError:
            return False


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    listening = Systemd(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with listening.socket:
        yield listening


def test_a_process_that_finishes_frames_or_has_nothing_to_do_is_fed_for(systemd: Systemd) -> None:
    dog = Watchdog()
    for second in range(30):
        assert systemd.is_told(dog, beat("tracker", 30 * second + 1))
    for _ in range(30):
        assert systemd.is_told(dog, beat("tracker", 900), work_waits=False)
    for _ in range(30):
        assert systemd.is_told(dog, beat("source", 900, awaits="camera"))


def test_a_process_that_finishes_nothing_while_frames_wait_is_not(systemd: Systemd) -> None:
    dog = Watchdog()
    stuck = replace(beat("tracker", 900), warning="recording stopped: the disk is full")
    told = [systemd.is_told(dog, stuck) for _ in range(30)]
    assert told == 11 * [True] + 19 * [False]
    assert systemd.is_told(dog, beat("tracker", 901))


def test_a_slow_rate_is_no_hang(systemd: Systemd) -> None:
    dog = Watchdog()
    for second in range(60):
        health = beat("tracker", 1 + second // 20, period_ns=20_000_000_000)
        assert systemd.is_told(dog, health)


def test_a_beginning_may_take_longer_but_not_for_ever(systemd: Systemd) -> None:
    dog = Watchdog()
    for _ in range(300):
        assert systemd.is_told(dog, unready("tracker", awaits="source"))
    told = [systemd.is_told(dog, unready("tracker")) for _ in range(300)]
    assert told == 180 * [True] + 120 * [False]


def run_console(service: Service, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(console, "run_service", lambda _name, _config, body: body(service))
        patch.setattr("os.nice", lambda _: None)
        console.run(console.ConsoleConfig(port=0))


def run_record(service: Service, folder: Path) -> None:
    record.run(service, record.RecordConfig(replace(service.config, run_dir=folder / "run")))


def run_tooltip(service: Service, folder: Path) -> None:
    hand_eye = folder / "hand_eye.yaml"
    hand_eye.write_text(yaml.safe_dump({"camera_from_base": np.eye(4).tolist()}))
    tooltip.run(service, tooltip.TooltipConfig(hand_eye))


@pytest.mark.parametrize("run", [run_console, run_record, run_tooltip])
def test_who_reads_at_leisure_is_ready_and_fed_for_though_frames_wait(
    run: Callable[[Service, Path], None],
    systemd: Systemd,
    tmp_path: Path,
    rig: StereoRig,
    curve: Nurbs,
) -> None:
    hub, name = Hub(), run.__name__.removeprefix("run_")
    speaker = Bus(hub.connect(), "rig", "tracker")
    speaker.answer(topics.CALIBRATION, lambda _: rig)
    service = Service(name, ServiceConfig(), Bus(hub.connect(), "rig", name))
    running = threading.Thread(target=run, args=(service, tmp_path), daemon=True)
    running.start()
    assert speaker.wait_for_alive(name, 30)
    assert service.health().ready
    dog = Watchdog()
    for i in range(30):
        publish_frame(speaker, i, curve, rig)
        waits = service.bus.newest_waits
        assert systemd.is_told(dog, service.health(), work_waits=waits)
    service.bus.close()
    running.join(30)
    speaker.close()


def test_without_systemd_nothing_is_said(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET")
    assert not systemd.is_told(Watchdog(), beat("tracker", 1))


def test_a_systemd_that_does_not_listen_holds_nobody_up(systemd: Systemd) -> None:
    dog = Watchdog()
    for second in range(1000):  # more than wait in a socket
        dog.feed(beat("tracker", second), work_waits=True)
    assert systemd.is_told(dog, beat("tracker", 1000))


def test_a_real_process_says_that_it_runs(systemd: Systemd, rig_name: str) -> None:
    systemd.socket.settimeout(30)
    command = [sys.executable, "-m", "services.cli", "tracker", "--rig", rig_name]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            for _ in range(2):
                assert systemd.socket.recv(100) == SAID
        finally:
            process.terminate()
        assert process.wait(20) == 0

"""A program ends when its own code has ended, whatever it has left open."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services import cli, topics, zenoh_transport
from services.bus import Bus
from services.doctor import ERROR, DoctorConfig, examine
from services.inbox import Inbox, Stop
from services.zenoh_transport import ZenohTransport, local_config, remove_sockets
from suturetrack.types import Stamp

SOON_S = 30.0
LISTENER = """
import sys, threading, time
from services import cli, topics, zenoh_transport
from services.client import connect
client = connect("test")
steps = client.bus.every(topics.STEP)
assert client.bus.wait_for_alive("tracker")
assert steps.get(20) is not None
print("heard", flush=True)
"""
NEWCOMER = """
from services import topics
from services.client import connect
for _ in range(100):
    with connect("test") as client:
        assert client.bus.every(topics.STEP).get(20) is not None
print("heard", flush=True)
"""
ENDS = {
    "": (0, ""),
    "raise ValueError('my own')": (1, "ValueError: my own"),
    "sys.exit(3)": (3, ""),
    "time.sleep(60)": (-signal.SIGINT, "KeyboardInterrupt"),
    "threading.Thread(target=lambda: (time.sleep(0.5), steps.get(20) or print('deaf'))).start()": (
        0,
        "",
    ),
}


@pytest.fixture
def talker(rig_name: str) -> Iterator[None]:
    """A process that never stops to talk is played."""
    bus = Bus(ZenohTransport(local_config(rig_name, "tracker")), rig_name, "tracker")
    bus.declare_alive()

    def talk() -> None:
        while not bus.stop.wait(0.0005):
            bus.publish(topics.STEP, Stamp(0, 0, 0))

    talking = threading.Thread(target=talk)
    talking.start()
    yield
    bus.stop.set()
    talking.join()
    bus.close()
    remove_sockets(rig_name)


def start(code: str) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code], stdout=pipe, stderr=pipe, text=True)


def test_a_program_that_closes_nothing_ends_with_its_own_words(talker: None) -> None:
    for end, (status, last) in ENDS.items():
        with start(LISTENER + end) as program:
            assert program.stdout
            assert program.stdout.readline() == "heard\n"
            if status < 0:
                program.send_signal(signal.SIGINT)
            try:
                out, err = program.communicate(timeout=SOON_S)
            finally:
                program.kill()
            assert program.returncode == status, (end, err)
            assert err.strip().endswith(last)
            assert "deaf" not in out


def test_a_program_that_comes_into_a_busy_system_says_its_own_words_alone(
    talker: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    del talker
    monkeypatch.delenv("RUST_LOG", raising=False)
    with start(NEWCOMER) as program:
        assert program.communicate(timeout=SOON_S) == ("heard\n", "")


@pytest.fixture
def no_router(tmp_path: Path) -> Path:
    """A configuration that leads to a router which is not there."""
    file = tmp_path / "nowhere.json5"
    file.write_text(
        '{mode: "client", scouting: {multicast: {enabled: false}},'
        ' connect: {endpoints: ["tcp/127.0.0.1:9"], timeout_ms: -1, exit_on_failure: false}}'
    )
    return file


def interrupt(program: subprocess.Popen[str]) -> tuple[str, str]:
    """What a program says after an interrupt, while it waits for a router and has said so."""
    assert program.stderr
    assert program.stderr.readline().endswith("waiting for the router at tcp/127.0.0.1:9\n")
    program.send_signal(signal.SIGINT)
    try:
        return program.communicate(timeout=SOON_S)
    finally:
        program.kill()


def test_a_program_is_interrupted_while_it_waits_for_a_router(no_router: Path) -> None:
    code = f"from services.client import connect; connect(zenoh={str(no_router)!r})"
    with start(f"{code}; print('connected')") as program:
        out, err = interrupt(program)
    assert program.returncode == -signal.SIGINT
    assert "connected" not in out
    assert err.strip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize("verb", ["run --source stage:figure8-107", "tracker", "console"])
def test_what_goes_on_for_long_waits_for_a_router_and_can_be_interrupted(
    verb: str, no_router: Path, tmp_path: Path
) -> None:
    words = [*verb.split(), "--zenoh", str(no_router)]
    words += ["--run-dir", str(tmp_path / "run")] if "run" in words else []
    with start(f"from services import cli; raise SystemExit(cli.call({words!r}))") as program:
        _, err = interrupt(program)
    assert program.returncode == 130
    assert err == ""


@pytest.mark.parametrize("verb", ["status --once --rig rig", "seed 3 4", "grasp --fraction 0.5"])
def test_what_asks_once_does_not_wait_for_a_router(
    verb: str,
    no_router: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(zenoh_transport, "_ROUTER_MS", 200)
    assert cli.call([*verb.split(), "--zenoh", str(no_router)]) == 1
    assert capsys.readouterr().err == (
        f"suturetrack {verb.split()[0]}: no router answers at tcp/127.0.0.1:9; "
        "start it with `suturetrack router --zenoh FILE`\n"
    )


def test_the_doctor_finds_that_there_is_no_router(
    no_router: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_transport, "_ROUTER_MS", 200)
    *local, last = examine(DoctorConfig("rig", no_router))
    assert "disk" in {finding.subject for finding in local}
    assert (last.level, last.text) == (ERROR, "no router answers at tcp/127.0.0.1:9")
    assert last.advice == "start it with `suturetrack router --zenoh FILE`"


class Interrupted(Exception):
    """Stands in for a KeyboardInterrupt."""


def test_an_interrupt_leaves_no_lock_behind() -> None:
    stop = Stop()
    inbox: Inbox[int] = Inbox(stop, 16)

    def put() -> None:
        while not stop.wait(0.0001):
            inbox.put(0)

    def interrupt(number: int, frame: object) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGALRM, interrupt)
    putting = threading.Thread(target=put, daemon=True)
    putting.start()
    interrupts, until = 0, time.monotonic() + 3.0
    try:
        while time.monotonic() < until:
            try:
                signal.setitimer(signal.ITIMER_REAL, 0.0003)
                while True:
                    inbox.get(0.01)
            # A Condition that is interrupted between its own two steps says so in this way.
            except (Interrupted, RuntimeError):
                interrupts += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    # The lock is this thread's if anybody's, so another one has to try.
    assert interrupts > 300
    received = inbox.received
    stop.set()
    putting.join(10)
    assert not putting.is_alive()
    assert inbox.received >= received > 0

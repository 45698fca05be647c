from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import psutil
import pytest

from services import topics, wire
from services.bus import Bus, NoAnswer, Transport
from services.memory_transport import Hub
from services.messages import SeedReply
from services.wire import Packet, WireError
from services.zenoh_transport import (
    ArrivedPayload,
    ZenohTransport,
    load_config,
    local_config,
    remove_sockets,
    socket_directory,
)
from suturetrack.types import InputError, Seed, Stamp, StereoFrame
from tests.conftest import wait_until

Connect = Callable[[str], Bus]


@pytest.fixture(params=["memory", "zenoh"])
def connect(request: pytest.FixtureRequest, rig_name: str) -> Iterator[Connect]:
    """Opens buses of one rig; closes them at the end."""
    hub, buses = Hub(), list[Bus]()

    def transport(process: str) -> Transport:
        if request.param == "memory":
            return hub.connect()
        return ZenohTransport(local_config(rig_name, process))

    def open_bus(process: str) -> Bus:
        buses.append(Bus(transport(process), rig_name, process))
        return buses[-1]

    yield open_bus
    for bus in buses:
        bus.close()
    if request.param == "zenoh":
        remove_sockets(rig_name)


def stamp(frame: int) -> Stamp:
    return Stamp(frame, frame * 33_000_000, time.time_ns())


def test_every_reader_gets_all_in_order(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    reader = source.every(topics.STEP)
    assert tracker.wait_for_readers(topics.STEP, 10)
    for frame in range(500):
        tracker.publish(topics.STEP, stamp(frame))
    got = [reader.get(10) for _ in range(500)]
    assert [s.frame for s in got if s] == list(range(500))
    assert reader.dropped == reader.refused == 0


def test_a_reader_of_the_newest_passes_over_the_rest_and_counts_them(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    reader = source.newest(topics.STEP)
    assert tracker.wait_for_readers(topics.STEP, 10)
    for frame in range(100):
        tracker.publish(topics.STEP, stamp(frame))
    wait_until(lambda: reader.passed_over == 99)
    newest = reader.get(1)
    assert newest is not None
    assert newest.frame == 99
    assert reader.get(0.01) is None
    assert (reader.dropped, reader.lost) == (99, 0)


def test_a_reader_ends_with_its_block(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    with source.newest(topics.STEP) as reader:
        assert tracker.wait_for_readers(topics.STEP, 10)
        tracker.publish(topics.STEP, stamp(0))
        assert reader.get(10) is not None
    wait_until(lambda: not tracker.wait_for_readers(topics.STEP, 0))
    tracker.publish(topics.STEP, stamp(1))
    assert (reader.waiting, source.readers) == (0, [])


def test_images_cross_unchanged(connect: Connect) -> None:
    source, segmenter = connect("source"), connect("segmenter")
    left, right = np.random.default_rng(0).integers(0, 256, (2, 480, 640, 3), dtype=np.uint8)
    reader = segmenter.newest(topics.FRAME)
    assert source.wait_for_readers(topics.FRAME, 10)
    source.publish(topics.FRAME, StereoFrame(stamp(3), left, right))
    frame = reader.get(10)
    assert frame is not None
    np.testing.assert_array_equal(frame.left, left)
    np.testing.assert_array_equal(frame.right, right)


def test_iteration_ends_when_stopped(connect: Connect) -> None:
    reader = connect("segmenter")
    frames = reader.newest(topics.FRAME)
    ended = threading.Event()

    def loop() -> None:
        for _ in frames:
            pass
        ended.set()

    threading.Thread(target=loop, daemon=True).start()
    assert not ended.is_set()
    reader.stop.set()
    assert ended.wait(1)
    assert frames.get() is None
    assert not reader.wait_for_readers(topics.FIELD)


def test_nobody_reads_at_first(connect: Connect) -> None:
    source = connect("source")
    assert not source.wait_for_readers(topics.FRAME, 0.1)
    assert not source.wait_for_alive("tracker", 0.1)


def test_questions_are_answered(connect: Connect) -> None:
    tracker, console = connect("tracker"), connect("console")
    tracker.answer(topics.SEED, lambda seed: SeedReply(seed.thread, True, f"at {seed.pixel}"))
    seed = Seed("left", pixel=(3.0, 4.0))
    reply = console.ask_until_answered(topics.SEED, seed)
    assert reply == SeedReply("left", True, "at (3.0, 4.0)")


def test_a_question_to_nobody_fails_at_once(connect: Connect) -> None:
    console = connect("console")
    began = time.monotonic()
    with pytest.raises(NoAnswer, match="nobody answers"):
        console.ask(topics.SEED, Seed("0", pixel=(1.0, 1.0)), timeout=5)
    assert time.monotonic() - began < 2


def test_a_question_without_an_answer_in_time_fails(connect: Connect) -> None:
    tracker, console = connect("tracker"), connect("console")
    requests = tracker.requests(topics.SEED)
    tracker.declare_alive()
    assert console.wait_for_alive("tracker", 10)
    with pytest.raises(NoAnswer):
        console.ask(topics.SEED, Seed("0", pixel=(1.0, 1.0)), timeout=0.2)
    assert requests.get(1) is not None


def test_those_alive_are_seen_to_come_and_go(connect: Connect) -> None:
    tracker, run = connect("tracker"), connect("run")
    assert not run.alive()
    tracker.declare_alive()
    assert run.wait_for_alive("tracker", 10)
    tracker.close()
    wait_until(lambda: not run.alive())


def put(bus: Bus, key: str, packet: Packet) -> None:
    bus._transport.put(f"suturetrack/test/{key}", packet, large=False)


def test_bad_messages_are_refused_counted_and_passed(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    complaints = list[str]()
    source.complain = complaints.append
    reader = source.every(topics.STEP)
    assert tracker.wait_for_readers(topics.STEP, 10)
    good = wire.encode(stamp(1))
    put(tracker, "step", Packet(good.encoding, b"\xff garbage", good.attachment))
    put(tracker, "step", Packet("application/msgpack;stamp/9", good.payload, good.attachment))
    put(tracker, "step", Packet(good.encoding, good.payload, b"no header"))
    put(tracker, "step", Packet(good.encoding, b"", b""))
    tracker.publish(topics.STEP, stamp(2))
    got = reader.get(10)
    assert got is not None
    assert got.frame == 2
    assert reader.refused == source.refused == len(complaints) == 4
    assert any("stamp/9" in line and "stamp/1" in line for line in complaints)


def test_a_message_under_the_key_of_another_thread_is_refused(connect: Connect) -> None:
    tracker, segmenter = connect("tracker"), connect("segmenter")
    reader = segmenter.every(topics.SEEDING)
    assert tracker.wait_for_readers(topics.SEEDING, 10)
    put(tracker, "thread/1/seeding", wire.encode(Seed("0", pixel=(1.0, 1.0))))
    tracker.publish(topics.SEEDING, Seed("1", pixel=(2.0, 2.0)))
    got = reader.get(10)
    assert got is not None
    assert (got.thread, reader.refused) == ("1", 1)


def test_bad_questions_are_refused_with_the_reason(connect: Connect) -> None:
    tracker, console = connect("tracker"), connect("console")
    tracker.answer(topics.SEED, lambda seed: SeedReply(seed.thread, True, ""))
    assert console.ask_until_answered(topics.SEED, Seed("0", pixel=(1.0, 1.0)))
    bad = wire.encode(Seed("0", pixel=(float("nan"), 1.0)))
    with pytest.raises(NoAnswer, match="not finite"):
        console._transport.ask("suturetrack/test/thread/0/seed", bad, 5)
    assert tracker.refused == 1


def test_gaps_in_the_numbers_are_lost_messages(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    reader = source.every(topics.STEP)
    assert tracker.wait_for_readers(topics.STEP, 10)
    for number in (5, 6, 9):
        put(tracker, "step", wire.encode(stamp(number), "tracker-1", number))
    assert all(reader.get(10) for _ in range(3))
    assert (reader.lost, reader.passed_over) == (2, 0)


def test_a_number_that_leaps_far_or_back_counts_no_lost_messages(connect: Connect) -> None:
    tracker, source = connect("tracker"), connect("source")
    reader = source.every(topics.STEP)
    assert tracker.wait_for_readers(topics.STEP, 10)
    for number in (0, 2**63 - 1, 1, 3):
        put(tracker, "step", wire.encode(stamp(number % 100), "tracker-1", number))
    assert all(reader.get(10) for _ in range(4))
    assert reader.lost == 1


def test_who_asks_until_answered_tells_of_bad_answers(connect: Connect) -> None:
    source, tracker = connect("source"), connect("tracker")
    complaints = list[str]()

    def complain(text: str) -> None:
        complaints.append(text)
        tracker.stop.set()

    tracker.complain = complain
    bad = wire.encode(stamp(1))
    source._transport.serve("suturetrack/test/calibration", lambda _key, _asked, reply: reply(bad))
    assert tracker.ask_until_answered(topics.CALIBRATION, None) is None
    assert len(complaints) == 1
    assert complaints[0].startswith("source sent a bad answer: ")


def test_the_last_messages_outlive_their_sender(connect: Connect) -> None:
    source, tracker = connect("source"), connect("tracker")
    source.keep(topics.SEEDING, lambda seed, _: seed.pixel != (9.0, 9.0))
    assert tracker.wait_for_readers(topics.SEEDING, 10)
    for thread, u in (("a", 1.0), ("b", 9.0), ("a", 2.0), ("b", 3.0), ("b", 9.0)):
        tracker.publish(topics.SEEDING, Seed(thread, pixel=(u, u)))
    put(tracker, "thread/c/seeding", Packet("application/msgpack;seed/1", b"\xff", b"\x80"))
    wait_until(lambda: source.refused == 1)
    tracker.close()
    console = connect("console")
    found = list[Seed]()

    def asked() -> bool:
        found[:] = console.last(topics.SEEDING)
        return bool(found)

    wait_until(asked)
    assert {seed.thread: seed.pixel for seed in found} == {"a": (2.0, 2.0), "b": (3.0, 3.0)}
    assert console.last(topics.STEP) == []


def test_what_is_remembered_is_bounded(connect: Connect) -> None:
    source, tracker = connect("source"), connect("tracker")
    source.keep(topics.SEEDING)
    assert tracker.wait_for_readers(topics.SEEDING, 10)
    for i in range(300):
        tracker.publish(topics.SEEDING, Seed(f"t{i}", pixel=(1.0, 1.0)))
    tracker.publish(topics.SEEDING, Seed("t0", pixel=(2.0, 2.0)))
    wait_until(lambda: any(seed.pixel == (2.0, 2.0) for seed in tracker.last(topics.SEEDING)))
    assert len(tracker.last(topics.SEEDING)) == 256


def test_another_rig_hears_nothing(rig_name: str) -> None:
    with_hub = Hub()
    here, there = (Bus(with_hub.connect(), name, "source") for name in ("here", "there"))
    reader = here.every(topics.STEP)
    there.publish(topics.STEP, stamp(1))
    assert reader.get(0.05) is None


OTHER = """
import sys, time
from services import topics
from services.bus import Bus
from services.zenoh_transport import ZenohTransport, local_config
from suturetrack.types import Stamp
bus = Bus(ZenohTransport(local_config("test", "tracker")), "test", "tracker")
bus.declare_alive()
bus.wait_for_readers(topics.STEP)
for frame in range(10**9):
    bus.publish(topics.STEP, Stamp(frame, 0, 0))
    time.sleep(0.01)
"""


def start_other() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", OTHER])


def test_a_killed_process_is_seen_to_die_and_may_come_back(rig_name: str) -> None:
    source = Bus(ZenohTransport(local_config(rig_name, "source")), rig_name, "source")
    reader = source.every(topics.STEP)
    try:
        for _ in range(2):
            other = start_other()
            assert source.wait_for_alive("tracker", 20)
            assert reader.get(10) is not None
            other.send_signal(signal.SIGKILL)
            other.wait()
            wait_until(lambda: not source.alive())
            while reader.get(0.05):
                pass
    finally:
        source.close()
        remove_sockets(rig_name)


def test_who_leaves_waits_little_for_a_process_that_stands_still(rig_name: str) -> None:
    other = start_other()
    watch = Bus(ZenohTransport(local_config(rig_name, "status")), rig_name, "status")
    try:
        assert watch.wait_for_alive("tracker", 20)
        other.send_signal(signal.SIGSTOP)
        patient = local_config(rig_name, "patient")
        patient.insert_json5("transport/unicast/open_timeout", "5000")
        left = []

        def leave(name: str, transport: ZenohTransport) -> None:
            transport.close()
            left.append(name)

        configs = {"patient": patient, "usual": local_config(rig_name, "usual")}
        transports = {name: ZenohTransport(config) for name, config in configs.items()}
        leaving = [threading.Thread(target=leave, args=each) for each in transports.items()]
        for thread in leaving:
            thread.start()
        wait_until(lambda: left)
        assert left == ["usual"]
    finally:
        other.kill()
        other.wait()
        watch.close()
    for thread in leaving:
        thread.join()
    remove_sockets(rig_name)


def test_a_second_process_of_one_name_is_told_so(rig_name: str) -> None:
    first = ZenohTransport(local_config(rig_name, "source"))
    try:
        with pytest.raises(InputError, match=r"rig 'test'.*'source' is running already"):
            ZenohTransport(local_config(rig_name, "source"))
    finally:
        first.close()
        remove_sockets(rig_name)


def test_nothing_listens_beyond_this_machine(rig_name: str) -> None:
    buses = [
        ZenohTransport(local_config(rig_name, name)) for name in ("source", "tracker", "viewer")
    ]
    try:
        mine = psutil.Process().net_connections(kind="inet")
        assert not [c for c in mine if c.status == psutil.CONN_LISTEN or not c.raddr]
        directory = socket_directory(rig_name)
        assert directory.stat().st_mode & 0o077 == 0
        assert {p.name for p in directory.glob("*.sock")} == {"source.sock", "tracker.sock"}
    finally:
        for bus in buses:
            bus.close()
        remove_sockets(rig_name)
    assert not directory.exists()


def test_a_directory_open_to_others_is_refused(rig_name: str) -> None:
    directory = socket_directory(rig_name)
    directory.chmod(0o755)
    try:
        with pytest.raises(InputError, match="chmod 700"):
            local_config(rig_name, "source")
    finally:
        directory.chmod(0o700)
        remove_sockets(rig_name)


def test_a_long_rig_name_is_refused(rig_name: str) -> None:
    name = "r" * 64
    deep = Path(os.environ["XDG_RUNTIME_DIR"]) / ("d" * 60)
    deep.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(deep))
        with pytest.raises(InputError, match="too long"):
            local_config(name, "source")
        remove_sockets(name)


def test_a_configuration_file_replaces_the_default(tmp_path: Path) -> None:
    file = tmp_path / "net.json5"
    file.write_text(
        '{mode: "peer", scouting: {multicast: {enabled: false}}, listen: {endpoints: ["tcp/127.0.0.1:0"]}}'
    )
    transport = ZenohTransport(load_config(file))
    try:
        ports = [c.laddr.ip for c in psutil.Process().net_connections(kind="tcp")]
        assert ports == ["127.0.0.1"]
    finally:
        transport.close()
    with pytest.raises(InputError, match="no file"):
        load_config(tmp_path / "missing.json5")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{ garbage", "not valid JSON5 at line 1, column 1"),
        (
            '{mode: "client",\n connect: {endpoints: [1,}}',
            "not valid JSON5 at line 2, column [0-9]+",
        ),
        ('{mode: "pear"}', "line 1, column 8: unknown variant `pear`, expected .*`client`"),
        (
            '{connect: {timeout_ms: "x"}}',
            'line 1, column 24: invalid type: string "x", expected .*',
        ),
        ('{connect: {endpoints: ["x"]}}', "line 1, column [0-9]+: Endpoints must be .*: x"),
        ("", "Empty config file"),
    ],
)
def test_a_bad_configuration_file_gets_one_line(tmp_path: Path, content: str, reason: str) -> None:
    file = tmp_path / "net.json5"
    file.write_text(content)
    with pytest.raises(InputError) as refusal:
        load_config(file)
    assert re.fullmatch(f"zenoh {re.escape(str(file))}: {reason}", str(refusal.value))


@dataclass
class Shared:
    """Stands in for content in shared memory."""

    valid: bool

    def to_bytes(self) -> bytes:
        return b"perhaps of another frame"

    def as_shm(self) -> Shared:
        return self

    def is_valid(self) -> bool:
        return self.valid


def test_shared_memory_that_was_taken_back_is_not_believed() -> None:
    good, bad = (ArrivedPayload(cast(Any, Shared(valid))) for valid in (True, False))
    assert bytes(good) == b"perhaps of another frame"
    with pytest.raises(WireError, match="read too late"):
        bytes(bad)


SENDER = """
import sys
from services.wire import Packet, WireError
from services.zenoh_transport import ZenohTransport, local_config
transport = ZenohTransport(local_config("test", "source"))
while not sys.stdin.closed and sys.stdin.readline():
    transport.put("big", Packet("x", bytes(1 << 20), b""), large=True)
"""


def test_images_come_through_shared_memory_and_nothing_of_it_stays(rig_name: str) -> None:
    sender = subprocess.Popen([sys.executable, "-c", SENDER], stdin=subprocess.PIPE)
    receiver = ZenohTransport(local_config(rig_name, "tracker"))
    shared = list[bool]()
    receiver.subscribe("big", lambda _, packet: shared.append(_is_shared(packet)))
    assert sender.stdin

    def arrived() -> bool:
        assert sender.stdin
        sender.stdin.write(b"\n")
        sender.stdin.flush()
        return bool(shared)

    wait_until(arrived, 20)
    assert shared[0]
    files = _mapped(sender.pid)
    assert files
    sender.kill()
    sender.communicate()
    receiver.close()
    subprocess.run([sys.executable, "-c", SWEEP], check=True)
    remove_sockets(rig_name)
    # This process keeps its own mappings until it ends.
    assert not [file for file in files - _mapped(os.getpid()) if file.exists()]


RESTARTED = """
import sys
import numpy as np
from services import topics
from services.service import ServiceConfig, run
from suturetrack.types import RidgeField, Stamp
view = np.zeros((480, 640, 2), np.float32)

def send(service):
    while not service.bus.stop.wait(0.05):
        service.bus.publish(topics.FIELD, RidgeField(Stamp(0, 0, 0), view, view))

run("segmenter", ServiceConfig(rig="test", resume=int(sys.argv[1])), send)
"""


@pytest.mark.parametrize(("deaths", "is_shared"), [(7, True), (8, False)])
def test_who_dies_over_and_over_fills_no_memory_of_its_readers(
    rig_name: str, deaths: int, is_shared: bool
) -> None:
    receiver = ZenohTransport(local_config(rig_name, "tracker"))
    shared = list[bool]()
    receiver.subscribe("**/field", lambda _, packet: shared.append(_is_shared(packet)))
    sender = subprocess.Popen([sys.executable, "-c", RESTARTED, str(deaths)])
    wait_until(lambda: len(shared) >= 3, 30)
    sender.terminate()
    assert sender.wait(30) == 0
    receiver.close()
    assert set(shared) == {is_shared}


SWEEP = "from services.zenoh_transport import sweep_shared_memory; sweep_shared_memory()"


def _is_shared(packet: Packet) -> bool:
    assert isinstance(packet.payload, ArrivedPayload)
    return packet.payload.is_shared


def _mapped(pid: int) -> set[Path]:
    """The shared memory that a process holds."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split()[-1]) for line in lines if "/dev/shm/" in line}

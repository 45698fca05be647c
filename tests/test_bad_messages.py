"""A running system under fire from messages that it must not believe."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from services import topics, wire
from services.bench.system import System
from services.bus import Bus, NoAnswer
from services.messages import Health
from services.wire import Packet, WireError
from services.zenoh_transport import ZenohTransport, local_config
from suturetrack.types import RidgeField, Stamp, StereoFrame
from tests.garbage import malformed
from tests.test_faults import options, private_sockets

__all__ = ["options"]

RIG = "faults"
KEYS = {
    **{topic: topic.key for topic in (topics.FRAME, topics.FIELD, topics.STEP)},
    **{topic: topic.key.format(thread="0") for topic in (topics.STATE, topics.TRUTH)},
    topics.SEEDING: topics.SEEDING.key.format(thread="0"),
    topics.HEALTH: topics.HEALTH.key.format(process="source"),
}
MOST_GROWTH_MB = 60


@pytest.mark.parametrize(
    "kind", [t.kind for t in (*KEYS, topics.SEED, topics.GRASP, topics.FORGET)]
)
def test_all_of_it_is_refused(kind: type) -> None:
    chance = np.random.default_rng(0)
    for packet in itertools.islice(malformed(kind, chance), 60):
        with pytest.raises(WireError):
            wire.decode(packet, kind)


@pytest.fixture(scope="module")
def system(options: list[str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with private_sockets(), System(RIG, options, tmp_path_factory.mktemp("system")) as running:
        running.until_tracking()
        yield running


@pytest.fixture
def attacker(system: System) -> Iterator[Attacker]:
    attacker = Attacker()
    yield attacker
    attacker.bus.close()


class Attacker:
    """Sends to a rig whatever it likes."""

    def __init__(self) -> None:
        self._transport = ZenohTransport(local_config(RIG, "stranger"))
        self.bus = Bus(self._transport, RIG, "stranger")
        self._healths = self.bus.every(topics.HEALTH)
        self.health = dict[str, Health]()

    def put(self, key: str, packet: Packet) -> None:
        self._transport.put(f"{topics.root(RIG)}/{key}", packet, large=False)

    def ask(self, key: str, packet: Packet) -> None:
        self._transport.ask(f"{topics.root(RIG)}/{key}", packet, 5.0)

    def listen(self) -> dict[str, Health]:
        """The newest heartbeat of each process."""
        while (health := self._healths.get(0)) is not None:
            self.health[health.process] = health
        return self.health

    def heard_of_all(self) -> bool:
        return set(topics.PROCESSES) <= self.listen().keys()


@pytest.mark.parametrize("count", [100, pytest.param(10_000, marks=pytest.mark.long)])
def test_bad_messages_are_counted_and_harm_nothing(
    system: System, attacker: Attacker, count: int
) -> None:
    chance = np.random.default_rng(1)
    pids = {name: process.pid for name, process in system.processes().items()}
    system.until(attacker.heard_of_all)
    before, began = dict(attacker.health), time.monotonic()
    for topic, key in KEYS.items():
        for i, packet in enumerate(itertools.islice(malformed(topic.kind, chance), count)):
            attacker.put(key, packet)
            if i % 10 == 9:
                time.sleep(0.01)  # a pace at which nothing has to be dropped on the way
    for question in (topics.SEED, topics.GRASP, topics.FORGET):
        key = question.key.format(thread="0")
        for packet in itertools.islice(malformed(question.kind, chance), count):
            with pytest.raises(NoAnswer):
                attacker.ask(key, packet)
    for packet in strangers(count):
        attacker.put("frame" if packet.encoding.endswith("frame/1") else "field", packet)
        time.sleep(0.002)

    def refused(process: str) -> int:
        return attacker.listen()[process].refused - before[process].refused

    # States and seeds; states, seeds and steps; three kinds of questions; beside others in part.
    least = {"source": 2 * count, "segmenter": 3 * count, "tracker": 3 * count}
    for process, expected in least.items():
        system.until(lambda p=process, n=expected: refused(p) >= n, 30)  # type: ignore[misc]
    seconds = time.monotonic() - began
    system.until_tracking()
    assert {name: process.pid for name, process in system.processes().items()} == pids
    memory = {p: (before[p].memory_mb, attacker.health[p].memory_mb) for p in topics.PROCESSES}
    print(f"{seconds:.0f} s", {p: refused(p) for p in topics.PROCESSES}, memory)
    for process, (first, last) in memory.items():
        assert last - first < MOST_GROWTH_MB, process
    lines = [line for line in system.said.splitlines() if "refused" in line]
    assert 3 <= len(lines) <= 3 * (seconds + 2)


def strangers(count: int) -> Iterator[Packet]:
    """Messages that are well formed, but of another rig, from the past and from the future."""
    image, view = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320, 2), np.float32)
    whole = np.zeros((480, 640, 2), np.float32)
    for i in range(count // 4):
        now = Stamp(i, time.time_ns(), time.time_ns(), 33_333_333)
        yield wire.encode(StereoFrame(now, image, image))
        yield wire.encode(RidgeField(now, view, view))
        yield wire.encode(RidgeField(Stamp(i, i, i), whole, whole))
        yield wire.encode(RidgeField(Stamp(2**62 + i, 2**62 - i, 2**62), whole, whole))


def test_seeds_that_are_nowhere_are_answered(system: System, attacker: Attacker) -> None:
    for packet in itertools.islice(malformed(topics.SEED.kind, np.random.default_rng(2)), 9):
        with pytest.raises(NoAnswer, match=r"\w"):
            attacker.ask("thread/0/seed", packet)
    system.until_tracking()

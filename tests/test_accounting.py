"""Nothing is lost in silence: what was sent is what was read, and what was counted as dropped."""

from __future__ import annotations

import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from services import topics
from services.bus import Bus, Reader
from services.zenoh_transport import ZenohTransport, local_config, remove_sockets
from tests.conftest import wait_until

SENDER = """
import sys, time
import numpy as np
from services import topics
from services.bus import Bus
from services.zenoh_transport import ZenohTransport, local_config
from suturetrack.types import Stamp, StereoFrame

flood, tail = int(sys.argv[1]), int(sys.argv[2])
bus = Bus(ZenohTransport(local_config("test", "source")), "test", "source")
image = np.zeros((480, 640, 3), np.uint8)
bus.make_room(StereoFrame(Stamp(0, 0, 0), image, image))
for reader in ("tracker", "viewer"):
    bus.wait_for_alive(reader)
print("begun", flush=True)
for i in range(flood + tail):
    stamp = Stamp(i, i, time.time_ns())
    bus.publish(topics.FRAME, StereoFrame(stamp, image, image))
    bus.publish(topics.STEP, stamp)
    if i >= flood:
        time.sleep(0.05)
print(i + 1, flush=True)
sys.stdin.read()
bus.close()
"""


def start_sender(flood: int, tail: int = 20) -> subprocess.Popen[str]:
    """A process that floods with VGA stereo frames and small messages, then sends a few slowly."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", SENDER, str(flood), str(tail)]
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)


class Expected(dict[tuple[str, str], int]):
    """Number of the next message by publisher, which remembers that of the first."""

    def __init__(self) -> None:
        self.first: dict[tuple[str, str], int] = {}

    def __setitem__(self, sender: tuple[str, str], number: int) -> None:
        self.first.setdefault(sender, number - 1)
        super().__setitem__(sender, number)


class Consumer:
    """Reads a topic at its own pace, and counts."""

    def __init__(self, reader: Reader[Any], pause_s: float | None):
        self.reader, self.read = reader, 0
        self.expected = reader.expected = Expected()
        self._thread = threading.Thread(target=self._loop, args=(pause_s or 0.0,), daemon=True)
        if pause_s is not None:
            self._thread.start()

    def __str__(self) -> str:
        reader = self.reader
        counts = f"read {self.read}, passed over {reader.passed_over}, lost {reader.lost}"
        others = f"refused {reader.refused}, waiting {reader.waiting}"
        numbers = [(self.expected.first[sender], end) for sender, end in self.expected.items()]
        reads = f"reads: {self._thread.is_alive()}"
        return f"{reader.topic.key}: {counts}, {others}, numbers from and below {numbers}, {reads}"

    def _loop(self, pause_s: float) -> None:
        for _ in self.reader:
            self.read += 1
            time.sleep(pause_s)

    def hears(self, senders: int) -> bool:
        """Whether at least 20 messages were sent by each of so many until the last that arrived."""
        ends = list(self.expected.copy().values())
        return len(ends) == senders and min(ends) >= 20

    def is_balanced(self, senders: int) -> bool:
        """Whether it is known what became of all messages until the last of each sender that arrived."""
        return self.hears(senders) and self.accounted() == sum(self.expected.copy().values())

    def accounted(self) -> int:
        """Messages of which it is known what became of them."""
        reader = self.reader
        return self.read + reader.passed_over + reader.lost + reader.refused + reader.waiting


@contextmanager
def consumers() -> Iterator[list[Consumer]]:
    """One that keeps up, a slow one and one that stands still, for frames and for small messages."""
    buses = [Bus(ZenohTransport(local_config("test", n)), "test", n) for n in ("tracker", "viewer")]
    keeping_up, other = buses
    try:
        all_of_them = [
            Consumer(keeping_up.newest(topics.FRAME), 0.0),
            Consumer(other.newest(topics.FRAME), 0.05),
            Consumer(other.newest(topics.FRAME), None),
            Consumer(keeping_up.every(topics.STEP), 0.0),
            Consumer(other.every(topics.STEP), 0.01),
            Consumer(other.every(topics.STEP), None),
        ]
        for bus in buses:
            bus.declare_alive()
        yield all_of_them
    finally:
        for bus in buses:
            bus.close()
        remove_sockets("test")


@pytest.mark.parametrize("flood", [600, pytest.param(20_000, marks=pytest.mark.long)])
def test_sent_is_read_and_counted_drops(rig_name: str, flood: int) -> None:
    with consumers() as all_of_them, start_sender(flood) as sender:
        assert sender.stdout
        assert sender.stdin
        assert sender.stdout.readline() == "begun\n"
        sent = int(sender.stdout.readline())
        assert sent == flood + 20
        for consumer in all_of_them:
            wait_until(lambda c=consumer: c.accounted() == sent, tell=consumer.__str__)  # type: ignore[misc]
        sender.stdin.close()
        # A flood is more than the slow ones can take.
        slow, still = all_of_them[1:3]
        assert slow.reader.dropped > 100
        assert still.reader.dropped == sent - 1
        assert [consumer.read > 0 for consumer in all_of_them] == [True, True, False] * 2


@pytest.mark.parametrize("kills", [3, pytest.param(100, marks=pytest.mark.long)])
def test_nothing_is_silent_while_senders_are_killed(rig_name: str, kills: int) -> None:
    """What a dying process took with it, nobody can count; up to its last message nothing is missing.

    Readers are connected one after the other, so that a sender waits for both.
    """
    chance = random.Random(0)
    with consumers() as all_of_them:
        for killed in range(kills):
            with start_sender(10**9) as sender:
                assert sender.stdout
                assert sender.stdout.readline() == "begun\n"
                for consumer in all_of_them:
                    wait_until(partial(consumer.hears, killed + 1), tell=consumer.__str__)
                time.sleep(chance.uniform(0, 0.05))
                sender.kill()
        with start_sender(0) as sender:
            assert sender.stdout
            assert sender.stdin
            assert sender.stdout.readline() == "begun\n"
            assert sender.stdout.readline() == "20\n"
            for consumer in all_of_them:
                wait_until(partial(consumer.is_balanced, senders=kills + 1), tell=consumer.__str__)
                assert max(consumer.expected.first.values()) == 0
            sender.stdin.close()

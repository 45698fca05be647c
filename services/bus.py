"""How processes talk: publish and read topics, ask and answer questions, see who is alive.

The face is the same over Zenoh (`services.zenoh_transport`) and within one process
(`services.memory_transport`).
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, Protocol, Self, TypeVar

from services import topics, wire
from services.inbox import Inbox, Stop
from services.topics import Question, Topic
from services.wire import Packet, WireError

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")

DEPTH = 1024
"""Messages that wait for a reader of every one before the oldest is given up, and counted."""
_MOST_PUBLISHERS = 256
_MOST_KEPT = 256
_POLL_S = 0.02
_LONGEST_GAP = 1_000_000
"""Messages that one gap may count: more are hours of a stream, and such a number is garbage, no count."""

Deliver = Callable[[str, Packet], None]
Reply = Callable[[Packet | str], None]
"""Answers a question once: with a packet, or with the reason why there is no answer."""


class NoAnswer(Exception):
    """Nobody answered a question, or the one who should have refused it; the text says why."""


class BadAnswer(NoAnswer):
    """There is an answer, and it is none that this process understands."""


class Transport(Protocol):
    """What carries packets; keys are full keys or key expressions."""

    def put(self, key: str, packet: Packet, *, large: bool) -> None:
        """Sends to all subscribers and does not wait for them."""

    def make_room(self, size: int) -> None:
        """Prepares for large messages of so many bytes, so that the first one is not late."""

    def subscribe(self, pattern: str, deliver: Deliver) -> Callable[[], None]:
        """Calls `deliver(key, packet)` from another thread for every packet that arrives, until what this
        returns is called."""

    def remember(self, pattern: str, kept: Mapping[str, Packet]) -> None:
        """Gives others who ask for `last` what is in `kept`, by key, at that time."""

    def last(self, pattern: str, timeout: float) -> list[tuple[str, Packet]]:
        """What those who remember give, at once when nobody does."""

    def has_readers(self, key: str, *, large: bool) -> bool:
        """Whether somebody subscribes to the key, to which such messages will be put."""

    def serve(self, pattern: str, deliver: Callable[[str, Packet, Reply], None]) -> None:
        """Calls `deliver(key, question, reply)` from another thread for every question."""

    def ask(self, key: str, packet: Packet, timeout: float) -> Packet:
        """The first answer; raises NoAnswer."""

    def declare_alive(self, key: str) -> None:
        """Lets others see this process until it closes or dies."""

    def watch_alive(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """Calls `changed(key, alive)` from another thread for those alive now, and on changes."""

    def close(self) -> None:
        """Ends everything; safe to call twice."""


class Reader(Generic[T]):
    """A subscription; iterating gives valid messages and ends when the process is asked to stop.

    In a `with` statement it ends with that.

    What was sent, from the first to the last message that arrived of each publisher, equals what was read
    plus `passed_over`, `lost`, `refused` and what still waits.
    """

    def __init__(self, bus: Bus, topic: Topic[T], depth: int, *, at_leisure: bool = False):
        self.unsubscribe: Callable[[], None] = lambda: None
        """Ends it; nothing more arrives."""
        self.topic = topic
        self.at_leisure = at_leisure
        """Whether the process goes on as it should while messages wait."""
        self._bus = bus
        self._inbox: Inbox[tuple[str, Packet, int]] = Inbox(bus.stop, depth)
        self.expected: dict[tuple[str, str], int] = {}
        """Number of the next message, by key and publisher."""
        self.arrived_ns = 0
        """When the message that was read last had arrived, by `time.monotonic_ns`."""
        self.lost = 0
        """Messages that were sent and did not arrive, by the gaps in their numbers."""
        self.refused = 0
        """Bad messages."""

    @property
    def passed_over(self) -> int:
        """Messages that had to make room for newer ones."""
        return self._inbox.given_up

    @property
    def waiting(self) -> int:
        """Messages that have arrived and were not read yet."""
        return len(self._inbox)

    @property
    def dropped(self) -> int:
        """Messages that were sent and never read, bad ones aside."""
        return self.lost + self.passed_over

    def deliver(self, key: str, packet: Packet) -> None:
        """Takes a packet from the transport."""
        try:
            header = wire.decode_header(packet)
        except WireError as error:
            self.refuse(f"{key}: {error}")
            return
        sender = (key, header.publisher)
        if len(self.expected) >= _MOST_PUBLISHERS and sender not in self.expected:
            self.expected.clear()
        gap = header.number - self.expected.get(sender, header.number)
        if not 0 <= gap <= _LONGEST_GAP:
            gap = 0
        if gap and self.topic.keep == "every":
            self._bus.complain(f"{gap} messages on {key} were lost on the way")
        self.lost += gap
        self.expected[sender] = header.number + 1
        self._inbox.put((key, packet, time.monotonic_ns()))

    def get(self, timeout: float | None = None) -> T | None:
        """The next valid message; None after `timeout` seconds without one, or when stopped."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            item = self._inbox.get(left)
            if item is None:
                return None
            key, packet, self.arrived_ns = item
            try:
                return self._bus.open(self.topic, key, packet)
            except WireError as error:
                self.refuse(f"{key}: {error}")

    def refuse(self, reason: str) -> None:
        """Counts and reports a bad message."""
        self.refused += 1
        self._bus.complain(f"refused a message: {reason}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.unsubscribe()

    def __iter__(self) -> Iterator[T]:
        while (message := self.get()) is not None:
            yield message


class Request(Generic[Q, A]):
    """A question that waits for its answer."""

    def __init__(self, question: Q, reply: Callable[[A], None]):
        self.question = question
        self.answer = reply
        """Sends the answer; to be called once."""


class Bus:
    """One process's connection to a rig."""

    def __init__(
        self,
        transport: Transport,
        rig: str,
        process: str,
        complain: Callable[[str], None] = lambda _: None,
    ):
        self.stop = Stop()
        self.rig = rig
        self.process = process
        self.complain = complain
        self.readers: list[Reader[Any]] = []
        self.refused_questions = 0
        self.refused_kept = 0
        self._transport = transport
        self._root = topics.root(rig)
        self._publisher = f"{process}-{uuid.uuid4().hex[:8]}"
        self._numbers: defaultdict[str, int] = defaultdict(int)
        self._alive: set[str] | None = None

    @property
    def dropped(self) -> int:
        """Frames and fields that were sent to this process and never read."""
        return sum(r.dropped for r in self.readers if r.topic.keep == "newest")

    @property
    def newest_waits(self) -> bool:
        """Whether a frame or field has arrived that the process should take and has not taken yet."""
        return any(r.waiting for r in self.readers if r.topic.keep == "newest" and not r.at_leisure)

    @property
    def refused(self) -> int:
        """Bad messages and questions so far."""
        refused = self.refused_questions + self.refused_kept
        return refused + sum(reader.refused for reader in self.readers)

    def publish(self, topic: Topic[T], message: T) -> None:
        """Sends a message to everyone who reads the topic now; waits for nobody."""
        key = f"{self._root}/{topics.key_of(topic, message)}"
        number = self._numbers[key]
        self._numbers[key] += 1
        packet = wire.encode(message, self._publisher, number, time.time_ns())
        self._transport.put(key, packet, large=_is_large(topic))

    def make_room(self, example: object) -> None:
        """Prepares for images or fields like this one, so that the first one is not late."""
        self._transport.make_room(len(wire.encode(example).payload))

    def newest(self, topic: Topic[T], *, at_leisure: bool = False) -> Reader[T]:
        """Reads the newest message each time, passing over those that came in between."""
        return self._read(topic, 1, at_leisure=at_leisure)

    def every(self, topic: Topic[T]) -> Reader[T]:
        """Reads every message in order."""
        return self._read(topic, DEPTH)

    def keep(
        self, topic: Topic[T], replaces: Callable[[T, T], bool] = lambda _new, _kept: True
    ) -> None:
        """Remembers a message of every key, for others to have by `last`: the last that replaces its own."""
        pattern = f"{self._root}/{topics.pattern_of(topic)}"
        kept: dict[str, Packet] = {}
        opened: dict[str, T] = {}

        def deliver(key: str, packet: Packet) -> None:
            try:
                message = self.open(topic, key, packet)
            except WireError as error:
                self.refused_kept += 1
                self.complain(f"refused a message: {key}: {error}")
                return
            if replaces(message, opened[key]) if key in kept else len(kept) < _MOST_KEPT:
                kept[key], opened[key] = packet, message

        self._transport.subscribe(pattern, deliver)
        self._transport.remember(pattern, kept)

    def last(self, topic: Topic[T], timeout: float = 1.0) -> list[T]:
        """The last message of every key, as its keeper remembers it."""
        pattern = f"{self._root}/{topics.pattern_of(topic)}"
        found = []
        for key, packet in self._transport.last(pattern, timeout):
            try:
                found.append(self.open(topic, key, packet))
            except WireError as error:
                self.complain(f"refused what was remembered: {key}: {error}")
        return found

    def wait_for_readers(self, topic: Topic[Any], timeout: float | None = None) -> bool:
        """Waits for the first reader of a topic; False after the time-out or when stopped."""
        key = f"{self._root}/{topics.pattern_of(topic)}"
        large = _is_large(topic)
        return self._wait(lambda: self._transport.has_readers(key, large=large), timeout)

    def ask(self, question: Question[Q, A], content: Q, timeout: float) -> A:
        """Asks and waits for the answer.

        Raises:
            NoAnswer: nobody there, no answer in time, or a refusal.
        """
        key = f"{self._root}/{topics.key_of(question, content)}"
        packet = self._transport.ask(key, wire.encode(content, self._publisher), timeout)
        try:
            return wire.decode(packet, question.answer)[0]
        except WireError as error:
            raise BadAnswer(f"{question.server} sent a bad answer: {error}") from error

    def ask_until_answered(self, question: Question[Q, A], content: Q) -> A | None:
        """Asks again until there is a good answer; None when stopped."""
        answers: list[A] = []

        def answered() -> bool:
            try:
                answers.append(self.ask(question, content, timeout=1.0))
            except BadAnswer as error:
                self.complain(str(error))
                return False
            except NoAnswer:
                return False
            return True

        return answers[0] if self._wait(answered, None) else None

    def requests(self, question: Question[Q, A]) -> Inbox[Request[Q, A]]:
        """The questions that come in, to be answered one by one."""
        inbox: Inbox[Request[Q, A]] = Inbox(self.stop, DEPTH)

        def deliver(key: str, packet: Packet, reply: Reply) -> None:
            try:
                content = self.open(question, key, packet)
            except WireError as error:
                self.refused_questions += 1
                self.complain(f"refused a question on {key}: {error}")
                reply(str(error))
            else:
                inbox.put(Request(content, lambda answer: reply(wire.encode(answer))))

        self._transport.serve(f"{self._root}/{topics.pattern_of(question)}", deliver)
        return inbox

    def answer(self, question: Question[Q, A], function: Callable[[Q], A]) -> None:
        """Answers a question by a quick function, beside the process's own loop."""
        requests = self.requests(question)

        def loop() -> None:
            for request in requests:
                request.answer(function(request.question))

        threading.Thread(target=loop, name=f"answer {question.key}", daemon=True).start()

    def declare_alive(self) -> None:
        """Lets others see that this process is ready."""
        self._transport.declare_alive(f"{self._root}/{topics.alive(self.process)}")

    def wait_for_alive(self, process: str, timeout: float | None = None) -> bool:
        """Waits until a process is ready; False after the time-out or when stopped."""
        return self._wait(lambda: process in self.alive(), timeout)

    def alive(self) -> set[str]:
        """Names of the processes that are ready; the first call starts to look for them."""
        if self._alive is None:
            found = self._alive = set()
            self._transport.watch_alive(
                f"{self._root}/{topics.alive('*')}",
                lambda key, alive: (found.add if alive else found.discard)(key.rsplit("/", 1)[1]),
            )
        return set(self._alive)

    def close(self) -> None:
        """Ends every loop and the connection."""
        self.stop.set()
        self._transport.close()

    def open(self, topic: Topic[T] | Question[T, Any], key: str, packet: Packet) -> T:
        """The message in a packet; raises WireError."""
        message, _ = wire.decode(packet, topic.kind)
        if key != f"{self._root}/{topics.key_of(topic, message)}":
            raise WireError("the key names something else than the message")
        return message

    def _read(self, topic: Topic[T], depth: int, *, at_leisure: bool = False) -> Reader[T]:
        reader = Reader(self, topic, depth, at_leisure=at_leisure)
        self.readers.append(reader)
        pattern = f"{self._root}/{topics.pattern_of(topic)}"
        end = self._transport.subscribe(pattern, reader.deliver)

        def unsubscribe() -> None:
            end()
            self.readers.remove(reader)

        reader.unsubscribe = unsubscribe
        return reader

    def _wait(self, condition: Callable[[], bool], timeout: float | None) -> bool:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not condition():
            late = deadline is not None and time.monotonic() >= deadline
            if late or self.stop.wait(_POLL_S):
                return False
        return True


def _is_large(topic: Topic[Any]) -> bool:
    """Whether messages go through shared memory and give way to all others: images and fields."""
    return topic.keep == "newest"

"""Packets within one process: the twin of the Zenoh transport for tests and for trying things out."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping

from services.bus import Deliver, NoAnswer, Reply
from services.wire import Packet

Changed = Callable[[str, bool], None]


class Hub:
    """What the transports of one process have in common."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.transports: list[MemoryTransport] = []

    def connect(self) -> MemoryTransport:
        """A transport that reaches all others of the hub."""
        transport = MemoryTransport(self)
        with self.lock:
            self.transports.append(transport)
        return transport


class MemoryTransport:
    """A `services.bus.Transport` that calls the others of its hub."""

    def __init__(self, hub: Hub):
        self._hub = hub
        self.subscriptions: list[tuple[str, Deliver]] = []
        self.services: list[tuple[str, Callable[[str, Packet, Reply], None]]] = []
        self.remembered: list[tuple[str, Mapping[str, Packet]]] = []
        self.watchers: list[tuple[str, Changed]] = []
        self.alive: list[str] = []

    def put(self, key: str, packet: Packet, *, large: bool) -> None:
        """See `Transport`."""
        del large
        for transport in self._others():
            for pattern, deliver in transport.subscriptions:
                if _matches(pattern, key):
                    deliver(key, packet)

    def make_room(self, size: int) -> None:
        """See `Transport`."""

    def subscribe(self, pattern: str, deliver: Deliver) -> Callable[[], None]:
        """See `Transport`."""
        subscription = pattern, deliver
        self.subscriptions.append(subscription)
        return lambda: self.subscriptions.remove(subscription)

    def remember(self, pattern: str, kept: Mapping[str, Packet]) -> None:
        """See `Transport`."""
        self.remembered.append((pattern, kept))

    def last(self, pattern: str, timeout: float) -> list[tuple[str, Packet]]:
        """See `Transport`."""
        del timeout
        kept = [k for t in self._others() for p, k in t.remembered if p == pattern]
        return [item for mapping in kept for item in mapping.items()]

    def has_readers(self, key: str, *, large: bool) -> bool:
        """See `Transport`."""
        del large
        return any(_matches(p, key) for t in self._others() for p, _ in t.subscriptions)

    def serve(self, pattern: str, deliver: Callable[[str, Packet, Reply], None]) -> None:
        """See `Transport`."""
        self.services.append((pattern, deliver))

    def ask(self, key: str, packet: Packet, timeout: float) -> Packet:
        """See `Transport`."""
        servers = [d for t in self._others() for p, d in t.services if _matches(p, key)]
        if not servers:
            raise NoAnswer(f"nobody answers {key}")
        answers: list[Packet | str] = []
        arrived = threading.Event()

        def reply(answer: Packet | str) -> None:
            answers.append(answer)
            arrived.set()

        servers[0](key, packet, reply)
        if not arrived.wait(timeout):
            raise NoAnswer(f"no answer on {key} within {timeout:g} s")
        if isinstance(answers[0], str):
            raise NoAnswer(answers[0])
        return answers[0]

    def declare_alive(self, key: str) -> None:
        """See `Transport`."""
        self.alive.append(key)
        self._tell(key, alive=True)

    def watch_alive(self, pattern: str, changed: Changed) -> None:
        """See `Transport`."""
        self.watchers.append((pattern, changed))
        for transport in self._others():
            for key in transport.alive:
                if _matches(pattern, key):
                    changed(key, True)

    def close(self) -> None:
        """See `Transport`."""
        with self._hub.lock:
            if self not in self._hub.transports:
                return
            self._hub.transports.remove(self)
        for key in self.alive:
            self._tell(key, alive=False)

    def _others(self) -> list[MemoryTransport]:
        with self._hub.lock:
            return [t for t in self._hub.transports if t is not self]

    def _tell(self, key: str, *, alive: bool) -> None:
        for transport in self._others():
            for pattern, changed in transport.watchers:
                if _matches(pattern, key):
                    changed(key, alive)


def _matches(pattern: str, key: str) -> bool:
    return re.fullmatch(re.escape(pattern).replace(r"\*", "[^/]+"), key) is not None

"""Packets over Zenoh.

By default the processes of a rig are peers on this machine: each of the processes that all others
need listens on a Unix socket of its own in a directory private to the user, and everyone connects to
the sockets of those that stand before it in `LISTENERS`, trying again until they are there. So they
start in any order, and nothing can be reached from another machine. A Zenoh configuration file
replaces all of this.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import zenoh
from zenoh.shm import GarbageCollect, ShmProvider, ZShmMut

from services.bus import Deliver, NoAnswer, Reply
from services.wire import Packet, WireError
from services.zenoh_session import Session, configured
from suturetrack.types import InputError

LISTENERS = ("source", "segmenter", "tracker", "run")
_LONGEST_SOCKET_PATH = 107
_CLOSED = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "listen/endpoints": [],
    "transport/shared_memory/enabled": True,
    "transport/shared_memory/mode": "init",
    "transport/shared_memory/transport_optimization/enabled": False,
}
"""A peer that is connected to nobody."""
_POOLED = 8
"""Messages of one publisher that fit into its shared memory at the same time."""
_LARGEST_MESSAGE = 256 << 20
_ROUTER_MS = 3000
"""How long a router may take to answer those who do not wait for it."""
_NOTICE_S = 2.0
"""After this time those who wait say so."""

log = logging.getLogger("suturetrack")


def socket_directory(rig: str) -> Path:
    """The directory that holds the sockets of a rig; made when it is not there.

    Raises:
        InputError: it cannot be made, or others could reach into it.
    """
    return _private(socket_root() / rig)


def socket_root() -> Path:
    """The directory above those of all rigs; made, and refused, as these."""
    return _private(_root())


def _private(directory: Path) -> Path:
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise InputError(f"no directory for sockets: {error}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise InputError(f"{directory} belongs to somebody else; remove it")
    if found.st_mode & 0o077:
        raise InputError(f"others may enter {directory}; run: chmod 700 {directory}")
    return directory


def local_rigs() -> list[str]:
    """Names of the rigs of which processes of this user listen on this machine."""
    return sorted({path.parent.name for path in _root().glob("*/*.sock")})


def remove_sockets(rig: str) -> None:
    """Removes the sockets that killed processes of a rig left behind; no process of it may run."""
    directory = socket_directory(rig)
    for path in directory.iterdir():
        path.unlink(missing_ok=True)
    directory.rmdir()


def _root() -> Path:
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    if runtime.is_absolute() and os.access(runtime, os.W_OK):
        return runtime / "suturetrack"
    return Path(f"/tmp/suturetrack-{os.getuid()}")


def local_config(rig: str, process: str) -> zenoh.Config:
    """The default: peers on this machine only, over Unix sockets and shared memory.

    Only who listens makes the directory of the rig, so that asking for one that is not there leaves nothing.
    """
    directory = socket_directory(rig) if process in LISTENERS else socket_root() / rig

    def endpoint(name: str) -> str:
        path = directory / f"{name}.sock"
        if len(str(path)) > _LONGEST_SOCKET_PATH:
            raise InputError(f"rig {rig!r}: the socket's path {path} is too long; use a short name")
        return f"unixsock-stream/{path}"

    place = LISTENERS.index(process) if process in LISTENERS else len(LISTENERS)
    settings = {
        **_CLOSED,
        "listen/endpoints": [endpoint(process)] if process in LISTENERS else [],
        "connect/endpoints": [endpoint(name) for name in LISTENERS[:place]],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 200,
            "period_increase_factor": 2,
        },
        # Longer than any greeting takes; closing waits for one to a process that stands still.
        "transport/unicast/open_timeout": 2000,
        "transport/link/rx/max_message_size": _LARGEST_MESSAGE,
        # Room for hundreds of states, so that none is dropped while a machine is short of time.
        "transport/link/tx/queue/size/interactive_high": 16,
    }
    return configured(settings)


def load_config(path: Path) -> zenoh.Config:
    """A Zenoh configuration file; raises InputError."""
    if not path.is_file():
        raise InputError(f"zenoh: no file {path}")
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise InputError(f"zenoh {path}: {_fault(str(error))}") from error


def sweep_shared_memory() -> None:
    """Removes the shared memory of processes that have ended; Zenoh does so when it opens."""
    zenoh.open(configured(_CLOSED)).close()  # type: ignore[no-untyped-call]


class ZenohTransport:
    """A `services.bus.Transport` over a Zenoh session.

    Args:
        config: where to listen and to connect.
        patient: nothing may be lost, for lock-step: wait for slow readers instead of dropping what
            they cannot take, and leave out the shared memory, which is taken back from stalled ones.
        shares: whether images and fields go through shared memory.
        waits: for a router that is not there yet, without end; else that is an error within seconds.

    Raises:
        InputError: the session cannot be opened.
    """

    def __init__(
        self,
        config: zenoh.Config,
        *,
        patient: bool = False,
        shares: bool = True,
        waits: bool = True,
    ):
        if not waits and _is_client(config):
            config.insert_json5("connect/timeout_ms", str(_ROUTER_MS))
        try:
            with _noticed(config, waits=waits):
                self._session = Session(config)
        except zenoh.ZError as error:
            raise InputError(explain(error, config)) from error
        self._patient = patient
        self._shares = shares and not patient
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._pool: ShmProvider | None = None
        self._pooled_size = 0

    def put(self, key: str, packet: Packet, *, large: bool) -> None:
        """See `Transport`."""
        payload = bytes(packet.payload)
        content = self._share(payload) if large else payload
        publisher = self._publisher(key, large=large)
        publisher.put(content, encoding=packet.encoding, attachment=packet.attachment)

    def make_room(self, size: int) -> None:
        """See `Transport`."""
        if not self._shares or size <= self._pooled_size:
            return
        self._pooled_size = size
        self._pool = _make_pool(size)

    def subscribe(self, pattern: str, deliver: Deliver) -> Callable[[], None]:
        """See `Transport`."""

        def arrived(sample: zenoh.Sample) -> None:
            deliver(str(sample.key_expr), _packet(sample))

        return self._session.keep(lambda session: session.declare_subscriber(pattern, arrived))

    def remember(self, pattern: str, kept: Mapping[str, Packet]) -> None:
        """See `Transport`."""

        def arrived(query: zenoh.Query) -> None:
            with query:
                for key, packet in list(kept.items()):
                    if query.key_expr.intersects(zenoh.KeyExpr(key)):
                        _reply(query, key, packet)

        self._session.keep(lambda session: session.declare_queryable(pattern, arrived))

    def last(self, pattern: str, timeout: float) -> list[tuple[str, Packet]]:
        """See `Transport`."""
        replies = self._session.zenoh.get(pattern, timeout=timeout)
        return [(str(r.ok.key_expr), _packet(r.ok)) for r in replies if r.ok is not None]

    def has_readers(self, key: str, *, large: bool) -> bool:
        """See `Transport`."""
        status: Any = self._publisher(key, large=large).matching_status  # its stub says bool
        return bool(status.matching)

    def serve(self, pattern: str, deliver: Callable[[str, Packet, Reply], None]) -> None:
        """See `Transport`."""

        def arrived(query: zenoh.Query) -> None:
            key = str(query.key_expr)

            def reply(answer: Packet | str) -> None:
                with query:
                    if isinstance(answer, str):
                        query.reply_err(answer)
                    else:
                        _reply(query, key, answer)

            deliver(key, _packet(query), reply)

        self._session.keep(lambda session: session.declare_queryable(pattern, arrived))

    def ask(self, key: str, packet: Packet, timeout: float) -> Packet:
        """See `Transport`."""
        replies = self._session.zenoh.get(
            key,
            payload=packet.payload,
            encoding=packet.encoding,
            attachment=packet.attachment,
            timeout=timeout,
        )
        refusal = f"nobody answers {key}"
        for reply in replies:
            if reply.ok is not None:
                return _packet(reply.ok)
            if reply.err is not None:
                refusal = str(reply.err.payload)
        raise NoAnswer(refusal)

    def declare_alive(self, key: str) -> None:
        """See `Transport`."""
        self._session.keep(lambda session: session.liveliness().declare_token(key))

    def watch_alive(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """See `Transport`."""

        def arrived(sample: zenoh.Sample) -> None:
            changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._session.keep(
            lambda session: session.liveliness().declare_subscriber(pattern, arrived, history=True)
        )

    def close(self) -> None:
        """See `Transport`."""
        self._session.close()

    def _share(self, payload: bytes) -> bytes | ZShmMut:
        """The payload in shared memory; itself where there is none, or no room in it."""
        self.make_room(len(payload))
        if self._pool is None:
            return payload
        try:
            buffer = self._pool.alloc(len(payload), policy=GarbageCollect())
        except zenoh.ZError:
            return payload
        buffer[:] = payload
        return buffer

    def _publisher(self, key: str, *, large: bool) -> zenoh.Publisher:
        if key not in self._publishers:
            control, priority = zenoh.CongestionControl, zenoh.Priority
            self._publishers[key] = self._session.zenoh.declare_publisher(
                key,
                congestion_control=control.BLOCK if self._patient else control.DROP,
                priority=priority.DATA if large else priority.INTERACTIVE_HIGH,
                reliability=zenoh.Reliability.RELIABLE,
            )
        return self._publishers[key]


def _make_pool(size: int) -> ShmProvider | None:
    """Shared memory for `_POOLED` messages of a size; None where there is not enough."""
    try:
        if shutil.disk_usage("/dev/shm").free < 2 * _POOLED * size:
            return None
        pool = ShmProvider.default_backend(_POOLED * size)
        # Writing to the memory once makes the system provide it now and not with the first frames.
        for buffer in [pool.alloc(size) for _ in range(_POOLED - 1)]:
            buffer[:] = bytes(size)
    except (OSError, zenoh.ZError):
        return None
    return pool


class ArrivedPayload:
    """The content of a message, read out of shared memory when it is asked for."""

    def __init__(self, content: zenoh.ZBytes):
        self._content = content

    @property
    def is_shared(self) -> bool:
        """Whether it came through shared memory."""
        return self._content.as_shm() is not None

    def __len__(self) -> int:
        return len(self._content)

    def __bytes__(self) -> bytes:
        data = self._content.to_bytes()
        shared = self._content.as_shm()
        # The sender takes its memory back from a reader that has stalled for too long.
        if shared is not None and not shared.is_valid():
            raise WireError("it was read too late: its shared memory had been taken back")
        return data


def _reply(query: zenoh.Query, key: str, packet: Packet) -> None:
    payload = bytes(packet.payload)
    query.reply(key, payload, encoding=packet.encoding, attachment=packet.attachment)


def _packet(message: zenoh.Sample | zenoh.Query) -> Packet:
    payload, attachment = message.payload, message.attachment
    return Packet(
        str(message.encoding),
        b"" if payload is None else ArrivedPayload(payload),
        b"" if attachment is None else attachment.to_bytes(),
    )


def explain(error: zenoh.ZError, config: zenoh.Config) -> str:
    """What went wrong when a session was opened, on one line."""
    text = _first_line(str(error))
    if "Unable to connect" in text and _is_client(config):
        where = endpoints(config, "connect")
        return f"no router answers at {where}; start it with `suturetrack router --zenoh FILE`"
    if "Unable to acquire lock" in text:
        socket = Path(text.partition(" listener on ")[2].partition(" - ")[0])
        return (
            f"rig {socket.parent.name!r}: a process named {socket.stem!r} is running already; "
            "stop it, or give another --rig"
        )
    return f"zenoh: {text}"


def endpoints(config: zenoh.Config, side: Literal["listen", "connect"]) -> str:
    """Where a session listens, or what it connects to, for people."""
    given = json.loads(config.get_json(f"{side}/endpoints"))
    mode = json.loads(config.get_json("mode"))
    return ", ".join(map(str, given.get(mode, []) if isinstance(given, dict) else given))


@contextmanager
def _noticed(config: zenoh.Config, *, waits: bool) -> Iterator[None]:
    """Logs whom this waits for, unless the router answers soon."""
    words = "waiting for the router at %s", endpoints(config, "connect")
    notice = threading.Timer(_NOTICE_S, log.warning, words)
    notice.daemon = True
    if waits and _is_client(config):
        notice.start()
    try:
        yield
    finally:
        notice.cancel()


def _is_client(config: zenoh.Config) -> bool:
    return bool(json.loads(config.get_json("mode")) == "client")


def _fault(text: str) -> str:
    """What Zenoh finds wrong in a configuration file, on one line."""
    syntax = re.match(r" *--> (\d+):(\d+)", text)
    if syntax is not None:
        return f"not valid JSON5 at line {syntax[1]}, column {syntax[2]}"
    entry = re.search(r'msg: "(.*)", location: Some\(Location { line: (\d+), column: (\d+)', text)
    if entry is not None:
        reason = entry[1].replace('\\"', '"').partition(" at /")[0]
        return f"line {entry[2]}, column {entry[3]}: {reason}"
    return _first_line(text)


def _first_line(text: str) -> str:
    return text.splitlines()[0].partition(" at /")[0]

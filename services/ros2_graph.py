"""A node of a ROS 2 graph whose middleware is rmw_zenoh, without ROS.

Forms are those of rmw_zenoh's design document and of its sources (liveliness_utils, attachment_helpers)
as of ROS 2 Jazzy and later:

- data key: `<domain>/<topic>/<pkg>::msg::dds_::<Type>_/<type hash>`, payload CDR;
- attachment, without which a sample is ignored: sequence number and time (int64, little endian), then
  the length 16 and the gid of the publisher;
- liveliness token of a node: `@ros2_lv/<domain>/<zid>/<node>/<node>/NN/%/%/<name>`; of a publisher (MP)
  or a subscription (MS): `@ros2_lv/<domain>/<zid>/<node>/<entity>/MP/%/%/<name>/<topic with % for
  />/<type>/<type hash>/<qos>`.

Type hashes (RIHS01) are computed by rosbags from the definitions of Jazzy. Not tried with real ROS: that
`ros2 topic list` and `echo` show what is published here. The gid is a hash of the token as in
rmw_zenoh, but another hash: messages are told apart by it, yet it is not the one that
`ros2 topic info -v` derives from the token.
"""

from __future__ import annotations

import hashlib
import re
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from services.zenoh_session import Session, configured
from suturetrack.types import InputError

TYPES = get_typestore(Stores.ROS2_JAZZY)
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_KEEP_LAST_10 = "::,10:,:,:,,"
"""Quality of service: reliable, volatile, the last ten; what is default is left out."""
_LARGEST_DOMAIN = 232
_ATTACHMENT = struct.Struct("<qqB16s")


@dataclass(frozen=True)
class RosConfig:
    """The ROS 2 graph."""

    router: str = "tcp/localhost:7447"
    """Endpoint of the Zenoh router (`ros2 run rmw_zenoh_cpp rmw_zenohd`)."""
    domain: int = 0
    """ROS_DOMAIN_ID."""


class RosNode:
    """A node with publishers and subscriptions, seen by others until it is closed.

    Raises:
        InputError: there is no router, or the domain is none.
    """

    def __init__(self, name: str, config: RosConfig):
        if not 0 <= config.domain <= _LARGEST_DOMAIN:
            raise InputError(f"domain {config.domain}: use ROS_DOMAIN_ID, 0 to {_LARGEST_DOMAIN}")
        self._domain, self._name = config.domain, name
        self._session = _open(config.router)
        self._entities = 0
        self._declare(f"{self._prefix(0)}/NN/%/%/{name}")

    def publisher(self, topic: str, kind: str) -> RosPublisher:
        """Announces a topic, such as "/a/b", of a type such as "std_msgs/msg/String"."""
        token = self._announce("MP", topic, kind)
        publisher = self._session.zenoh.declare_publisher(
            _key(self._domain, topic, kind),
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE,
        )
        return RosPublisher(publisher, kind, token)

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], bad: Callable[[str], None]
    ) -> None:
        """Calls `take(message)` from another thread, and `bad(reason)` for what is no message."""
        self._announce("MS", topic, kind)

        def arrived(sample: zenoh.Sample) -> None:
            try:
                message = TYPES.deserialize_cdr(sample.payload.to_bytes(), kind)
            except (SerdeError, IndexError, AssertionError) as error:
                bad(f"topic {topic}: {str(error).partition(chr(10))[0] or 'not CDR'}")
            else:
                take(message)

        # Any hash: what matters is whether the bytes can be read.
        key = f"{_key(self._domain, topic, kind).rpartition('/')[0]}/*"
        self._session.keep(lambda session: session.declare_subscriber(key, arrived))

    def close(self) -> None:
        """Leaves the graph; safe to call twice."""
        self._session.close()

    def _announce(self, entity: str, topic: str, kind: str) -> str:
        if not _TOPIC.fullmatch(topic):
            raise InputError(f"topic {topic!r}: ROS topics are like /rig/left/image_raw")
        self._entities += 1
        place = f"{self._prefix(self._entities)}/{entity}/%/%/{self._name}"
        named = f"{topic.replace('/', '%')}/{_dds_name(kind)}/{TYPES.hash_rihs01(kind)}"
        token = f"{place}/{named}/{_KEEP_LAST_10}"
        self._declare(token)
        return token

    def _declare(self, token: str) -> None:
        self._session.keep(lambda session: session.liveliness().declare_token(token))

    def _prefix(self, entity: int) -> str:
        return f"@ros2_lv/{self._domain}/{self._session.zenoh.info.zid()}/0/{entity}"


class RosPublisher:
    """One announced topic."""

    def __init__(self, publisher: zenoh.Publisher, kind: str, token: str):
        self._publisher, self._kind = publisher, kind
        self._gid = hashlib.blake2b(token.encode(), digest_size=16).digest()
        self._sequence = 0
        self._lock = threading.Lock()

    def publish(self, message: object) -> None:
        """Sends a message of the publisher's type."""
        with self._lock:
            self._sequence += 1
            attachment = _ATTACHMENT.pack(self._sequence, time.time_ns(), 16, self._gid)
        payload = bytes(TYPES.serialize_cdr(message, self._kind, little_endian=True))
        self._publisher.put(payload, attachment=attachment)


def new(kind: str, **fields: Any) -> Any:
    """A message of a type; what is left out is zero, empty or false, as in ROS."""
    message = TYPES.types[kind]
    return message(
        **{
            name: fields[name] if name in fields else _zero(*description)
            for name, description in TYPES.fielddefs[kind][1]
        }
    )


def _zero(node: Nodetype, details: Any) -> Any:
    if node == Nodetype.NAME:
        return new(details)
    if node == Nodetype.BASE:
        return {"string": "", "bool": False}.get(details[0], 0)
    (element, kind), length = details
    if element == Nodetype.BASE and kind[0] != "string":
        size = length if node == Nodetype.ARRAY else 0
        return np.zeros(size, "uint8" if kind[0] in ("byte", "char") else kind[0])
    return []


def _key(domain: int, topic: str, kind: str) -> str:
    return f"{domain}/{topic.strip('/')}/{_dds_name(kind)}/{TYPES.hash_rihs01(kind)}"


def _dds_name(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def _open(router: str) -> Session:
    settings = {
        "mode": "client",
        "connect/endpoints": [router],
        "connect/timeout_ms": 3000,
        "scouting/multicast/enabled": False,
    }
    try:
        return Session(configured(settings))
    except zenoh.ZError as error:
        raise InputError(
            f"no ROS 2 graph at {router}; start its router (ros2 run rmw_zenoh_cpp rmw_zenohd), or "
            "give another endpoint"
        ) from error

"""ROS 1 bags, ROS 2 bags (sqlite3 and MCAP), and single MCAP files."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from services.sources.footage import Exposure, check_pair, size_of
from services.sources.pairing import (
    Pair,
    Pairing,
    camera_info_topic,
    is_rectified_topic,
    rate_of,
    stereo_topics,
)
from services.sources.ros_image import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    decode,
    rig_of_messages,
    stamp_ns,
)
from suturetrack.camera import StereoRig
from suturetrack.types import InputError

_LOOKED_AT = 30
"""Pairs at the beginning that tell the frame rate."""
_LONGEST_WAIT = 400
"""Images without a pair before the stamps are blamed."""


def is_bag(path: Path) -> bool:
    """Whether a path names a bag: a .bag, .mcap or .db3 file, or a folder with metadata.yaml."""
    return path.suffix in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


@dataclass(frozen=True)
class _Raw:
    connection: Connection
    data: bytes


class BagFootage:
    """Pairs of images whose stamps agree; the time is that of their headers.

    Args:
        path: the bag.
        topics: the image topics, (left, right); found by their names when None.
        slop_ns: how far the stamps of a pair may lie apart.
        fps: the rate of a bag with a single pair.

    Raises:
        InputError: no bag, no such topics, or stamps that do not pair.
    """

    live = False
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(self, path: Path, topics: tuple[str, str] | None, slop_ns: int, fps: float):
        self._where = f"source {path}"
        self._slop_ns = slop_ns
        self._reader = _open(path)
        try:
            images = [c.topic for c in self._reader.connections if c.msgtype in (IMAGE, COMPRESSED)]
            try:
                self.topics = stereo_topics(set(images), topics)
            except InputError as error:
                raise InputError(f"{self._where}: {error}") from error
            stamps = [p.stamp_ns for p in itertools.islice(self._pairs(), _LOOKED_AT)]
            self.fps = rate_of(stamps, fps)
            self.frame_count: int | None = None
            self.rectified = is_rectified_topic(self.topics[0])
            self._rest = self._pairs()
            self._next = 0
            self._first = self._decode(next(self._rest))
        except BaseException:
            self._reader.close()
            raise
        self.size = size_of(self._first.left)

    def rig(self, unit: str | None) -> StereoRig:
        """The rig of the camera_info topics beside the images; raises InputError."""
        infos = []
        for topic in self.topics:
            name = camera_info_topic(topic)
            connections = [c for c in self._reader.connections if c.topic == name]
            messages = self._messages([c for c in connections if c.msgtype == CAMERA_INFO])
            found = next(messages, None)
            if found is None:
                raise InputError(
                    f"{self._where}: no camera_info on {name}; give --calibration FILE"
                )
            infos.append(self._open(found[1]))
        return rig_of_messages(infos[0], infos[1], unit, f"{self._where}: camera_info")

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
        if index == 0:
            return self._first
        pair = next(itertools.islice(self._rest, index - self._next - 1, None), None)
        self._next = index
        return None if pair is None else self._decode(pair)

    def close(self) -> None:
        """See `Footage`."""
        self._reader.close()

    def _decode(self, pair: Pair[_Raw]) -> Exposure:
        sides = pair.left, pair.right
        left, right = (decode(self._open(raw), raw.connection.topic) for raw in sides)
        check_pair(left, right, self._where)
        return Exposure(pair.stamp_ns, left, right, skipped=pair.skipped)

    def _pairs(self) -> Iterator[Pair[_Raw]]:
        pairing: Pairing[_Raw] = Pairing(self._slop_ns)
        paired = False
        wanted = [c for c in self._reader.connections if c.topic in self.topics]
        for count, (received_ns, raw) in enumerate(self._messages(wanted)):
            right = raw.connection.topic == self.topics[1]
            # Some drivers leave the stamp at zero.
            pair = pairing.add(right, stamp_ns(self._open(raw)) or received_ns, raw)
            if pair is not None:
                paired = True
                yield pair
            if not paired and count > _LONGEST_WAIT:
                break
        if not paired:
            raise InputError(f"{self._where}: {pairing.advice()}")

    def _messages(self, connections: list[Connection]) -> Iterator[tuple[int, _Raw]]:
        if not connections:
            return
        try:
            for connection, received_ns, data in self._reader.messages(connections):
                yield received_ns, _Raw(connection, data)
        except Exception as error:  # as in `_open`
            raise _unreadable(self._where, error) from error

    def _open(self, raw: _Raw) -> Any:
        try:
            return self._reader.deserialize(raw.data, raw.connection.msgtype)
        except AnyReaderError as error:
            raise InputError(f"{self._where}: {_line(error)}") from error


def _open(path: Path) -> AnyReader:
    if not path.exists():
        raise InputError(f"source {path}: no such bag")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except Exception as error:  # whatever a broken file makes the parsers raise
        raise _unreadable(f"source {path}", error) from error
    return reader


def _unreadable(where: str, error: Exception) -> InputError:
    return InputError(f"{where}: not a bag that can be read ({_line(error)})")


def _line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__

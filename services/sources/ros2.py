"""Two image topics of a ROS 2 graph, live."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Any

from services.ros2_graph import RosConfig, RosNode
from services.sources.footage import Exposure, Stalled, check_pair, size_of
from services.sources.live import STALL_S, Newest
from services.sources.pairing import Pairing, camera_info_topic, is_rectified_topic, rate_of
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

_FIRST_S = 15.0
_INFO_S = 5.0
_LOOKED_AT = 10
"""Pairs at the beginning that tell the frame rate."""


class Ros2Footage:
    """Pairs of images whose stamps agree, as they arrive; the newest pair each time.

    Args:
        topics: the left and the right one.
        ros: where the graph is.
        slop_ns: how far the stamps of a pair may lie apart.
        fps: the rate of images that come too seldom to tell it.
        wants_rig: whether `rig` will be asked for.

    Raises:
        InputError: no graph, no images, or images that do not pair.
    """

    live = True
    frame_count: int | None = None
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(
        self, topics: list[str], ros: RosConfig, slop_ns: int, fps: float, *, wants_rig: bool
    ):
        if len(topics) != 2:
            raise InputError("source ros2: give two image topics, ros2:/left/image,/right/image")
        self.topics = topics
        self.rectified = is_rectified_topic(topics[0])
        self._pairing: Pairing[Any] = Pairing(slop_ns)
        self._lock = threading.Lock()
        self._newest = Newest()
        self._infos: dict[bool, Any] = {}
        self._informed = threading.Event()
        self._node = RosNode("suturetrack_source", ros)
        try:
            self._subscribe(wants_rig=wants_rig)
            self._first = self._newest.get(_FIRST_S, self._where)
            self.fps = rate_of(self._next_stamps(self._first), fps)
        except Stalled as stall:
            self.close()
            raise InputError(
                f"{self._where}: no pair of images; {self._pairing.advice()}; is somebody publishing?"
            ) from stall
        except InputError:
            self.close()
            raise
        self.size = size_of(self._first.left)

    def rig(self, unit: str | None) -> StereoRig:
        """The rig of the camera_info topics beside the images; raises InputError."""
        if not self._informed.wait(_INFO_S):
            names = " and ".join(camera_info_topic(topic) for topic in self.topics)
            raise InputError(f"{self._where}: nothing came on {names}; give --calibration FILE")
        return rig_of_messages(self._infos[False], self._infos[True], unit, self._where)

    def read(self, index: int) -> Exposure:
        """See `Footage`."""
        if index == 0:
            return self._first
        exposure = self._newest.get(STALL_S, self._complaint())
        if size_of(exposure.left) != self.size:
            raise InputError(f"{self._where}: images are {exposure.left.shape}, were {self.size}")
        return exposure

    def close(self) -> None:
        """See `Footage`."""
        self._node.close()

    @property
    def _where(self) -> str:
        return f"source ros2:{','.join(self.topics)}"

    def _complaint(self) -> str:
        return f"{self._where}: no pair of images ({self._pairing.advice()})"

    def _next_stamps(self, first: Exposure) -> list[int]:
        stamps = [first.capture_ns]
        with suppress(Stalled):
            while len(stamps) < _LOOKED_AT:
                stamps.append(self._newest.get(STALL_S, self._where).capture_ns)
        return stamps

    def _subscribe(self, *, wants_rig: bool) -> None:
        for right, topic in enumerate(self.topics):
            kind = COMPRESSED if topic.endswith("/compressed") else IMAGE
            self._node.subscribe(topic, kind, self._taker(bool(right)), self._fail)
            if wants_rig:
                info = camera_info_topic(topic)
                self._node.subscribe(info, CAMERA_INFO, self._informer(bool(right)), self._fail)

    def _taker(self, right: bool) -> Any:
        def take(message: Any) -> None:
            with self._lock:
                pair = self._pairing.add(right, stamp_ns(message), message)
            if pair is None:
                return
            sides = pair.left, pair.right
            try:
                left, other = (decode(m, t) for m, t in zip(sides, self.topics, strict=True))
                check_pair(left, other, self._where)
            except InputError as error:
                self._newest.fail(error)
            else:
                self._newest.put(Exposure(pair.stamp_ns, left, other, skipped=pair.skipped))

        return take

    def _informer(self, right: bool) -> Any:
        def take(message: Any) -> None:
            self._infos[right] = message
            if len(self._infos) == 2:
                self._informed.set()

        return take

    def _fail(self, reason: str) -> None:
        self._newest.fail(InputError(reason))

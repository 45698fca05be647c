"""Which left and right images belong together: by topic, and by stamp."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from suturetrack.types import InputError

T = TypeVar("T")

_WAITING = 32
"""Images of one side that may wait for the other side."""


@dataclass(frozen=True)
class Pair(Generic[T]):
    """What belongs together."""

    stamp_ns: int
    """Of the left image."""
    left: T
    right: T
    skipped: int
    """Images given up since the pair before."""


class Pairing(Generic[T]):
    """Pairs two streams, each in the order of its stamps.

    Args:
        slop_ns: how far the stamps of a pair may lie apart; below half a frame's time, no image
            has two candidates.
    """

    def __init__(self, slop_ns: int):
        self._slop_ns = slop_ns
        self._waiting: tuple[deque[tuple[int, T]], deque[tuple[int, T]]] = (deque(), deque())
        self._skipped = 0
        self.closest_ns: int | None = None
        """How near to one another stamps of both sides have come."""

    def add(self, right: bool, stamp_ns: int, image: T) -> Pair[T] | None:
        """Takes an image; gives the pair that it completes."""
        mine, others = self._waiting[right], self._waiting[not right]
        if others:
            nearest = min(range(len(others)), key=lambda i: abs(others[i][0] - stamp_ns))
            apart = abs(others[nearest][0] - stamp_ns)
            self.closest_ns = min(apart, self.closest_ns) if self.closest_ns is not None else apart
            if apart <= self._slop_ns:
                return self._complete(right, stamp_ns, image, nearest)
        mine.append((stamp_ns, image))
        if len(mine) > _WAITING:
            mine.popleft()
            self._skipped += 1
        return None

    def advice(self) -> str:
        """Why there are no pairs, and what would help."""
        if self.closest_ns is None:
            return "at most one of the two sides sends images"
        if self.closest_ns <= self._slop_ns:
            return "they used to come"
        apart, slop = self.closest_ns / 1e6, self._slop_ns / 1e6
        return (
            f"the nearest left and right stamps are {apart:.1f} ms apart, more than --slop-ms "
            f"{slop:g}; trigger the cameras together, or allow more"
        )

    def _complete(self, right: bool, stamp_ns: int, image: T, nearest: int) -> Pair[T]:
        mine, others = self._waiting[right], self._waiting[not right]
        skipped, self._skipped = self._skipped + len(mine) + nearest, 0
        mine.clear()
        for _ in range(nearest):
            others.popleft()
        other_ns, other = others.popleft()
        if right:
            return Pair(other_ns, other, image, skipped)
        return Pair(stamp_ns, image, other, skipped)


def rate_of(stamps_ns: list[int], default: float) -> float:
    """Pairs a second by the stamps of some that follow one another; the default where they tell none."""
    period = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
    return 1e9 / period if period > 0 else default


def stereo_topics(topics: Iterable[str], given: tuple[str, str] | None) -> tuple[str, str]:
    """The left and the right image topic of a recording.

    Without a choice, the only pair of names that differ in left and right (or cam0 and cam1, ...),
    raw images before rectified ones, whole ones before compressed ones.

    Raises:
        InputError: a chosen topic is not there, or there is no pair, or more than one.
    """
    images = sorted(topics)
    listed = ", ".join(images) or "none"
    if given is not None:
        for topic in given:
            if topic not in images:
                raise InputError(f"no image topic {topic}; there are {listed}")
        return given
    pairs = [
        (topic, other) for topic in images for other in _counterparts(topic) if other in images
    ]
    best = min(map(_rank, pairs), default=None)
    pairs = [pair for pair in pairs if _rank(pair) == best]
    if len(pairs) != 1:
        found = "several pairs of" if pairs else "no left and right among the"
        raise InputError(f"{found} image topics; give --topics LEFT RIGHT of: {listed}")
    return pairs[0]


_NAMES = (
    ("left", "right"),
    ("Left", "Right"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
    ("image_0", "image_1"),
    ("infra1", "infra2"),
)


def _counterparts(topic: str) -> list[str]:
    return [topic.replace(left, right) for left, right in _NAMES if left in topic]


def _rank(pair: tuple[str, str]) -> tuple[bool, bool]:
    return is_rectified_topic(pair[0]), pair[0].endswith("/compressed")


def is_rectified_topic(topic: str) -> bool:
    """Whether a topic's name says that its images are rectified already."""
    return "image_rect" in topic


def camera_info_topic(topic: str) -> str:
    """Where ROS keeps the calibration of an image topic."""
    return topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"

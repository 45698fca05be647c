"""One side-by-side video, or two videos."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2

from services.sources.footage import Exposure, check_pair, halves, size_of
from suturetrack.types import Image, InputError

log = logging.getLogger("suturetrack")


class VideoFootage:
    """Frames of one video whose halves are left and right, or of two videos frame by frame."""

    live = False
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(self, paths: list[Path]):
        self._paths = paths
        self._captures = [_open(path) for path in paths]
        rates = [capture.get(cv2.CAP_PROP_FPS) for capture in self._captures]
        if max(rates) - min(rates) > 0.01 * max(rates):
            raise InputError(
                f"source {paths[0]},{paths[1]}: {rates[0]:g} and {rates[1]:g} frames/s"
            )
        if not 0 < rates[0] <= 1000:
            raise InputError(f"source {paths[0]}: the video tells no frame rate ({rates[0]:g})")
        self.fps = float(rates[0])
        counts = [int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) for capture in self._captures]
        self.frame_count: int | None = min(counts) if min(counts) > 0 else None
        self._warning = _left_over(paths, counts)
        self._next = 0
        first = self._decode(0)
        if first is None:
            raise InputError(f"source {paths[0]}: no frame can be decoded")
        self._first, self.size = first, size_of(first.left)

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
        # Not when it is opened, as who starts a run opens it, too.
        if self._warning:
            log.warning("%s", self._warning)
            self._warning = ""
        if index == 0:
            return self._first
        while self._next < index:
            if not self._grab():
                return None
        return self._decode(index)

    def close(self) -> None:
        """See `Footage`."""
        for capture in self._captures:
            capture.release()

    def _grab(self) -> bool:
        self._next += 1
        grabbed = [capture.grab() for capture in self._captures]
        return all(grabbed)

    def _decode(self, index: int) -> Exposure | None:
        if not self._grab():
            return None
        images: list[Image] = []
        for capture, path in zip(self._captures, self._paths, strict=True):
            decoded, image = capture.retrieve()
            if not decoded:
                raise InputError(f"source {path}: frame {index} cannot be decoded")
            images.append(image)
        left, right = images if len(images) == 2 else halves(images[0], str(self._paths[0]))
        check_pair(left, right, f"source {','.join(map(str, self._paths))}")
        return Exposure(round(index * 1e9 / self.fps), left, right)


def _left_over(paths: list[Path], counts: list[int]) -> str:
    """What is said of two videos of which one goes on after the other has ended."""
    if min(counts) <= 0 or min(counts) == max(counts):
        return ""
    told = " and ".join(f"{path} has {count}" for path, count in zip(paths, counts, strict=True))
    return f"{told} frames: only the first {min(counts)} of each are paired"


def _open(path: Path) -> cv2.VideoCapture:
    if not path.exists():
        raise InputError(
            f"source {path}: no such file or folder; the bench top is stage:NAME, two videos are "
            "LEFT,RIGHT"
        )
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise InputError(f"source {path}: not a video that can be read")
    return capture

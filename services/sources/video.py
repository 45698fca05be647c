"""One side-by-side video, or two videos."""

from __future__ import annotations

from pathlib import Path

import cv2

from services.sources.footage import Exposure, check_pair, halves, size_of
from suturetrack.types import Image, InputError


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
        self._next = 0
        first = self._decode(0)
        if first is None:
            raise InputError(f"source {paths[0]}: no frame can be decoded")
        self._first, self.size = first, size_of(first.left)

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
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

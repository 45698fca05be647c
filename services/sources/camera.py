"""Live cameras: one side-by-side device, or two."""

from __future__ import annotations

import time

import cv2

from services.sources.footage import Exposure, halves
from suturetrack.types import Image, InputError


def is_device(name: str) -> bool:
    """Whether a source names a capture device: a number, or a path below /dev."""
    return name.isdecimal() or name.startswith("/dev/")


class CameraFootage:
    """Frames as the cameras give them, stamped when they arrive."""

    live = True
    frame_count: int | None = None
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(self, names: list[str]):
        self._names = names
        self._captures = [_open(name) for name in names]
        first = self.read(0)
        height, width = first.left.shape[:2]
        self.size = width, height
        self.fps = float(self._captures[0].get(cv2.CAP_PROP_FPS)) or 30.0

    def read(self, index: int) -> Exposure:
        """See `Footage`."""
        grabbed = [capture.grab() for capture in self._captures]
        now_ns = time.time_ns()
        images: list[Image] = []
        for name, capture, ok in zip(self._names, self._captures, grabbed, strict=True):
            decoded, image = capture.retrieve() if ok else (False, None)
            if not decoded or image is None:
                raise InputError(f"camera {name}: no image after {index} frames; is it connected?")
            images.append(image)
        left, right = images if len(images) == 2 else halves(images[0], self._names[0])
        if left.shape != right.shape:
            raise InputError(f"cameras: left is {left.shape}, right is {right.shape}")
        return Exposure(now_ns, left, right)

    def close(self) -> None:
        """See `Footage`."""
        for capture in self._captures:
            capture.release()


def _open(name: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(int(name) if name.isdecimal() else name)
    if not capture.isOpened():
        raise InputError(f"camera {name}: cannot be opened; is it there, and may you read it?")
    return capture

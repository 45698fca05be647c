"""Live cameras: one side-by-side device, or two."""

from __future__ import annotations

import threading
import time

import cv2

from services.sources.footage import Exposure, Stalled, check_pair, halves, size_of
from services.sources.live import STALL_S, Newest
from suturetrack.types import Image, InputError

_FIRST_S = 15.0
"""Some cameras take their time to start."""
_RETRY_S = 0.5
_GOODBYE_S = 2.0


def is_device(name: str) -> bool:
    """Whether a source names a capture device: a number, or a path below /dev."""
    return name.isdecimal() or name.startswith("/dev/")


class CameraFootage:
    """Frames as the cameras give them, stamped when they arrive.

    A camera that gives no more images is closed and opened again until it does.

    Args:
        names: one side-by-side device, or the left and the right one.
        size: (width, height) of one view, px; what the devices are asked for.
        fps: frames a second; what they are asked for.

    Raises:
        InputError: a camera cannot be opened, or gives no image at all.
    """

    live = True
    frame_count: int | None = None
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(self, names: list[str], size: tuple[int, int], fps: float):
        self._names = names
        width, height = size
        self._wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: width * (2 if len(names) == 1 else 1),
            cv2.CAP_PROP_FRAME_HEIGHT: height,
            cv2.CAP_PROP_FPS: fps,
        }
        self._newest = Newest()
        self._closing = threading.Event()
        captures = self._open()
        self.fps = float(captures[0].get(cv2.CAP_PROP_FPS)) or fps
        self._thread = threading.Thread(target=self._take, args=(captures,), daemon=True)
        self._thread.start()
        try:
            self._first = self._newest.get(_FIRST_S, self._complaint)
        except Stalled as stall:
            self.close()
            raise InputError(f"{stall}; is it connected, and free?") from stall
        self.size = size_of(self._first.left)

    def read(self, index: int) -> Exposure:
        """See `Footage`."""
        if index == 0:
            return self._first
        exposure = self._newest.get(STALL_S, self._complaint)
        width, height = size = size_of(exposure.left)
        if size != self.size:
            raise InputError(f"{self._where}: images are {width}x{height} now, were {self.size}")
        return exposure

    def close(self) -> None:
        """See `Footage`."""
        self._closing.set()
        self._thread.join(_GOODBYE_S)

    @property
    def _where(self) -> str:
        return f"camera {','.join(self._names)}"

    @property
    def _complaint(self) -> str:
        return f"{self._where}: no image"

    def _take(self, captures: list[cv2.VideoCapture]) -> None:
        """Takes exposures until closing; in a thread, for a driver may wait for long."""
        while not self._closing.is_set():
            try:
                exposure = self._expose(captures)
            except InputError as error:
                self._newest.fail(error)
                break
            if exposure is not None:
                self._newest.put(exposure)
                continue
            _release(captures)
            self._closing.wait(_RETRY_S)
            try:
                captures = self._open()
            except InputError:
                captures = []
        _release(captures)

    def _expose(self, captures: list[cv2.VideoCapture]) -> Exposure | None:
        # All are grabbed before any is decoded, to be as near in time as they can be.
        grabbed = [capture.grab() for capture in captures]
        now_ns = time.time_ns()
        if not captures or not all(grabbed):
            return None
        images: list[Image] = []
        for capture in captures:
            decoded, image = capture.retrieve()
            if not decoded or image is None:
                return None
            images.append(image)
        left, right = images if len(images) == 2 else halves(images[0], self._names[0])
        check_pair(left, right, "cameras")
        return Exposure(now_ns, left, right)

    def _open(self) -> list[cv2.VideoCapture]:
        captures: list[cv2.VideoCapture] = []
        for name in self._names:
            capture = cv2.VideoCapture(int(name) if name.isdecimal() else name)
            captures.append(capture)
            if not capture.isOpened():
                _release(captures)
                raise InputError(
                    f"camera {name}: cannot be opened; is it there, and may you read it?"
                )
            for setting, value in self._wanted.items():
                capture.set(setting, value)
        return captures


def _release(captures: list[cv2.VideoCapture]) -> None:
    for capture in captures:
        capture.release()

"""What all sources have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from suturetrack.types import Image, InputError, Truth

_STARTS_AND_ENDS = ((b"\x89PNG", b"IEND"), (b"\xff\xd8", b"\xff\xd9"))
"""Of PNG and JPEG files."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """Both images of one moment, before they are released."""

    capture_ns: int
    """The recording's own time; the wall clock for live input."""
    left: Image
    """(H, W, 3) BGR or (H, W) gray, uint8."""
    right: Image
    """As `left`."""
    truths: tuple[Truth, ...] = ()
    """Where the threads really are, when that is known."""
    skipped: int = 0
    """Images without a partner that were left out since the exposure before."""


class Stalled(Exception):
    """Live input sends nothing at present; it may again, so asking again is right."""


class Footage(Protocol):
    """A source of stereo frames."""

    size: tuple[int, int]
    """(width, height) of one view, px."""
    fps: float
    """Frames a second."""
    frame_count: int | None
    """How many frames there are; None when nobody knows."""
    live: bool
    """Whether frames come at their own pace and cannot be had again."""
    seeds: tuple[tuple[float, float], ...]
    """Pixels (u, v) of the first raw left image that are known to lie on threads."""

    def read(self, index: int) -> Exposure | None:
        """The frame with this number, asked for in rising order; None after the last one.

        Raises:
            InputError: the frame cannot be read.
            Stalled: live input, and no frame for a second.
        """

    def close(self) -> None:
        """Lets files and devices go."""


def read_image(path: Path) -> Image:
    """An 8-bit image as (H, W, 3) BGR or (H, W) gray; raises InputError."""
    if not path.is_file():
        raise InputError(f"no image {path}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"image {path} cannot be read: {error.strerror}") from error
    if any(data.startswith(start) and end not in data for start, end in _STARTS_AND_ENDS):
        raise InputError(f"image {path} is cut short: the end of the file is missing")
    # From memory, as what is missing of a JPEG file is filled with gray.
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        raise InputError(f"image {path} cannot be read; use PNG, JPEG, TIFF or BMP")
    if image.dtype != np.uint8:
        raise InputError(f"image {path} is {image.dtype}; convert it to 8 bit")
    return np.ascontiguousarray(image[..., :3]) if image.ndim == 3 else image


def size_of(image: Image) -> tuple[int, int]:
    """(width, height) of an image, px."""
    return image.shape[1], image.shape[0]


def check_pair(left: Image, right: Image, where: str) -> None:
    """Raises InputError when two images cannot be the views of one frame."""
    if left.shape != right.shape:
        raise InputError(
            f"{where}: left is {_spell(left)}, right is {_spell(right)}; both must have one size, and "
            "be gray or in colour alike"
        )


def _spell(image: Image) -> str:
    width, height = size_of(image)
    return f"{width}x{height} {'gray' if image.ndim == 2 else 'in colour'}"


def halves(image: Image, name: str) -> tuple[Image, Image]:
    """The left and the right view of a side-by-side image; raises InputError."""
    width = image.shape[1]
    if width % 2:
        raise InputError(f"{name}: {width} columns cannot be two views side by side")
    return image[:, : width // 2], image[:, width // 2 :]

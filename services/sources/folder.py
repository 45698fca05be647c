"""A folder of image pairs."""

from __future__ import annotations

import re
from pathlib import Path

from services.sources.footage import Exposure, check_pair, read_image, size_of
from suturetrack.types import InputError

_NUMBER = r"[0-9]+(?:\.[0-9]+)?"
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


class FolderFootage:
    """`left/*.png` and `right/*.png`, paired in the order of their names."""

    live = False
    seeds: tuple[tuple[float, float], ...] = ()

    def __init__(self, folder: Path, fps: float):
        self.fps = fps
        self._pairs = _pairs(folder)
        self.frame_count: int | None = len(self._pairs)
        self.size = size_of(read_image(self._pairs[0][0]))

    def read(self, index: int) -> Exposure | None:
        """See `Footage`."""
        if index >= len(self._pairs):
            return None
        paths = self._pairs[index]
        left, right = (read_image(path) for path in paths)
        check_pair(left, right, f"images {paths[0]} and {paths[1]}")
        width, height = size_of(left)
        if (width, height) != self.size:
            raise InputError(
                f"image {paths[0]} is {width}x{height}, the first one was "
                f"{self.size[0]}x{self.size[1]}; keep images of one size in a folder"
            )
        return Exposure(round(index * 1e9 / self.fps), left, right)

    def close(self) -> None:
        """See `Footage`."""


def _pairs(folder: Path) -> list[tuple[Path, Path]]:
    views = []
    for side in ("left", "right"):
        if not (folder / side).is_dir():
            raise InputError(
                f"source {folder}: no folder {side}/; it needs left/*.png, right/*.png"
            )
        images = [p for p in (folder / side).iterdir() if p.suffix.lower() in _SUFFIXES]
        views.append(sorted(images, key=_order))
    left, right = views
    if not left or not right:
        raise InputError(f"source {folder}: no images in left/ or right/")
    if len(left) != len(right):
        raise InputError(f"source {folder}: {len(left)} images in left/, {len(right)} in right/")
    partner = dict(zip(_keys(right), right, strict=True))
    keys = _keys(left)
    unique = len(set(keys)) == len(partner) == len(left)
    for key, path, other in zip(keys, left, right, strict=True):
        namesake = partner.get(key, other)
        if unique and namesake != other:
            raise InputError(
                f"source {folder}: left/{path.name} would be paired with right/{other.name}, not with "
                f"right/{namesake.name}; each side lacks an image that the other has: delete those"
            )
    return list(zip(left, right, strict=True))


def _keys(paths: list[Path]) -> list[tuple[float, ...] | str]:
    """What the names of one side tell their images apart by: the numbers that vary, else the words."""
    numbers = [[float(number) for number in re.findall(_NUMBER, path.stem)] for path in paths]
    if len({len(row) for row in numbers}) == 1:
        varying = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1]
        keys: list[tuple[float, ...] | str] = list(zip(*varying, strict=True))
        if len(set(keys)) == len(paths):
            return keys
    return [path.stem.lower().replace("right", "left") for path in paths]


def _order(path: Path) -> list[tuple[float, str]]:
    """Sorts names by the numbers in them: 2 before 10, and 10.25 before 10.5."""
    parts = re.findall(rf"{_NUMBER}|[^0-9]+", path.stem)
    return [(float(part) if part[0] in "0123456789" else -1, part) for part in parts]

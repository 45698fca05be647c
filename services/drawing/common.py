"""What all drawings share: views, colours, and how values become archetypes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr

from suturetrack.camera import StereoRig
from suturetrack.types import Image

Level = Literal["light", "full"]
Color = tuple[int, int, int]
"""RGB."""
Entry = tuple[Any, ...]
"""(entity path, archetype or row, ...)"""

VIEWS = ("left", "right")
GREEN: Color = (70, 220, 90)
RED: Color = (240, 60, 50)
AMBER: Color = (255, 180, 40)
BLUE: Color = (90, 160, 250)
ORANGE: Color = (250, 130, 60)
VIOLET: Color = (200, 130, 240)
TURQUOISE: Color = (120, 200, 200)
GRAY: Color = (150, 150, 150)
YELLOW: Color = (235, 225, 60)
PINK: Color = (255, 110, 200)
WHITE: Color = (245, 245, 245)
# Colours at half the resolution, as is usual, would move a thread that differs in colour by a pixel.
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    90,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]


def series(**colors: Color) -> rr.SeriesLines:
    """The look of a plot, a line for each name."""
    names = [name.replace("_", " ") for name in colors]
    return rr.SeriesLines(names=names, colors=list(colors.values()), widths=[1.5] * len(names))


def jpeg(image: Image) -> rr.EncodedImage:
    """A BGR or gray picture, small."""
    _, data = cv2.imencode(".jpg", image, _JPEG)
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")


def values(name: str, numbers: Mapping[str, Any]) -> rr.DynamicArchetype:
    """Numbers and words as they are, in columns `name:key`; arrays are flattened."""
    # Arrow arrays made here cost a fifth of those that Rerun would make.
    columns = {key: pa.array(np.ravel(value)) for key, value in numbers.items()}
    return rr.DynamicArchetype(name, components=columns)


@dataclass(frozen=True, eq=False)
class Row:
    """What an archetype would hold, as bare arrays or lists: many rows make one archetype.

    One archetype costs as much as the drawing of a whole state, so those of every frame are made late.
    """

    archetype: Any
    """The class, or the name of one of our own, whose components are flat arrays."""
    components: dict[str, Any]
    """By name; those of one name are alike but for their length."""

    @staticmethod
    def joined(rows: Sequence[Row]) -> Any:
        """The archetype of all rows, one after the other."""
        components = {
            name: _joined([row.components[name] for row in rows]) for name in rows[0].components
        }
        if isinstance(rows[0].archetype, str):
            return values(rows[0].archetype, components)
        return rows[0].archetype.from_fields(**components)


def row(archetype: Any, **components: Any) -> Row:
    """Components of one frame; single numbers and words count as lists of one.

    Under a name of our own arrays are flattened.
    """
    listed = np.ravel if isinstance(archetype, str) else _listed
    return Row(archetype, {name: listed(what) for name, what in components.items()})


def _listed(what: Any) -> Any:
    return what if isinstance(what, list | np.ndarray) else np.array([what])


def _joined(pieces: list[Any]) -> Any:
    return list(chain(*pieces)) if isinstance(pieces[0], list) else np.concatenate(pieces)


def part(name: str) -> str:
    """A user's name as one part of an entity path."""
    return str(rr.escape_entity_path_part(name))


def unrectified(picture: Image, rig: StereoRig, view: str) -> Image:
    """A picture in rectified pixels, redrawn in the pixels of the raw image."""
    if rig.is_rectified:
        return picture
    return cv2.remap(picture, *_rectified_of_raw(rig, view), interpolation=cv2.INTER_NEAREST)


@cache
def _rectified_of_raw(rig: StereoRig, view: str) -> tuple[Any, Any]:
    width, height = rig.image_size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    rectified = rig.rectify_pixels(grid, right=view == "right").astype(np.float32)
    maps = cv2.convertMaps(rectified, None, cv2.CV_16SC2, nninterpolation=True)
    return maps[0], maps[1]

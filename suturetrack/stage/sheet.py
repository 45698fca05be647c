"""Pictures of the scenarios, side by side."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from suturetrack.stage.appearance import Picture
from suturetrack.stage.scenarios import SCENARIOS
from suturetrack.stage.scene import DEFAULT_PICTURE, open_scene
from suturetrack.types import Image

_MOMENTS = (0.0, 0.3, 0.6, 0.9)
_WIDTH = 320


def contact_sheet(
    scenarios: Iterable[str] = tuple(SCENARIOS),
    rig: str = "bench",
    seed: int = 0,
    picture: Picture = DEFAULT_PICTURE,
) -> Image:
    """One row a scenario: its left image at four moments, small; (H, W, 3) uint8 BGR.

    Write it with `cv2.imwrite("bench-top.png", contact_sheet())`.

    Raises:
        InputError: as `open_scene`.
    """
    rows = []
    for name in scenarios:
        scene = open_scene(name, seed, rig, picture=picture)
        pictures = [_small(scene.render(int(m * scene.frame_count))[0]) for m in _MOMENTS]
        row = np.hstack(pictures)
        cv2.putText(
            row, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
        )
        rows.append(row)
    return np.vstack(rows)


def _small(image: Image) -> Image:
    height = round(image.shape[0] * _WIDTH / image.shape[1])
    return np.asarray(cv2.resize(image, (_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)

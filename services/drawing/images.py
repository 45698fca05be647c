"""Cameras, images and fields."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr

from services.drawing.common import (
    BLUE,
    GRAY,
    ORANGE,
    VIEWS,
    VIOLET,
    Entry,
    Level,
    jpeg,
    series,
    unrectified,
    values,
)
from services.drawing.growth import style as growth_style
from suturetrack.camera import Camera, StereoRig
from suturetrack.directions import direction_image, direction_key
from suturetrack.types import Float64, RidgeField, StereoFrame

_KEY_PX = 129
_PROCESS_COLORS = {"source": BLUE, "segmenter": VIOLET, "tracker": ORANGE}


def cameras(rig: StereoRig) -> Iterator[Entry]:
    """The cameras, and the key to the directions; all of it static."""
    yield "/rig", rr.ViewCoordinates.RDF
    poses = (np.zeros(3), np.array([rig.baseline, 0.0, 0.0]))
    for view, camera, position in zip(VIEWS, (rig.left, rig.right), poses, strict=True):
        yield f"/rig/{view}", rr.Transform3D(translation=position, mat3x3=camera.rectification)
        pinhole = rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=rig.image_size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=2 * rig.baseline,
        )
        yield f"/rig/{view}/image", pinhole
    yield from growth_style()
    yield "/key/direction", rr.Image(direction_key(_KEY_PX), color_model="BGR")
    yield "/run/calibration", values("Calibration", _calibration(rig))


def frame(frame: StereoFrame, level: Level) -> Iterator[Entry]:
    """Both raw images: JPEG (light), or as they are (full)."""
    for view, image in zip(VIEWS, (frame.left, frame.right), strict=True):
        if level == "full":
            yield (
                f"/rig/{view}/image",
                rr.Image(image, color_model="BGR" if image.ndim == 3 else "L"),
            )
        else:
            yield f"/rig/{view}/image", jpeg(image)


def field(field: RidgeField, rig: StereoRig, level: Level) -> Iterator[Entry]:
    """The direction fields in false colour over the raw image; as numbers too (full)."""
    for side, (view, vectors) in enumerate(zip(VIEWS, (field.left, field.right), strict=True)):
        picture = unrectified(direction_image(vectors), rig, view)
        yield f"/rig/{view}/image/direction", jpeg(picture)
        if level == "full":
            numbers: dict[str, Any] = {"shape": vectors.shape, "vectors": vectors}
            if field.own:
                own = np.stack([pair[side] for pair in field.own.values()])
                numbers |= {"vectors": own, "threads": list(field.own)}
            if field.colours is not None:
                numbers |= vars(field.colours[side])
            yield f"/rig/{view}/field", values("RidgeField", numbers)


def process_style(process: str) -> Iterator[Entry]:
    """Names, colours and widths of one process's plots; all of it static."""
    for quantity in ("latency_ms", "rate_hz", "dropped", "memory_mb"):
        color = _PROCESS_COLORS.get(process, GRAY)
        yield f"/plots/{quantity}/{process}", series(**{process: color})


def _calibration(rig: StereoRig) -> dict[str, Any]:
    def numbers(view: str, camera: Camera) -> dict[str, Float64]:
        return {f"{view}_{name}": value for name, value in vars(camera).items()}

    return {
        "image_size": rig.image_size,
        "metres_per_unit": rig.metres_per_unit,
        **numbers("left", rig.left),
        **numbers("right", rig.right),
    }

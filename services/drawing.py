"""What each value looks like in a recording: the entity tree, and the archetypes at each entity.

Every function yields `(entity, archetypes...)` and touches no file. Pictures and overlays are in raw
pixels, points in the calibration's unit, plots in the units that their names carry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr

from suturetrack import nurbs
from suturetrack.camera import Camera, StereoRig
from suturetrack.segmentation import direction_image
from suturetrack.types import (
    Bool,
    Float64,
    Image,
    RidgeField,
    Status,
    StereoFrame,
    ThreadState,
    Truth,
)

Level = Literal["light", "full"]
Color = tuple[int, int, int]
Entry = tuple[Any, ...]
"""(entity path, archetype, ...)"""

VIEWS = ("left", "right")
GREEN, RED, AMBER, GRAY, WHITE = (
    (70, 220, 90),
    (240, 60, 50),
    (255, 180, 40),
    (150, 150, 150),
    (245, 245, 245),
)
STATUS_COLORS = {Status.TRACKING: GREEN, Status.OCCLUDED: AMBER, Status.LOST: RED}
PROCESS_COLORS = {
    "source": (90, 160, 250),
    "segmenter": (200, 130, 240),
    "tracker": (250, 160, 60),
}
_JPEG_QUALITY = 80
_DENSE = 240
_DASH = 5
_ARROWS = 24
_WORST_SIGMA_PX = 3.0


def rig(rig: StereoRig) -> Iterator[Entry]:
    """The cameras; all of it static."""
    yield "/rig", rr.ViewCoordinates.RDF
    poses = (np.zeros(3), np.array([rig.baseline, 0.0, 0.0]))
    for view, camera, position in zip(VIEWS, (rig.left, rig.right), poses, strict=True):
        yield f"/rig/{view}", rr.Transform3D(translation=position, mat3x3=camera.rectification)
        pinhole = rr.Pinhole(
            image_from_camera=camera.matrix,
            resolution=rig.image_size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=3 * rig.baseline,
        )
        yield f"/rig/{view}/image", pinhole
    yield "/run/calibration", values("Calibration", _calibration(rig))


def frame(frame: StereoFrame, level: Level) -> Iterator[Entry]:
    """Both raw images: JPEG (light), or as they are (full)."""
    for view, image in zip(VIEWS, (frame.left, frame.right), strict=True):
        if level == "full":
            yield (
                f"/rig/{view}/image",
                rr.Image(image, color_model="BGR"[: image[0, 0].size] or "L"),
            )
        else:
            yield f"/rig/{view}/image", jpeg(image)


def field(field: RidgeField, rig: StereoRig, level: Level) -> Iterator[Entry]:
    """The direction fields in false colour over the raw image; as numbers too (full)."""
    for view, vectors in zip(VIEWS, (field.left, field.right), strict=True):
        picture = unrectified(direction_image(vectors), rig, view)
        yield f"/rig/{view}/image/direction", jpeg(picture)
        if level == "full":
            yield f"/rig/{view}/field", rr.Tensor(vectors, dim_names=("v", "u", "component"))


def states(states: Sequence[ThreadState], rig: StereoRig, published_ns: int) -> Iterator[Entry]:
    """The curves: over both images, in space, and as plots."""
    yield from _overlays(states, rig)
    for state in states:
        yield from _in_space(state, rig, published_ns)
        yield from _plots(state, rig)


def truth(truth: Truth) -> Iterator[Entry]:
    """The true thread of a synthetic scene."""
    numbers = {
        "thread": truth.thread,
        "capture_ns": truth.stamp.capture_ns,
        "released_ns": truth.stamp.released_ns,
        "length": truth.length,
        "visible": truth.visible,
    }
    line = rr.LineStrips3D([truth.points], colors=[WHITE], radii=-0.75)
    yield f"/rig/truth/{part(truth.thread)}", line, values("Truth", numbers)


def thread_style(thread: str) -> Iterator[Entry]:
    """Names, colours and widths of one thread's plots; all of it static."""
    plots, statuses = f"/plots/{part(thread)}", list(STATUS_COLORS)
    both = {"left": (90, 160, 250), "right": (250, 130, 60)}
    yield f"{plots}/energy/image", series(**both)
    yield f"{plots}/energy/end", series(ends=(200, 130, 240))
    yield f"{plots}/energy/internal", series(bending=(120, 200, 200))
    yield f"{plots}/length", series(length=GREEN)
    yield f"{plots}/control_points", series(control_points=RED)
    colors = [(*c, 255) for c in STATUS_COLORS.values()]
    yield f"{plots}/status", rr.StateConfiguration(values=statuses, colors=colors)


def process_style(process: str) -> Iterator[Entry]:
    """Names, colours and widths of one process's plots; all of it static."""
    for quantity in ("latency_ms", "rate_hz", "dropped", "memory_mb"):
        color = PROCESS_COLORS.get(process, GRAY)
        yield f"/plots/{quantity}/{process}", series(**{process: color})


def series(**colors: Color) -> rr.SeriesLines:
    """The look of a plot, a line for each name."""
    names = [name.replace("_", " ") for name in colors]
    return rr.SeriesLines(names=names, colors=list(colors.values()), widths=[1.5] * len(names))


def jpeg(image: Image) -> rr.EncodedImage:
    """A BGR or gray picture, small."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")


def values(name: str, numbers: Mapping[str, Any]) -> rr.DynamicArchetype:
    """Numbers and words as they are, in columns `name:key`; arrays are flattened."""
    # Arrow arrays made here cost a fifth of those that Rerun would make.
    columns = {key: pa.array(np.ravel(value)) for key, value in numbers.items()}
    return rr.DynamicArchetype(name, components=columns)


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


def _calibration(rig: StereoRig) -> dict[str, Any]:
    def numbers(view: str, camera: Camera) -> dict[str, Float64]:
        return {f"{view}_{name}": value for name, value in vars(camera).items()}

    return {
        "image_size": rig.image_size,
        "metres_per_unit": rig.metres_per_unit,
        **numbers("left", rig.left),
        **numbers("right", rig.right),
    }


def _overlays(states: Sequence[ThreadState], rig: StereoRig) -> Iterator[Entry]:
    strips: dict[str, list[Float64]] = {view: [] for view in VIEWS}
    points: dict[str, list[Float64]] = {view: [] for view in VIEWS}
    colors: list[Color] = []
    for state in states:
        for strip, color in _strips(state):
            colors.append(color)
            for view, pixels in zip(VIEWS, rig.project_raw(strip), strict=True):
                strips[view].append(_finite(pixels))
        if state.curve is not None:
            for view, pixels in zip(
                VIEWS, rig.project_raw(state.curve.control_points), strict=True
            ):
                points[view].append(_finite(pixels))
    for view in VIEWS:
        yield (
            f"/rig/{view}/image/curve",
            rr.LineStrips2D(strips[view], colors=colors, radii=-1.5),
            rr.Points2D(np.concatenate([np.empty((0, 2)), *points[view]]), colors=RED, radii=-3.0),
        )


def _in_space(state: ThreadState, rig: StereoRig, published_ns: int) -> Iterator[Entry]:
    root = f"/rig/thread/{part(state.thread)}"
    strips = _strips(state)
    control_points = np.empty((0, 3)) if state.curve is None else state.curve.control_points
    yield (
        f"{root}/curve",
        rr.LineStrips3D([s for s, _ in strips], colors=[c for _, c in strips], radii=-2.0),
    )
    yield f"{root}/control_points", rr.Points3D(control_points, colors=RED, radii=-3.5)
    yield f"{root}/nurbs", values("ThreadState", _numbers(state, published_ns))
    if state.curve is None:
        yield f"{root}/tangent", rr.Arrows3D(vectors=np.empty((0, 3)))
        yield f"{root}/reliability", rr.Points3D(np.empty((0, 3)))
        return
    s = nurbs.evenly_spaced(state.curve, _ARROWS)
    arrows = nurbs.tangents(state.curve, s) * state.length / _ARROWS
    yield (
        f"{root}/tangent",
        rr.Arrows3D(
            origins=nurbs.evaluate(state.curve, s), vectors=arrows, colors=WHITE, radii=-0.75
        ),
    )
    samples = nurbs.evaluate(state.curve, np.linspace(0, 1, len(state.sigma)))
    colors = _reliability_colors(state.sigma * rig.focal / samples[:, 2], state.seen)
    yield f"{root}/reliability", rr.Points3D(samples, colors=colors, radii=-2.5)


def _plots(state: ThreadState, rig: StereoRig) -> Iterator[Entry]:
    root, energies = f"/plots/{part(state.thread)}", state.energies
    yield f"{root}/energy/image", rr.Scalars([energies.image_left, energies.image_right])
    yield f"{root}/energy/end", rr.Scalars(energies.end)
    yield f"{root}/energy/internal", rr.Scalars(energies.internal)
    yield f"{root}/length", rr.Scalars(state.length * rig.metres_per_unit * 1000)
    count = 0 if state.curve is None else len(state.curve.control_points)
    yield f"{root}/control_points", rr.Scalars(count)
    yield f"{root}/status", rr.StateChange(state=state.status)


def _numbers(state: ThreadState, published_ns: int) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "thread": state.thread,
        "status": str(state.status),
        "capture_ns": state.stamp.capture_ns,
        "released_ns": state.stamp.released_ns,
        "published_ns": published_ns,
        "length": state.length,
        **vars(state.energies),
        "sigma": state.sigma,
        "seen": state.seen,
        "events": np.array(state.events, dtype=str),
    }
    if state.curve is None:
        return numbers
    return numbers | {
        "degree": state.curve.degree,
        "knots": state.curve.knots,
        "control_points": state.curve.control_points,
        "weights": state.curve.weights,
    }


def _strips(state: ThreadState) -> list[tuple[Float64, Color]]:
    """The curve in pieces: solid where it is seen, dashed where it is not, gray where it is lost."""
    if state.curve is None:
        return []
    s = np.linspace(0, 1, _DENSE)
    points = nurbs.evaluate(state.curve, s)
    if state.status is Status.LOST:
        return [(piece, GRAY) for piece in _dashes(points)]
    seen = _sampled(state.seen, s)
    edges = [0, *(np.flatnonzero(np.diff(seen)) + 1), _DENSE]
    strips: list[tuple[Float64, Color]] = []
    for start, stop in pairwise(edges):
        piece = points[start : stop + 1]
        if seen[start]:
            strips.append((piece, GREEN))
        else:
            strips += [(dash, AMBER) for dash in _dashes(piece)]
    return strips


def _dashes(points: Float64) -> list[Float64]:
    return [points[i : i + _DASH] for i in range(0, len(points), 2 * _DASH)]


def _sampled(seen: Bool, s: Float64) -> Bool:
    return seen[np.rint(s * (len(seen) - 1)).astype(int)]


def _finite(pixels: Float64) -> Float64:
    return pixels[np.isfinite(pixels).all(axis=1)]


def _reliability_colors(sigma_px: Float64, seen: Bool) -> Image:
    """(K, 3) RGB: green where the images hold the curve, over yellow to red; gray where unseen."""
    badness = np.clip(np.nan_to_num(sigma_px, nan=np.inf) / _WORST_SIGMA_PX, 0, 1)[:, None]
    half = np.minimum(2 * badness, 1), np.maximum(2 * badness - 1, 0)
    green, amber, red = (np.array(c, float) for c in (GREEN, AMBER, RED))
    colors = green + half[0] * (amber - green) + half[1] * (red - amber)
    return np.where(seen[:, None], colors, GRAY).astype(np.uint8)

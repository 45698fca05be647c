"""The growth of Section V, step by step (Fig. 3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
import rerun as rr

from services.drawing.common import (
    AMBER,
    BLUE,
    GREEN,
    RED,
    VIEWS,
    WHITE,
    Entry,
    jpeg,
    part,
    unrectified,
)
from suturetrack.camera import StereoRig
from suturetrack.directions import direction_image
from suturetrack.initialization import (
    Growth,
    Initialization,
    InitializationError,
    ViewGrowth,
)
from suturetrack.types import Float32, Float64, Image, RidgeField, Seed, Stamp

STEPS = 10
_ROOT = "image/growth"


def style() -> Iterator[Entry]:
    """The colours of the front, early to late; all of it static."""
    ramp = np.linspace(0, 255, STEPS).astype(np.uint8)
    colors = cv2.applyColorMap(ramp, cv2.COLORMAP_PLASMA)[:, 0, ::-1].tolist()
    classes = [(0, "not reached", (0, 0, 0, 0))]
    classes += [(k, f"step {k}", (*color, 255)) for k, color in enumerate(colors, 1)]
    for name in VIEWS:
        yield f"/rig/{name}/{_ROOT}", rr.AnnotationContext(classes)


def growth(thread: str, growth: Growth, rig: StereoRig) -> Iterator[list[Entry]]:
    """What is to be seen after each step: the front as it spreads, at last what was made of it."""
    views = dict(_views(growth))
    root = f"{_ROOT}/{part(thread)}"
    arrivals = {name: unrectified(_arrival(view.cost), rig, name) for name, view in views.items()}
    for step in range(1, STEPS + 1):
        yield [
            (f"/rig/{name}/{root}/front", rr.SegmentationImage(np.where(a <= step, a, 0)))
            for name, a in arrivals.items()
        ]
    yield [
        entry
        for k, name in enumerate(VIEWS)
        for entry in _lines(f"/rig/{name}/{root}", views[name], growth.marks[:, k], rig, name)
    ]


def cleared(field: RidgeField, rig: StereoRig) -> Iterator[Entry]:
    """The field in which threads are looked for, and nothing of earlier growths."""
    for name, vectors in zip(VIEWS, (field.left, field.right), strict=True):
        yield f"/rig/{name}/{_ROOT}", rr.Clear(recursive=True)
        picture = unrectified(direction_image(vectors), rig, name)
        yield f"/rig/{name}/{_ROOT}/field", jpeg(picture)


def seed(seed: Seed, rig: StereoRig) -> Iterator[Entry]:
    """Where the growth begins; lengths in the calibration's unit."""
    u, v = rig.raw_pixels(rig.locate(seed)[None])[0]
    label = f"seed of thread {seed.thread}"
    mark = rr.Points2D([[u, v]], colors=BLUE, radii=-5.0, labels=label)
    yield f"/rig/left/{_ROOT}/{part(seed.thread)}/seed", mark


def outcome(
    stamp: Stamp, thread: str, result: Initialization | InitializationError
) -> Iterator[Entry]:
    """What came of looking for a thread, in words."""
    lines = [f"**Thread {thread}, frame {stamp.frame}**", ""]
    if isinstance(result, InitializationError):
        lines += [f"Not found: {result.reason}"]
    else:
        lines += [
            f"Found with confidence {result.confidence:.2f}, {result.reprojection_px:.2f} px off"
        ]
        lines += [f"- {reason}" for reason in result.reasons]
    for name, view in _views(result.growth):
        lines += ["", f"Rejected, {name}: {len(view.rejected) or 'nothing'}"]
        counts = Counter(why for _, why in view.rejected)
        lines += [f"- {count}x {why}" for why, count in counts.most_common()]
    text = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
    yield f"/log/initialization/{part(thread)}", text


def failure(thread: str, candidates: Float64, rig: StereoRig) -> Iterator[Entry]:
    """Where a seed that found nothing might better have been: ridges near it, left view."""
    points = rr.Points2D(rig.raw_pixels(candidates), colors=AMBER, radii=-4.0)
    yield f"/rig/left/{_ROOT}/{part(thread)}/candidates", points


def _views(growth: Growth | None) -> Iterable[tuple[str, ViewGrowth]]:
    return () if growth is None else zip(VIEWS, (growth.left, growth.right), strict=True)


def _lines(
    root: str, view: ViewGrowth, marks: Float64, rig: StereoRig, name: str
) -> Iterator[Entry]:
    def raw(lines: Iterable[Float64]) -> list[Float64]:
        return [rig.raw_pixels(line, right=name == "right") for line in lines]

    rejected, reasons = [line for line, _ in view.rejected], [why for _, why in view.rejected]
    yield f"{root}/segments", rr.LineStrips2D(raw(view.segments), colors=GREEN, radii=-1.0)
    yield f"{root}/merges", rr.LineStrips2D(raw(view.merges), colors=AMBER, radii=-2.0)
    yield (
        f"{root}/rejected",
        rr.LineStrips2D(raw(rejected), colors=RED, radii=-1.5, labels=reasons, draw_order=25),
    )
    yield f"{root}/marks", rr.Points2D(raw([marks])[0], colors=WHITE, radii=-2.5)


def _arrival(cost: Float32) -> Image:
    """(H, W) the step in 1..STEPS in which the growth came to a pixel, 0 where it never came."""
    reached = np.isfinite(cost)
    arrival = np.zeros(cost.shape, np.uint8)
    if reached.any():
        levels = np.quantile(cost[reached], np.linspace(0, 1, STEPS + 1)[1:-1])
        arrival[reached] = 1 + np.searchsorted(levels, cost[reached])
    return arrival

"""The growth of Section V, step by step (Fig. 3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
import rerun as rr

from services.drawing.common import AMBER, GREEN, RED, VIEWS, WHITE, Entry, part, unrectified
from suturetrack.camera import StereoRig
from suturetrack.initialization import Growth, ViewGrowth
from suturetrack.types import Float32, Float64, Image

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
    views = dict(zip(VIEWS, (growth.left, growth.right), strict=True))
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
        for entry in _outcome(f"/rig/{name}/{root}", views[name], growth.marks[:, k], rig, name)
    ]


def failure(thread: str, candidates: Float64, rig: StereoRig) -> Iterator[Entry]:
    """Where a seed that found nothing might better have been: ridges near it, left view."""
    points = rr.Points2D(rig.raw_pixels(candidates), colors=AMBER, radii=-4.0)
    yield f"/rig/left/{_ROOT}/{part(thread)}/candidates", points


def _outcome(
    root: str, view: ViewGrowth, marks: Float64, rig: StereoRig, name: str
) -> Iterator[Entry]:
    def raw(lines: Iterable[Float64]) -> list[Float64]:
        return [rig.raw_pixels(line, right=name == "right") for line in lines]

    rejected, reasons = [line for line, _ in view.rejected], [why for _, why in view.rejected]
    yield f"{root}/segments", rr.LineStrips2D(raw(view.segments), colors=GREEN, radii=-1.0)
    yield f"{root}/merges", rr.LineStrips2D(raw(view.merges), colors=AMBER, radii=-2.0)
    yield f"{root}/rejected", rr.LineStrips2D(raw(rejected), colors=RED, radii=-1.0, labels=reasons)
    yield f"{root}/marks", rr.Points2D(raw([marks])[0], colors=WHITE, radii=-2.5)


def _arrival(cost: Float32) -> Image:
    """(H, W) the step in 1..STEPS in which the growth came to a pixel, 0 where it never came."""
    reached = np.isfinite(cost)
    arrival = np.zeros(cost.shape, np.uint8)
    if reached.any():
        levels = np.quantile(cost[reached], np.linspace(0, 1, STEPS + 1)[1:-1])
        arrival[reached] = 1 + np.searchsorted(levels, cost[reached])
    return arrival

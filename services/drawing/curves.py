"""Curves: over the images, in space, as plots, and as numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr

from services.drawing.common import (
    AMBER,
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PINK,
    RED,
    TURQUOISE,
    VIEWS,
    VIOLET,
    WHITE,
    YELLOW,
    Color,
    Entry,
    part,
    row,
    series,
)
from services.drawing.events import event_style
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import Bool, Float64, Image, Status, ThreadState, Truth

Strip = tuple[Float64, Color]
"""(k, 3) points of a piece of the curve, and its colour."""

_STATUS_COLORS = {Status.TRACKING: GREEN, Status.OCCLUDED: AMBER, Status.LOST: RED}
_NONE = np.empty((0, 3))
_S = np.linspace(0, 1, 241)
"""Parameters of a drawn curve."""
_ARROW_EVERY = 10
_ARROWS_AT = _S[::_ARROW_EVERY]
_DASH = 5
_WORST_SIGMA_PX = 8.0
_LEVELS = 4
_AHEAD_S = 0.1
_LONGEST_STEP_S = 0.5


def states(
    states: Sequence[ThreadState],
    before: Mapping[str, ThreadState],
    rig: StereoRig,
    published_ns: int,
) -> Iterator[Entry]:
    """The curves: over both images, in space, and as plots; `before` are the last states by thread."""
    points = [_points(state) for state in states]
    strips = [_strips(state, line, rig) for state, line in zip(states, points, strict=True)]
    curves = [state.curve.control_points for state in states if state.curve is not None]
    yield from _overlays([strip for pieces in strips for strip in pieces], curves, rig)
    for state, line, pieces in zip(states, points, strips, strict=True):
        arrows = line[::_ARROW_EVERY]
        slope = _NONE if state.curve is None else nurbs.derivative(state.curve, _ARROWS_AT)
        yield from _in_space(state, arrows, slope, pieces, rig)
        yield from _motion(state, before.get(state.thread), arrows, slope, rig)
        yield from _plots(state, rig)
        numbers = row("ThreadState", **_numbers(state, published_ns))
        yield f"/rig/thread/{part(state.thread)}/nurbs", numbers


def truth(truth: Truth, rig: StereoRig) -> Iterator[Entry]:
    """The true thread of a synthetic scene: over both images, and in space."""
    numbers = {
        "thread": truth.thread,
        "capture_ns": truth.stamp.capture_ns,
        "released_ns": truth.stamp.released_ns,
        "length": truth.length,
        "visible": truth.visible,
    }
    line = row(rr.LineStrips3D, strips=[truth.points])
    yield f"/rig/truth/{part(truth.thread)}", line, row("Truth", **numbers)
    few = truth.points[np.linspace(0, len(truth.points) - 1, len(_S)).astype(int)]
    for view, pixels in zip(VIEWS, rig.project_raw(few), strict=True):
        strip = row(rr.LineStrips2D, strips=[_finite(pixels)])
        yield f"/rig/{view}/image/truth/{part(truth.thread)}", strip


def truth_style(thread: str) -> Iterator[Entry]:
    """Colour and width of a true thread; all of it static."""
    yield f"/rig/truth/{part(thread)}", rr.LineStrips3D.from_fields(colors=PINK, radii=-0.5)
    for view in VIEWS:
        # Below the curve, so that it shows where the curve is not.
        style = rr.LineStrips2D.from_fields(colors=PINK, radii=-1.0, draw_order=10)
        yield f"/rig/{view}/image/truth/{part(thread)}", style


def overlay_style() -> Iterator[Entry]:
    """Colours and widths of what is drawn over the images; all of it static."""
    for view in VIEWS:
        yield (
            f"/rig/{view}/image/curve",
            rr.LineStrips2D.from_fields(radii=-1.5),
            rr.Points2D.from_fields(colors=RED, radii=-3.0),
        )


def thread_style(thread: str) -> Iterator[Entry]:
    """Names, colours and widths of one thread's plots; all of it static."""
    plots, statuses = f"/plots/{part(thread)}", list(_STATUS_COLORS)
    yield f"{plots}/energy/image", series(left=BLUE, right=ORANGE)
    yield f"{plots}/energy/end", series(ends=VIOLET)
    yield f"{plots}/energy/internal", series(bending=TURQUOISE)
    yield f"{plots}/length", series(length=GREEN)
    yield f"{plots}/control_points", series(control_points=RED)
    yield f"{plots}/speed", series(mean=TURQUOISE, fastest=ORANGE)
    colors = [(*c, 255) for c in _STATUS_COLORS.values()]
    yield f"{plots}/status", rr.StateConfiguration(values=statuses, colors=colors)
    root = f"/rig/thread/{part(thread)}"
    yield f"{root}/curve", rr.LineStrips3D.from_fields(radii=-2.0)
    yield f"{root}/control_points", rr.Points3D.from_fields(colors=RED, radii=-3.5)
    yield f"{root}/tangent", rr.Arrows3D.from_fields(colors=WHITE, radii=-0.75)
    yield f"{root}/reliability", rr.Points3D.from_fields(radii=-2.5)
    yield f"{root}/velocity", rr.Arrows3D.from_fields(colors=TURQUOISE, radii=-1.0)
    yield from event_style(thread)


def _overlays(
    strips: list[Strip], control_points: list[Float64], rig: StereoRig
) -> Iterator[Entry]:
    colors, ends = _colors(strips), np.cumsum([len(line) for line, _ in strips])
    lines = _projected([line for line, _ in strips], rig)
    points = _projected(control_points, rig)
    for view, line, dots in zip(VIEWS, lines, points, strict=True):
        pieces = [_finite(piece) for piece in np.split(line, ends[:-1])] if strips else []
        yield (
            f"/rig/{view}/image/curve",
            row(rr.LineStrips2D, strips=pieces, colors=colors),
            row(rr.Points2D, positions=_finite(dots)),
        )


def _projected(lines: list[Float64], rig: StereoRig) -> tuple[Float64, Float64]:
    return rig.project_raw(np.concatenate(lines)) if lines else (_NONE[:, :2], _NONE[:, :2])


def _in_space(
    state: ThreadState, arrows: Float64, slope: Float64, strips: list[Strip], rig: StereoRig
) -> Iterator[Entry]:
    root = f"/rig/thread/{part(state.thread)}"
    lines = [line for line, _ in strips]
    yield f"{root}/curve", row(rr.LineStrips3D, strips=lines, colors=_colors(strips))
    control_points = samples = _NONE
    reliable = np.empty((0, 3), np.uint8)
    if state.curve is not None:
        control_points = state.curve.control_points
        samples = nurbs.evaluate(state.curve, np.linspace(0, 1, len(state.sigma)))
        reliable = _reliability_colors(state.sigma * rig.focal / samples[:, 2], state.seen)
    yield f"{root}/control_points", row(rr.Points3D, positions=control_points)
    vectors = slope / max(len(slope), 1)
    yield f"{root}/tangent", row(rr.Arrows3D, origins=arrows, vectors=vectors)
    yield f"{root}/reliability", row(rr.Points3D, positions=samples, colors=reliable)


def _motion(
    state: ThreadState, before: ThreadState | None, arrows: Float64, slope: Float64, rig: StereoRig
) -> Iterator[Entry]:
    """Where the curve will be in a tenth of a second; along itself its motion cannot be seen."""
    ahead = _NONE
    speed = [np.nan, np.nan]
    seconds = 0.0 if before is None else (state.stamp.capture_ns - before.stamp.capture_ns) / 1e9
    if state.curve and before and before.curve and 0 < seconds < _LONGEST_STEP_S:
        velocity = (arrows - nurbs.evaluate(before.curve, _ARROWS_AT)) / seconds
        along = (velocity * slope).sum(axis=1) / (slope * slope).sum(axis=1)
        velocity -= along[:, None] * slope
        ahead = velocity * _AHEAD_S
        mm = np.linalg.norm(velocity, axis=1) * rig.mm_per_unit
        speed = [float(mm.mean()), float(mm.max())]
    motion = row(rr.Arrows3D, origins=arrows[: len(ahead)], vectors=ahead)
    yield f"/rig/thread/{part(state.thread)}/velocity", motion
    yield f"/plots/{part(state.thread)}/speed", row(rr.Scalars, scalars=speed)


def _plots(state: ThreadState, rig: StereoRig) -> Iterator[Entry]:
    root, energies = f"/plots/{part(state.thread)}", state.energies
    image = [energies.image_left, energies.image_right]
    length_mm = state.length * rig.mm_per_unit
    count = 0 if state.curve is None else len(state.curve.control_points)
    yield f"{root}/energy/image", row(rr.Scalars, scalars=image)
    yield f"{root}/energy/end", row(rr.Scalars, scalars=energies.end)
    yield f"{root}/energy/internal", row(rr.Scalars, scalars=energies.internal)
    yield f"{root}/length", row(rr.Scalars, scalars=length_mm)
    yield f"{root}/control_points", row(rr.Scalars, scalars=float(count))
    yield f"{root}/status", row(rr.StateChange, state=[str(state.status)])


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


def _colors(strips: list[Strip]) -> Image:
    """(k, 3) RGB."""
    return np.array([color for _, color in strips], np.uint8).reshape(-1, 3)


def _points(state: ThreadState) -> Float64:
    return _NONE if state.curve is None else nurbs.evaluate(state.curve, _S)


def _strips(state: ThreadState, points: Float64, rig: StereoRig) -> list[Strip]:
    """The curve in pieces: solid in the colour of its reliability where it is seen, dashed where it
    is not, gray where it is lost."""
    if state.curve is None:
        return []
    if state.status is Status.LOST:
        return [(piece, GRAY) for piece in _dashes(points)]
    nearest = np.rint(_S * (len(state.seen) - 1)).astype(int)
    badness = _badness(state.sigma[nearest] * rig.focal / points[:, 2])
    level = np.minimum((badness * _LEVELS).astype(int), _LEVELS - 1)
    level[~state.seen[nearest]] = -1
    edges = [0, *(np.flatnonzero(np.diff(level)) + 1), len(_S)]
    strips: list[Strip] = []
    for start, stop in pairwise(edges):
        piece = points[start : stop + 1]
        if level[start] >= 0:
            strips.append((piece, _LEVEL_COLORS[level[start]]))
        else:
            strips += [(dash, AMBER) for dash in _dashes(piece)]
    return strips


def _dashes(points: Float64) -> list[Float64]:
    return [points[i : i + _DASH] for i in range(0, len(points), 2 * _DASH)]


def _finite(pixels: Float64) -> Float64:
    return pixels[np.isfinite(pixels).all(axis=1)]


def _reliability_colors(sigma_px: Float64, seen: Bool) -> Image:
    """(K, 3) RGB; gray where unseen."""
    return np.where(seen[:, None], _ramp(_badness(sigma_px)), GRAY).astype(np.uint8)


def _badness(sigma_px: Float64) -> Float64:
    """From 0, where the images hold the curve, to 1."""
    return np.clip(np.nan_to_num(sigma_px, nan=np.inf) / _WORST_SIGMA_PX, 0, 1)


def _ramp(badness: Float64) -> Image:
    """(K, 3) RGB from green over yellow to red."""
    places, colors = (0.0, 0.5, 1.0), np.array([GREEN, YELLOW, RED], float).T
    return np.stack([np.interp(badness, places, c) for c in colors], axis=1).astype(np.uint8)


_LEVEL_COLORS: list[Color] = [tuple(color) for color in _ramp(np.linspace(0, 1, _LEVELS)).tolist()]

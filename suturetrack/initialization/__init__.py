"""From one seed to the first curve (Section V): grow, match, merge, fit."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.initialization.abreast import tell_apart
from suturetrack.initialization.confidence import judge
from suturetrack.initialization.config import InitializationConfig
from suturetrack.initialization.ends import move_end, read_end
from suturetrack.initialization.fitting import refine
from suturetrack.initialization.flanks import runs_beside_itself
from suturetrack.initialization.growth import grow_thread
from suturetrack.initialization.hypotheses import Hypothesis, find_thread
from suturetrack.initialization.knots import fit_marks, image_parameters
from suturetrack.initialization.matching import Match, match, raised, row_offset
from suturetrack.initialization.result import (
    Growth,
    Initialization,
    InitializationError,
    PlacedDoubts,
    ViewGrowth,
    in_words,
    nearest_ridges,
    remaining,
)
from suturetrack.initialization.samples import Samples
from suturetrack.initialization.segments import Ridges, find_ridges, nearest_segment, thread_scale
from suturetrack.initialization.threads import Thread, follow_thread
from suturetrack.nurbs import curve_from
from suturetrack.polylines import nearest_index, polyline_distances
from suturetrack.types import Float32, Float64, Nurbs, RidgeField, Seed, read_only

__all__ = [
    "Growth",
    "Initialization",
    "InitializationConfig",
    "InitializationError",
    "PlacedDoubts",
    "ViewGrowth",
    "initialize",
    "remaining",
]


_SHORTEST_STEPS = 4
_LOOKS, _STILL_PX = 3, 0.5
"""How often a thread that runs beside itself is told apart, and by how far it then does not move any more."""
_FAINT = 0.15
"""Share of the thread's response below which nothing is shown of its ends."""
_LEAST_MATCH = 0.35
"""Median response of the right view, against the left one, below which it shows another scene."""


def initialize(
    field: RidgeField,
    rig: StereoRig,
    seed: Seed,
    config: InitializationConfig = InitializationConfig(),  # noqa: B008
) -> Initialization:
    """Finds the whole thread that `seed` lies on.

    Raises:
        InputError: the seed is outside the image, or behind the camera.
        InitializationError: there is no thread at the seed, or none like it in the right view.
    """
    pixel = rig.locate(seed)
    left = _ridges_of(field, 0, config)
    scale = thread_scale(left, pixel)
    if scale == 1:
        found = _initialize(field, left, rig, pixel, config, 1)
    else:
        found = _initialize_from_afar(field, rig, pixel, config, scale)
    return _with_rows_told(found)


def _initialize_from_afar(
    field: RidgeField, rig: StereoRig, pixel: Float64, config: InitializationConfig, scale: int
) -> Initialization:
    """A wide thread is looked at from farther away: all that follows is made for a narrow one."""
    left, right = (
        read_only(np.ascontiguousarray(view[::scale, ::scale]))
        for view in (field.left, field.right)
    )
    colours = field.colours and (field.colours[0].reduced(scale), field.colours[1].reduced(scale))
    reduced = RidgeField(field.stamp, left, right, colours=colours)
    try:
        ridges = _ridges_of(reduced, 0, config)
        found = _initialize(reduced, ridges, rig.reduced(scale), pixel / scale, config, scale)
    except InitializationError as error:
        growth = None if error.growth is None else error.growth.enlarged(scale, field.left.shape)
        candidates = scale * error.candidates
        raise InitializationError(error.reason, candidates, growth, swapped=error.swapped) from None
    return replace(
        found,
        reprojection_px=scale * found.reprojection_px,
        row_offset_px=scale * found.row_offset_px,
        growth=found.growth.enlarged(scale, field.left.shape),
    )


def _with_rows_told(found: Initialization) -> Initialization:
    if not found.row_offset_px:
        return found
    way = "lower" if found.row_offset_px > 0 else "higher"
    rows = abs(found.row_offset_px)
    said = f"the right view lies {rows:.1f} px {way} than the calibration says"
    return replace(found, reasons=(said, *found.reasons))


def _initialize(
    field: RidgeField,
    left: Ridges,
    rig: StereoRig,
    pixel: Float64,
    config: InitializationConfig,
    scale: int,
) -> Initialization:
    """As `initialize`, in a field reduced by `scale`; only texts have pixels of the whole image."""
    origin, candidates = nearest_segment(left, pixel, config.snap_px)
    if origin is None:
        (at,) = in_words(pixel[None], rig, scale)
        near = nearest_ridges(candidates, rig, scale)
        reason = f"no thread within {config.snap_px:g} px of the seed {at}; {near}"
        raise InitializationError(reason, candidates)
    thread = follow_thread(left, origin, config)
    start = _Start(left, thread, candidates, rig, pixel, config, scale)
    infinity = rig.disparity_at_infinity
    rows = row_offset(thread.chain.pixels, field.left, field.right, infinity)
    if not rows:
        return _reconstruct(start, field)
    found: Initialization | None = None
    with suppress(InitializationError):
        found = _reconstruct(start, field)
    colours = field.colours and (field.colours[0], field.colours[1].raised(rows))
    moved = RidgeField(field.stamp, field.left, raised(field.right, rows), colours=colours)
    try:
        other = _reconstruct(start, moved, are_moved=True)
    except InitializationError:
        if found is None:
            raise
        return found
    # Those rows are believed that the crests of both views then ask to move least.
    if found is not None and abs(found.row_offset_px) <= abs(other.row_offset_px):
        return found
    total = rows + other.row_offset_px
    return replace(other, curve=_halfway(other.curve, rows, rig), row_offset_px=total)


def _ridges_of(field: RidgeField, side: int, config: InitializationConfig) -> Ridges:
    view = field.right if side else field.left
    return find_ridges(view, config, field.colours and field.colours[side])


def _halfway(curve: Nurbs, rows: float, rig: StereoRig) -> Nurbs:
    """A curve on the rows of the left view, half as far from those of the right view's `rows` lower."""
    points = curve.control_points.copy()
    points[:, 1] += rows / 2 * points[:, 2] / rig.left.projection[1, 1]
    return curve_from(curve.degree, curve.knots, points)


@dataclass(frozen=True, eq=False)
class _Start:
    """A thread of the left view, by itself, and what it is looked for with in the right one."""

    left: Ridges
    thread: Thread
    candidates: Float64
    """(k, 2) of `InitializationError`."""
    rig: StereoRig
    pixel: Float64
    """(2,) the seed."""
    config: InitializationConfig
    scale: int
    """What makes the pixels of all these those of the whole image."""


def _reconstruct(start: _Start, field: RidgeField, *, are_moved: bool = False) -> Initialization:
    """The curve of a thread of the left view; `are_moved` as of `refine`."""
    rig, config, infinity = start.rig, start.config, start.rig.disparity_at_infinity
    ridges = start.left, _ridges_of(field, 1, config)
    found = find_thread(field, ridges, start.thread, start.pixel, infinity, config)
    step = max(1, round(config.step_px))
    marks = found.pixels[::step].reshape(-1, 2, 2)
    growth = Growth(*_growths(found, ridges[1], start.pixel, config), marks)
    if len(found.pixels) < _SHORTEST_STEPS * step:
        reason = f"the ridge at the seed is only {start.scale * len(found.pixels)} px long"
        raise InitializationError(reason, start.candidates, growth)
    if not _is_matched(found.matched):
        other = match(found.left.chain.pixels, field.left, field.right, infinity, -1)
        swapped = _is_matched(other)
        raise InitializationError(_no_match(swapped), start.candidates, growth, swapped=swapped)
    fields = found.left.field, field.right if found.right is None else found.right.field
    try:
        curve, samples, sigma, rows = _fit(found, fields, rig, config, are_moved=are_moved)
    except FloatingPointError as error:
        reason = f"no curve fits both views: {error}"
        raise InitializationError(reason, start.candidates, growth) from None
    shown = rig.with_row_offset(rows)
    confidence, reasons, doubts, is_alone = judge(
        curve, samples, sigma, found.chains, ridges, shown, start.scale
    )
    distance = samples.distance_px
    first = Initialization(
        curve, confidence, reasons, distance, growth, doubts, is_alone=is_alone, row_offset_px=rows
    )
    return first.meaning(either=found.left.meets_another_at(start.pixel))


def _fit(
    found: Hypothesis,
    fields: tuple[Float32, Float32],
    rig: StereoRig,
    config: InitializationConfig,
    *,
    are_moved: bool,
) -> tuple[Nurbs, Samples, Float64, float]:
    """What `refine` makes of a thread in both views. One that runs beside itself is told apart again from
    nearer by, for as long as that moves it."""
    curve, pixels = _first_curve(_trim(found.pixels, found.left), rig, config), found.pixels[::2]
    for _ in range(_LOOKS):
        views = tell_apart(fields, pixels, found.others)
        fit = refine(curve, views, rig, are_moved=are_moved)
        _, samples, _, rows = fit
        before, pixels = pixels, np.hstack(rig.with_row_offset(rows).project(samples.points))
        if not _runs_elsewhere(pixels, before):
            break
        curve = fit_marks(samples.points, samples.s, _spans(samples.length_px, config))
    return fit


def _runs_elsewhere(pixels: Float64, before: Float64) -> bool:
    """Whether a thread, (k, 4) left and right pixels, runs beside itself, and not where (m, 4) did."""
    views = [(pixels[:, at : at + 2], before[:, at : at + 2]) for at in (0, 2)]
    return any(runs_beside_itself(now) for now, _ in views) and any(
        polyline_distances(now, then).max() > _STILL_PX for now, then in views
    )


def _first_curve(pixels: Float64, rig: StereoRig, config: InitializationConfig) -> Nurbs:
    """The curve through the stereo points of a (k, 4) chain, left and right pixels."""
    s = image_parameters(pixels[:, :2], pixels[:, 2:])
    points = rig.triangulate(pixels[:, :2], pixels[:, 2:])
    return fit_marks(points, s, _spans(len(s), config))


def _spans(length_px: float, config: InitializationConfig) -> int:
    return max(int(length_px / (2 * config.step_px)), 4)


def _trim(pixels: Float64, left: Thread) -> Float64:
    """Moves both ends of the (k, 4) chain, left and right pixels, to where the left thread ends."""
    shown = left.ridges.sample(pixels[:, :2])
    inside = np.flatnonzero(shown >= _FAINT * np.median(shown))
    pixels = pixels[inside[0] : inside[-1] + 1]
    for _ in (0, 1):
        reading = read_end(left.field, pixels[:, :2])
        if np.isfinite(reading.offset_px):
            pixels = move_end(pixels, reading.offset_px)
        pixels = pixels[::-1]
    return pixels


def _growths(
    found: Hypothesis, right: Ridges, seed: Float64, config: InitializationConfig
) -> tuple[ViewGrowth, ViewGrowth]:
    left = grow_thread(found.left, seed, config)
    if found.right is None:
        cost = np.full(right.magnitude.shape, np.inf, np.float32)
        return left, ViewGrowth(cost, (), np.empty((0, 2, 2)), ())
    pixels = found.pixels
    there = pixels[nearest_index(pixels[:, :2], seed), 2:]
    return left, grow_thread(found.right, there, config)


def _is_matched(matched: Match) -> bool:
    return bool(np.median(matched.response) >= _LEAST_MATCH)


def _no_match(swapped: bool) -> str:
    reason = "the right view shows no thread along the epipolar lines of the left one"
    if swapped:
        reason += ", but it does on the other side: left and right are swapped"
    return reason

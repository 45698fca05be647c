"""Where the thread ends: the step of the ridge response along the curve and beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.ends import before_a_hole, narrowness
from suturetrack.kernels.boundary import outer_boundary
from suturetrack.tracking.sampling import View, derivatives_at, distinct, views, views_at
from suturetrack.types import Float64, Nurbs, RidgeField

_STEP_PX = 0.5
_INWARD_PX, _OUTWARD_PX = 40.0, 10.0
# Samples of whose responses the mean is taken.
_SMOOTHED = 5
# Where the curve tells how long a pixel is.
_ALONG = np.linspace(0, 1, 51)
# An end that points along the line of sight is taken to be foreshortened to this part of the rest, at most.
_FORESHORTENED = 0.5
# An end that a view shows further away than this from the curve's own is another one, or covered.
_SHOWN_PX = 3.0


@dataclass(frozen=True)
class EndStep:
    """What the images show at one end."""

    offset_px: float
    """How far beyond the curve's end the thread ends, px along the curve; negative: before it."""
    pixel: float
    """Length of a pixel there, as a part of the curve's length."""
    at_border: bool
    """Whether the image's border cuts the thread."""
    alone: bool = True
    """Whether no other ridge runs beside the end, which it could run on along."""
    on_another: bool = False
    """Whether another thread is known to lie there: what goes on beyond the end may be that one."""

    @property
    def offset(self) -> float:
        """The offset as a part of the curve's length."""
        return self.offset_px * self.pixel


def find_end(
    curve: Nurbs,
    end: int,
    field: RidgeField,
    rig: StereoRig,
    levels: tuple[float, float],
) -> EndStep | None:
    """Looks for the step of the response at the end `end` (0 or 1), in both images at once.

    None where there is no thread near the end.
    """
    scale = _px_per_s(curve, end, rig)
    x, both, responses = _profiles(curve, end, field, rig, levels, scale)
    inside = both[0].inside(rig.image_size) & both[1].inside(rig.image_size)
    if np.count_nonzero(inside) < _SMOOTHED:
        return None
    narrow = [
        response * narrowness(image, view.pixels, view.tangents, x)
        for image, view, response in zip((field.left, field.right), both, responses, strict=True)
    ]
    x, mean, least, alone = (
        x[inside],
        _smooth(np.mean(responses, axis=0)[inside]),
        np.min(responses, axis=0)[inside],
        _smooth(np.mean(narrow, axis=0)[inside]),
    )
    found, level = outer_boundary(x, mean, np.minimum(_smooth(least) + 0.15, mean))
    if math.isnan(found):
        return None
    boundary = before_a_hole(x, alone, level, found)
    at_border = not inside.all() and boundary > x[-1] - 3
    return EndStep(boundary, 1 / scale, at_border)


def end_shift(
    curve: Nurbs,
    end: int,
    field: RidgeField,
    rig: StereoRig,
    levels: tuple[float, float],
) -> tuple[float, Float64] | None:
    """By how much further the right view shows the thread at the end `end` (0 or 1) than the left.

    It tells the depth of the end where the thread runs along an epipolar line.

    Returns:
        The difference in px along the curve, and its (3,) derivative by the place of the end; None
        where the views do not both show the end.
    """
    scale = _px_per_s(curve, end, rig)
    x, both, responses = _profiles(curve, end, field, rig, levels, scale)
    tip = int(np.searchsorted(x, 0.0))
    shown, rows = [], []
    for view, response in zip(both, responses, strict=True):
        smooth = _smooth(response)
        found, _ = outer_boundary(x, smooth, smooth)
        # Not where it is nan, either.
        if not (view.inside(rig.image_size).all() and abs(found) <= _SHOWN_PX):
            return None
        shown.append(found)
        rows.append(view.tangents[tip] @ view.jacobian[tip] / view.speed[tip])
    outward = scale if end else -scale
    return shown[1] - shown[0], outward * (rows[1] - rows[0])


def _profiles(
    curve: Nurbs,
    end: int,
    field: RidgeField,
    rig: StereoRig,
    levels: tuple[float, float],
    scale: float,
) -> tuple[Float64, tuple[View, View], list[Float64]]:
    """(k,) px beyond the end, the curve there in both images, and their (k,) responses."""
    x = np.arange(-min(_INWARD_PX, 0.5 * scale), _OUTWARD_PX + 0.1, _STEP_PX)
    both = views(rig, *_extension(curve, end, np.asarray(x / scale, np.float64)))
    responses = [
        np.minimum(view.responses(image) / level, 1.2)
        for image, view, level in zip((field.left, field.right), both, levels, strict=True)
    ]
    return x, both, responses


def _smooth(profile: Float64) -> Float64:
    return np.asarray(uniform_filter1d(profile, _SMOOTHED, mode="nearest"))


# What the length of a thread may change by from one field to the next.
_DRAWN_PX = 6.0
# A thread is drawn out steadily: an end that leaps on by more than the first has met a tool. It makes the
# thread longer than it ever was by no more than the second, until it has insisted for so long; for twice as
# long as the length was steady, while that is not known.
_LEAP_PX, _LONGER_PX, _INSISTS_S = 2.5, 1.5, 5.0
# An end that is hidden steps off by at least this much before the curve's own.
_CUT_PX = 3.0
_SETTLING_S = 0.3
_HELD_S = 1.5
# A length that has kept within this part for so long is the thread's own.
_STEADY = 0.015
_SETTLED_S = 0.7
_FORGOTTEN_S = 3.0
_NS = 1e-9


class EndWatch:
    """Decides from field to field whether an end has moved, is hidden, or runs into something else.

    What one end loses and the other gains is the thread sliding along itself. A thread that is
    suddenly shorter at an end is hidden there, one that is suddenly longer than it ever was has met
    something that looks like it: its length is then held for a while, the more firmly the longer it
    was steady. An end that leaps on without growing so much is held as well, for fear of a tool that
    it runs on along; not for long where the length was not steady for long, for then something has
    come out of hiding. An end beside which another ridge runs makes good what is lacking, and gives back
    what is too much.

    Args:
        length: of the thread now.
        now_ns: capture time.
        before: a length that it had, and may have again: the rest was hidden.
    """

    def __init__(self, length: float, now_ns: int, before: float = 0.0) -> None:
        self._found_ns = now_ns
        self._last_ns = now_ns
        self._seen_ns = [now_ns, now_ns]
        self._steady_ns = now_ns
        self.length = self._longest = self._steady = length
        self._before = before
        self._is_known = False
        self._gone_on = [0.0, 0.0]
        """By how much the ends have gone on of late."""
        self.settled = False
        """Whether the length has been steady for long enough to be the thread's own."""
        self.wanted = length
        """Length that the thread would have if every step at its ends were believed, but for those along
        other threads that are known."""
        self.seen = (True, True)
        self.at_border = False
        """Whether the image's border cuts the thread."""

    def moves(
        self,
        start: EndStep | None,
        stop: EndStep | None,
        length: float,
        now_ns: int,
        *,
        is_known: bool = False,
    ) -> tuple[float, float]:
        """How far to move both ends outward, as parts of the curve's `length`.

        `is_known` says that the thread's length has settled once, before this watch began.
        """
        self._is_known |= is_known
        steps = start, stop
        offsets = [step.offset if step else 0.0 for step in steps]
        believed = [step.offset for step in steps if step and not step.on_another]
        self.wanted = length * (1.0 + sum(believed))
        doubted = self._doubted(steps, offsets, length, now_ns)
        seen = [end not in doubted for end in (0, 1)]
        for end in doubted:
            lacking = self.length / length - 1.0 - offsets[1 - end]
            step = steps[end]
            bound = 0.0 if step is None else _DRAWN_PX * step.pixel
            if step is not None and not step.alone:
                offsets[end] = max(min(max(step.offset, 0.0), lacking), -bound)
            elif len(doubted) == 2:
                offsets[end] = 0.0
            else:
                offsets[end] = min(max(lacking, -bound), bound)
                if step is not None and step.offset_px > 0:
                    # What is too long lies elsewhere, but for what either end has gone on.
                    gone_on = self._gone_on[end] / length + max(offsets[1 - end], 0.0)
                    gone_on += _LONGER_PX * step.pixel
                    offsets[end] = max(offsets[end], min(-gone_on, 0.0))
        for end in (0, 1):
            if seen[end]:
                self._seen_ns[end] = now_ns
            self._gone_on[end] = self._fading(now_ns) * self._gone_on[end] + offsets[end] * length
        self.seen = seen[0], seen[1]
        self.at_border = any(step and step.at_border for step in steps)
        if doubted:
            self._steady_ns += max(now_ns - self._last_ns, 0)
        else:
            self._remember(length * (1.0 + sum(offsets)), now_ns)
        self._last_ns = now_ns
        return offsets[0], offsets[1]

    def _doubted(
        self,
        steps: tuple[EndStep | None, EndStep | None],
        offsets: list[float],
        length: float,
        now_ns: int,
    ) -> list[int]:
        """The ends whose steps do not count."""
        doubted = [end for end, step in enumerate(steps) if step is None or not step.alone]
        shown = [step for step in steps if step]
        if doubted or any(step.at_border for step in shown):
            return doubted
        if (now_ns - self._found_ns) * _NS < _SETTLING_S:
            return []
        unseen_s = [(now_ns - seen_ns) * _NS for seen_ns in self._seen_ns]
        pixel = max(step.pixel for step in shown) * length
        total = length * (1.0 + sum(offsets))
        longer = int(np.argmax(offsets))
        steady_s = (now_ns - self._steady_ns) * _NS
        insists_s = _INSISTS_S if self._is_known else max(2 * steady_s, _SETTLING_S)
        growth = _LONGER_PX if shown[longer].offset_px > _LEAP_PX else _DRAWN_PX
        if (
            unseen_s[longer] < insists_s
            and total > max(self.length, self._longest, self._before) + growth * pixel
        ):
            return [longer]
        if total < self.length - _DRAWN_PX * pixel:
            doubted = [
                end
                for end, step in enumerate(shown)
                if step.offset_px < -_CUT_PX
                and offsets[end] <= min(offsets) / 2
                # What the other end gains is not hidden.
                and sum(offsets) <= offsets[end] / 2
            ]
        return [end for end in doubted if unseen_s[end] < _HELD_S]

    def _remember(self, length: float, now_ns: int) -> None:
        if abs(length / self._steady - 1) > _STEADY:
            self._steady, self._steady_ns = length, now_ns
        self._steady += 0.02 * (length - self._steady)
        self.settled = (now_ns - self._steady_ns) * _NS > _SETTLED_S
        self._is_known |= self.settled
        self.length = self._steady if self.settled else length
        if not self.at_border:
            fading = self._fading(now_ns)
            self._longest = max(length, length + (self._longest - length) * fading)

    def _fading(self, now_ns: int) -> float:
        """What is left of what was remembered at the last field."""
        return math.exp(-max(now_ns - self._last_ns, 0) * _NS / _FORGOTTEN_S)


def _px_per_s(curve: Nurbs, end: int, rig: StereoRig) -> float:
    left, right = views_at(rig, curve, _ALONG)
    speed = (left.speed + right.speed) / 2
    at_end = speed[-2:].mean() if end else speed[:2].mean()
    return max(float(at_end), _FORESHORTENED * float(speed.mean()), 1e-6)


def _extension(curve: Nurbs, end: int, beyond: Float64) -> tuple[Float64, Float64]:
    """Points and derivatives at `beyond` past the end: the curve itself, then a parabola."""
    sign = 1.0 if end else -1.0
    inner = float(end) + sign * np.minimum(beyond, 0.0)
    outer = np.maximum(beyond, 0.0)[:, None]
    points, first, _ = derivatives_at(curve, inner)
    _, slope, second = derivatives_at(curve, float(end) - sign * np.linspace(0, 0.04, 5))
    tip, bend = slope[0], second.mean(axis=0)
    points = points + outer * sign * tip + outer**2 / 2 * bend
    first = np.where(outer > 0, tip + sign * outer * bend, first)
    return points, first


def with_ends(curve: Nurbs, start: float, stop: float) -> Nurbs:
    """The curve over [start, stop]; beyond its ends only where it has knots for that."""
    inner = distinct(curve.knots)[[1, -2]]
    if len(curve.control_points) > 4 and start < inner[0] and stop > inner[1]:
        return nurbs.with_ends(curve, start, stop)
    return nurbs.part(curve, max(start, 0.0), min(stop, 1.0))

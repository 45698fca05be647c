"""One thread, held from field to field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.tracking import gauss_newton, paper
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.control_points import rearrange, respace
from suturetrack.tracking.ends import find_end
from suturetrack.tracking.energies import energies
from suturetrack.tracking.gauss_newton import Fit
from suturetrack.tracking.sampling import Samples, views
from suturetrack.types import Bool, Float64, Nurbs, RidgeField, Status, ThreadState

RELIABILITY_SAMPLES = 64
_LONGEST_STEP_S = 0.25
_LOST_AFTER_S = 0.2
_NS = 1e-9
_KEPT_VELOCITY = 0.8
_SETTLING_S = 0.3
_HELD_END_S = 1.5
# How far an end moves along the thread from one field to the next.
_DRAWN_IN_PX = 4.0


@dataclass
class Model:
    """What is known of the thread after a field."""

    curve: Nurbs
    velocity: Float64
    """(n + 1, 3) of the control points, calibration's unit per second."""
    levels: tuple[float, float]
    """Response of a clear view of the thread, left and right."""
    capture_ns: int
    seen_ns: int
    """When enough of the thread was last seen."""
    found_ns: int
    """When it was found."""
    end_seen_ns: list[int]
    """When each end was last seen."""
    status: Status = Status.TRACKING

    @property
    def moving(self) -> Nurbs:
        """The curve with its velocity as further coordinates."""
        return nurbs.curve_from(
            3, self.curve.knots, np.c_[self.curve.control_points, self.velocity]
        )

    @moving.setter
    def moving(self, both: Nurbs) -> None:
        self.curve = nurbs.curve_from(3, both.knots, both.control_points[:, :3])
        self.velocity = both.control_points[:, 3:]


class Follower:
    """Holds one thread's model and moves it from field to field."""

    def __init__(self, curve: Nurbs, field: RidgeField, rig: StereoRig, config: TrackingConfig):
        self.rig, self.config = rig, config
        levels = measure_levels(curve, field, rig)
        now = field.stamp.capture_ns
        self.model = Model(
            curve, np.zeros_like(curve.control_points), levels, now, now, now, [now, now]
        )
        curve, velocity, _, _ = rearrange(curve, self.model.velocity, rig)
        self.model.curve, self.model.velocity = curve, velocity

    def step(self, field: RidgeField, thread: str) -> ThreadState:
        """The thread in the next field."""
        model = self.model
        events: list[str] = []
        dt = (field.stamp.capture_ns - model.capture_ns) * _NS
        if self.config.method == "paper":
            fit, seen, share, inserted, removed = self._follow_by_forces(field)
        else:
            fit, seen, share, inserted, removed = self._follow_by_least_squares(field, dt)
        if inserted or removed:
            events.append(f"control points: {inserted} inserted, {removed} removed")
        model.capture_ns = field.stamp.capture_ns
        if share >= 0.5:
            model.seen_ns = model.capture_ns
        return self._state(field, thread, fit, seen, share, events)

    def _follow_by_forces(self, field: RidgeField) -> tuple[Fit, Bool, float, int, int]:
        model, config = self.model, self.config
        cutoffs = (
            paper.cutoff(field.left, model.levels[0]),
            paper.cutoff(field.right, model.levels[1]),
        )
        curve = paper.fit(model.curve, field, self.rig, cutoffs, config.paper)
        fit = gauss_newton.observe(curve, field, self.rig, model.levels, config)
        model.curve, model.velocity, inserted, removed = respace(
            curve, model.velocity, self.rig, config.paper.spacing_px
        )
        seen = both_seen(fit)
        return fit, seen, seen_share(fit, seen), inserted, removed

    def _follow_by_least_squares(
        self, field: RidgeField, dt: float
    ) -> tuple[Fit, Bool, float, int, int]:
        model, config = self.model, self.config
        predicted = self._predict(dt)
        fit = gauss_newton.fit(predicted, field, self.rig, model.levels, config.search_px, config)
        seen = both_seen(fit)
        share = seen_share(fit, seen)
        if share < 0.8:
            wide = gauss_newton.fit(
                predicted, field, self.rig, model.levels, config.wide_search_px, config
            )
            wide_seen = both_seen(wide)
            if seen_share(wide, wide_seen) > share + 0.05:
                fit, seen, share = wide, wide_seen, seen_share(wide, wide_seen)
        self._learn_motion(fit, predicted, dt)
        model.curve = fit.curve
        if share > 0.3:
            self._adjust_ends(field, dt)
        model.curve, model.velocity, inserted, removed = rearrange(
            model.curve, model.velocity, self.rig
        )
        return fit, seen, share, inserted, removed

    def _predict(self, dt: float) -> Nurbs:
        model = self.model
        if not 0 < dt <= _LONGEST_STEP_S:
            return model.curve
        return nurbs.curve_from(
            3, model.curve.knots, model.curve.control_points + model.velocity * dt
        )

    def _learn_motion(self, fit: Fit, predicted: Nurbs, dt: float) -> None:
        if not 0 < dt <= _LONGEST_STEP_S:
            self.model.velocity *= 0
            return
        surprise = (fit.curve.control_points - predicted.control_points) / dt
        velocity = self.model.velocity + 0.5 * (fit.gain @ surprise[:, :, None])[:, :, 0]
        unknown = velocity - (fit.gain @ velocity[:, :, None])[:, :, 0]
        self.model.velocity = velocity - (1 - _KEPT_VELOCITY) * unknown

    def _adjust_ends(self, field: RidgeField, dt: float) -> None:
        """Moves the ends to the steps that the images show.

        An end that vanishes at once, and not as fast as a thread can be drawn in, is hidden: it is
        held for a while.
        """
        model, now = self.model, field.stamp.capture_ns
        fresh = (now - model.found_ns) * _NS < _SETTLING_S
        steps = [find_end(model.curve, end, field, self.rig, model.levels) for end in (0, 1)]
        offsets = [step.offset_px if step else 0.0 for step in steps]
        vanished = sum(offsets) < -_DRAWN_IN_PX
        moves = [0.0, 0.0]
        for end, step in enumerate(steps):
            if step is None:
                continue
            if not vanished or step.offset_px > -_DRAWN_IN_PX:
                model.end_seen_ns[end] = now
            elif not fresh and (now - model.end_seen_ns[end]) * _NS < _HELD_END_S:
                continue
            moves[end] = step.offset
        if any(moves):
            model.moving = _with_ends(model.moving, -moves[0], 1.0 + moves[1])
            if 0 < dt <= _LONGEST_STEP_S:
                self._learn_slide(moves, dt)

    def _learn_slide(self, moves: list[float], dt: float) -> None:
        """The ends tell how fast the thread moves along itself, which its normals cannot."""
        curve = self.model.curve
        s = np.lib.stride_tricks.sliding_window_view(curve.knots[1:-1], 3).mean(axis=1)
        along = moves[1] * s - moves[0] * (1 - s)
        slide = along[:, None] * nurbs.derivative(curve, s)
        self.model.velocity = self.model.velocity + 0.5 * slide / dt

    def _state(
        self,
        field: RidgeField,
        thread: str,
        fit: Fit,
        seen: Bool,
        share: float,
        events: list[str],
    ) -> ThreadState:
        model = self.model
        unseen_s = (model.capture_ns - model.seen_ns) * _NS
        if share >= 0.5:
            status = Status.TRACKING
        else:
            status = Status.OCCLUDED if unseen_s < _LOST_AFTER_S or share > 0.2 else Status.LOST
        model.status = status
        at = np.linspace(0, 1, RELIABILITY_SAMPLES)
        sigma = np.sqrt(np.trace(fit.covariance, axis1=1, axis2=2))
        nearest = np.clip(np.searchsorted(fit.samples.s, at), 0, len(seen) - 1)
        cutoffs = model.levels[0] / 2, model.levels[1] / 2
        return ThreadState(
            stamp=field.stamp,
            thread=thread,
            status=status,
            curve=model.curve,
            length=nurbs.length(model.curve),
            energies=energies(model.curve, field, self.rig, cutoffs),
            sigma=np.interp(at, fit.samples.s, sigma),
            seen=seen[nearest],
            events=tuple(events),
        )


def both_seen(fit: Fit) -> Bool:
    """(k,) whether both images show the thread where the curve is."""
    left, right = fit.offsets
    with np.errstate(invalid="ignore"):
        near = np.all(np.abs(fit.residual) < 1.5, axis=1)
    return left.found & right.found & near


def seen_share(fit: Fit, seen: Bool) -> float:
    """Share of the curve's length that is seen."""
    return float(np.sum(fit.samples.share * seen))


def measure_levels(curve: Nurbs, field: RidgeField, rig: StereoRig) -> tuple[float, float]:
    """Median response along a curve that lies on the thread, left and right."""
    samples = Samples.of(curve.knots, 5)
    both = views(rig, samples.values(curve.control_points), samples.values(curve.control_points, 1))
    left, right = (
        float(np.median(search.responses(image, view.pixels, view.tangents)))
        for image, view in zip((field.left, field.right), both, strict=True)
    )
    return max(left, 0.05), max(right, 0.05)


def _with_ends(curve: Nurbs, start: float, stop: float) -> Nurbs:
    inner = np.unique(curve.knots)[[1, -2]]
    if start < inner[0] and stop > inner[1]:
        return nurbs.with_ends(curve, start, stop)
    return nurbs.part(curve, max(start, 0.0), min(stop, 1.0))

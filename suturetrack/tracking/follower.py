"""One thread, held from field to field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.tracking import gauss_newton, paper
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.control_points import rearrange
from suturetrack.tracking.ends import EndWatch, doubled_ends, find_end
from suturetrack.tracking.energies import energies
from suturetrack.tracking.motion import Motion
from suturetrack.tracking.reliability import Doubt, Evidence, judge
from suturetrack.tracking.sampling import Samples, distinct, length_of, values_at, views
from suturetrack.tracking.spacing import respace
from suturetrack.types import Nurbs, RidgeField, Status, ThreadState

_NS = 1e-9
# Searches, in units of the first: tried where less than the second is seen, taken if they show more.
_WIDER = ((2.5, 0.985, 0.01), (6.5, 0.8, 0.05))
_DROP = 0.01
_RETRY = 5


@dataclass
class Model:
    """What is known of the thread after a field."""

    curve: Nurbs
    motion: Motion
    levels: tuple[float, float]
    """Response of a clear view of the thread, left and right."""
    capture_ns: int
    seen_ns: int
    """When enough of the thread was last seen."""
    ends: EndWatch


class Follower:
    """Holds one thread's model and moves it from field to field."""

    def __init__(self, curve: Nurbs, field: RidgeField, rig: StereoRig, config: TrackingConfig):
        self.rig, self.config = rig, config
        now = field.stamp.capture_ns
        curve, _, _ = rearrange(curve, rig)
        levels = measure_levels(curve, field, rig)
        self.last_good = curve
        """The curve when it was last tracked."""
        self._doubt = Doubt()
        self._share = 1.0
        self.model = Model(curve, Motion.none(), levels, now, now, EndWatch(length_of(curve), now))

    @property
    def known_length(self) -> float:
        """Length of the thread when all of it was last seen, calibration's unit."""
        return self.model.ends.length

    def step(self, field: RidgeField, thread: str) -> ThreadState:
        """The thread in the next field."""
        model = self.model
        seconds = (field.stamp.capture_ns - model.capture_ns) * _NS
        before = model.curve
        model.capture_ns = field.stamp.capture_ns
        if self.config.method == "paper":
            evidence, inserted, removed = self._follow_by_forces(field)
        else:
            evidence, inserted, removed = self._follow_by_least_squares(field, seconds)
        seen = evidence.evenly()[1]
        self._doubt.grow(before, model.curve, seen, self.rig)
        if self.config.method != "paper":
            model.motion = model.motion.learn(
                before, model.curve, seen, model.ends.seen, self.rig, seconds
            )
        if evidence.share >= 0.5:
            model.seen_ns = model.capture_ns
            self._learn_levels(field)
        events = []
        if inserted or removed:
            events.append(f"control points: {inserted} inserted, {removed} removed")
        astray = evidence.astray(field, self.rig, model.levels)
        unseen_s = (model.capture_ns - model.seen_ns) * _NS
        status = judge(evidence, astray, self._doubt.share, unseen_s)
        if status is Status.TRACKING:
            self.last_good = model.curve
        return self._state(field, thread, evidence, status, events)

    def _follow_by_forces(self, field: RidgeField) -> tuple[Evidence, int, int]:
        model, config = self.model, self.config
        cutoffs = (
            paper.cutoff(field.left, model.levels[0]),
            paper.cutoff(field.right, model.levels[1]),
        )
        curve = paper.fit(model.curve, field, self.rig, cutoffs, config.paper)
        fit = gauss_newton.observe(curve, field, self.rig, model.levels, config)
        model.curve, inserted, removed = respace(curve, self.rig, config.paper.spacing_px)
        return Evidence.of(fit), inserted, removed

    def _follow_by_least_squares(
        self, field: RidgeField, seconds: float
    ) -> tuple[Evidence, int, int]:
        model = self.model
        predicted = model.motion.predict(model.curve, seconds)
        best = self._search(predicted, field)
        model.curve = best.fit.curve
        if best.share > 0.3:
            self._adjust_ends(field)
        start, stop = doubled_ends(model.curve, self.rig)
        if start or stop:
            model.curve = nurbs.part(model.curve, start, 1.0 - stop)
        model.curve, inserted, removed = rearrange(model.curve, self.rig)
        return best, inserted, removed

    def _search(self, predicted: Nurbs, field: RidgeField) -> Evidence:
        """Looks further away for what was seen before, and now and then for what is hidden."""
        levels, config = self.model.levels, self.config
        best = Evidence.of(
            gauss_newton.fit(predicted, field, self.rig, levels, config.search_px, config)
        )
        usual = 1.0 if field.stamp.frame % _RETRY == 0 else self._share - _DROP
        for times, enough, gain in _WIDER:
            if best.share >= min(enough, usual):
                break
            reach = times * config.search_px
            tried = Evidence.of(gauss_newton.fit(predicted, field, self.rig, levels, reach, config))
            if tried.share > best.share + gain:
                best = tried
        self._share = best.share
        return best

    def _adjust_ends(self, field: RidgeField) -> None:
        model = self.model
        steps = [find_end(model.curve, end, field, self.rig, model.levels) for end in (0, 1)]
        start, stop = model.ends.moves(
            steps[0], steps[1], length_of(model.curve), field.stamp.capture_ns
        )
        if start or stop:
            model.curve = _with_ends(model.curve, -start, 1.0 + stop)

    def _learn_levels(self, field: RidgeField) -> None:
        now = measure_levels(self.model.curve, field, self.rig)
        old = self.model.levels
        self.model.levels = (0.8 * old[0] + 0.2 * now[0], 0.8 * old[1] + 0.2 * now[1])

    def _state(
        self, field: RidgeField, thread: str, evidence: Evidence, status: Status, events: list[str]
    ) -> ThreadState:
        model = self.model
        sigma, seen = evidence.evenly()
        depth = values_at(model.curve, np.linspace(0, 1, len(sigma)))[:, 2]
        cutoffs = model.levels[0] / 2, model.levels[1] / 2
        return ThreadState(
            stamp=field.stamp,
            thread=thread,
            status=status,
            curve=model.curve,
            length=length_of(model.curve),
            energies=energies(model.curve, field, self.rig, cutoffs),
            sigma=np.hypot(sigma, self._doubt.px * depth / self.rig.focal),
            seen=seen,
            events=tuple(events),
        )


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
    inner = distinct(curve.knots)[[1, -2]]
    if len(curve.control_points) > 4 and start < inner[0] and stop > inner[1]:
        return nurbs.with_ends(curve, start, stop)
    return nurbs.part(curve, max(start, 0.0), min(stop, 1.0))

"""One thread, held from field to field."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.tracking import gauss_newton, paper
from suturetrack.tracking.alignment import shifted, shown
from suturetrack.tracking.bends import Bends
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.control_points import rearrange
from suturetrack.tracking.crowding import covered
from suturetrack.tracking.detours import led_back
from suturetrack.tracking.drift import Drift, HiddenEnds
from suturetrack.tracking.end_watch import EndWatch
from suturetrack.tracking.ends import EndStep, find_ends, with_ends
from suturetrack.tracking.energies import cutoff, energies, levels_along, measure_levels
from suturetrack.tracking.fitting import fit_widely
from suturetrack.tracking.folds import doubled_ends
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.memory import Memory
from suturetrack.tracking.motion import Motion
from suturetrack.tracking.mouth import Mouth
from suturetrack.tracking.regrowth import loose_tails, regrown
from suturetrack.tracking.reliability import (
    ASTRAY,
    EVENLY,
    MOST,
    RELIABILITY_SAMPLES,
    SOME,
    Evidence,
    judge,
    loose_ends,
)
from suturetrack.tracking.sampling import length_of, resampled, values_at, views_at
from suturetrack.tracking.spacing import respace
from suturetrack.tracking.strands import NOBODY, Neighbours, Strand
from suturetrack.tracking.whole import Whole
from suturetrack.types import Bool, Float64, Nurbs, RidgeField, Status, ThreadState

_NS = 1e-9
# An end that is drawn out further than the first is looked at again in the same field, so often at most.
_LEAP_PX, _LEAPS = 5.0, 6
# Share of the samples that is as good as all.
_ALL = 0.97
# And what of a lost thread has to be plain to see, where both ends are and the rest is hidden.
_BACK = 0.7
# Share of a curve that is seen, from which it is in sight.
_IN_SIGHT = 0.8
# How long after the last doubt it is certain again where the thread runs.
_SURE_AFTER_S = 0.08
# Standard deviation, against its length, from which on the images do not tell where a curve runs.
_VAGUE = 0.0225
# How long a doubtful end is held before it is cut off.
_PATIENCE_S = 0.06
# How often ends that are not seen are looked for elsewhere, and crowded stretches are led back.
_REGROWN_S = _LED_BACK_S = 0.09
# For how long a hidden end is taken to be where it was, and after how long it is gone.
_HIDDEN_S, _GONE_S = 0.3, 2.0
# For how long a curve is called tracking that is held in depth against what the views show.
_HELD_S = 0.3
# For how long after a kink a curve is not called tracking, and nothing is learned of its length.
_UNBENT_S, _SMOOTH_S = 0.1, 0.3
# For how long after a curve was not tracked it is looked for where it was before.
_TROUBLED_S = 2.0
# What has to be seen of the last good curve beyond what is seen of the rest, against the length.
_MORE = 0.05
# Places on a thread that keep other threads away.
_CLAIMS = 160
# Samples at an end that tell whether another ridge runs beside it.
_TIP = 3


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
        self.known_length = KnownLength(length_of(curve))
        self._whole = Whole.of(curve, now)
        self._memory = Memory()
        self._lost = False
        self._certain_ns = now
        """When it was certain last where the thread runs, and for a moment before."""
        self._doubted_ns = self._regrown_ns = self._led_back_ns = self._kinked_ns = -(1 << 62)
        self._untracked_ns = -(1 << 62)
        self._drift = Drift()
        self._bends = Bends()
        self._held: Bool = np.zeros(RELIABILITY_SAMPLES, bool)
        """Where the curve was held in depth in the last field, against what the views showed."""
        self._free_ns = now
        """When it was last held nowhere."""
        self._hidden = HiddenEnds(now)
        self._seen = np.ones(RELIABILITY_SAMPLES, bool)
        self._sigma: Float64 = np.zeros(RELIABILITY_SAMPLES)
        self._share_seen = 1.0
        self.is_crowded = self.makes_detour = False
        """Whether other ridges run beside the thread, and whether they have made the curve too long or
        too short."""
        self._is_clear = False
        self._comes_in = False
        """Whether the thread has been coming into the images since it was cut by their border."""
        self._leaps: Bool = np.zeros(2, bool)
        """Whether the ends were drawn out so far in the last field that there may be more."""
        self._mouths = Mouth(), Mouth()
        self.model = Model(curve, Motion.none(), levels, now, now, EndWatch(length_of(curve), now))

    def remember(self, before: Follower, *, is_sure: bool) -> None:
        """Takes over what was known of the thread's length before it was found anew."""
        known = self.known_length = self.known_length.inherited(
            before.known_length, is_sure=is_sure
        )
        if not is_sure:
            self._memory = before._memory
            self._whole = before._whole.learned(self.model.curve, self.model.capture_ns)
        self.model.ends = EndWatch(
            length_of(self.model.curve), self.model.capture_ns, max(known.possible)
        )

    def came_from(self, before: Nurbs, seconds: float) -> None:
        """Tells where the thread was found so many seconds ago."""
        model = self.model
        model.motion = Motion.none().learn(
            before, model.curve, self._seen, model.ends.seen, self.rig, seconds
        )

    @property
    def is_doubtful(self) -> bool:
        """Whether it has been uncertain for more than a moment where the thread runs."""
        return (self.model.capture_ns - self._certain_ns) * _NS > _PATIENCE_S

    @property
    def is_in_sight(self) -> bool:
        """Whether most of the curve was seen in the last field."""
        return self._share_seen >= _IN_SIGHT

    def strands(self, capture_ns: int) -> tuple[Strand, Strand]:
        """What is seen of the thread, where it should be at that time: others keep clear of it."""
        model = self.model
        curve = model.motion.predict(model.curve, (capture_ns - model.capture_ns) * _NS)
        s = np.linspace(0, 1, _CLAIMS)
        both = views_at(self.rig, curve, s)
        seen = resampled(self._seen, s)
        return Strand.other(both[0], seen), Strand.other(both[1], seen)

    def step(self, field: RidgeField, thread: str, neighbours: Neighbours = NOBODY) -> ThreadState:
        """The thread in the next field; `neighbours` are other threads."""
        model, events = self.model, list[str]()
        seconds = (field.stamp.capture_ns - model.capture_ns) * _NS
        images = Images(field, self.rig, model.levels)
        if self._lost or self.known_length.is_short(length_of(model.curve)):
            self._take_up_whole(self._predicted(seconds), images)
        if self.config.method != "paper" and not self._lost:
            self._go_on_beyond(self._predicted(seconds), images)
            if self._go_back(self._predicted(seconds), images, neighbours):
                events.append("taken back")
        model = self.model
        before, predicted = model.curve, self._predicted(seconds)
        model.capture_ns = field.stamp.capture_ns
        if self.config.method == "paper":
            evidence, inserted, removed = self._follow_by_forces(images, neighbours)
        else:
            evidence, inserted, removed = self._follow_by_least_squares(
                images, predicted, neighbours
            )
            self._learn_motion(before, evidence, seconds)
        self._drift.grow(before, predicted, model.curve, evidence.evenly_seen, self.rig)
        for further, more, fewer in self._follow_into_sight(images, neighbours):
            evidence, inserted, removed = further, inserted + more, removed + fewer
        if self.config.method != "paper":
            evidence = self._grow_ends_anew(images, evidence, neighbours)
            evidence = self._lead_back(images, evidence, neighbours)
        self._seen, self._sigma = evidence.evenly_seen, evidence.sigma
        if evidence.share >= MOST:
            model.seen_ns = model.capture_ns
            self._learn_levels(levels_along(evidence.fit.both, field))
            images = replace(images, levels=model.levels)
        if not self._held.any():
            self._free_ns = model.capture_ns
        if inserted or removed:
            events.append(f"control points: {inserted} inserted, {removed} removed")
        astray, plain = evidence.astray(images, neighbours), evidence.plain(neighbours)
        status = self._judge(evidence, astray, plain, seconds)
        return self._state(field, thread, status, events)

    def _predicted(self, seconds: float) -> Nurbs:
        """The curve so much later."""
        return self.model.motion.predict(self.model.curve, seconds)

    def _judge(self, evidence: Evidence, astray: Bool, plain: Bool, seconds: float) -> Status:
        """The status, and what follows from it for the next field."""
        model, drift = self.model, self._drift
        self._hidden.step(evidence.evenly_hidden & ~drift.outside, model.capture_ns)
        if self._bends.step(model.curve, evidence, seconds):
            self._kinked_ns = model.capture_ns
        wrong, uncertain_s = self._wrong(evidence, astray, plain, seconds)
        status = self._status(evidence, plain, uncertain_s)
        self._lost = status is Status.LOST
        if status is not Status.TRACKING:
            self._untracked_ns = model.capture_ns
        if status is Status.TRACKING:
            self.last_good = model.curve
            if evidence.fit.crowd.itself.any():
                self.known_length = self.known_length.looped(length_of(model.curve))
            self._memory = self._memory.learned(model.curve, self.known_length, model.capture_ns)
            known = Whole.of(model.curve, model.capture_ns) if model.ends.at_border else self._whole
            self._whole = known.learned(model.curve, model.capture_ns)
        elif self._lost and (
            evidence.share < SOME or self.known_length.is_beyond_hope(length_of(model.curve))
        ):
            self._start_again()
        elif self.config.method != "paper":
            if uncertain_s > _PATIENCE_S:
                self._trim(wrong | drift.hopeless)
            elif not self._lost and evidence.share >= SOME:
                self._give_up_hidden_ends()
        return status

    def _wrong(
        self, evidence: Evidence, astray: Bool, plain: Bool, seconds: float
    ) -> tuple[Bool, float]:
        """(K,) what of the curve is wrong, and for how long that, or its length, has been too much."""
        model, ends, length = self.model, self.model.ends, length_of(self.model.curve)
        known = self.known_length.watched(ends).found(length, ends)
        is_whole = plain.mean() > _ALL
        # Where all of it is plain to see and an end seems to go on, the end has met something else;
        # where it is not, the curve makes a detour.
        overlong = known.is_outgrown(length if is_whole else ends.wanted, evidence.length_noise)
        if plain.mean() >= 1 - ASTRAY and ends.settled and known.is_cut:
            known = known.given_up(min(known.now, ends.length))
        wrong = astray | (~plain & overlong)
        is_certain = (wrong | self._drift.anywhere).mean() <= ASTRAY
        is_certain &= not (overlong or known.is_short(length))
        has_ends = bool(plain[[0, 1, -2, -1]].all())
        is_smooth = (model.capture_ns - self._kinked_ns) * _NS > _SMOOTH_S
        if is_certain and is_whole and is_smooth and has_ends and not (self._lost or known.is_cut):
            known = known.learned(ends, seconds, is_clear=evidence.is_clear(plain))
        self.known_length = known
        if not is_certain:
            self._doubted_ns = model.capture_ns
        if (model.capture_ns - self._doubted_ns) * _NS > _SURE_AFTER_S:
            self._certain_ns = model.capture_ns
        return wrong, (model.capture_ns - self._certain_ns) * _NS

    def _status(self, evidence: Evidence, plain: Bool, uncertain_s: float) -> Status:
        """The status; a curve that was lost must have its length again, and be seen, to be held."""
        model, known, noise = self.model, self.known_length, evidence.length_noise
        length = length_of(model.curve)
        self._is_clear = is_clear = evidence.is_clear(plain)
        last = length_of(self.last_good)
        is_another = known.is_another(length, last, noise, is_clear=is_clear)
        self.is_crowded = bool(evidence.alone.mean() <= _ALL)
        is_longer = not is_clear and known.is_exceeded(length, noise)
        self.makes_detour = is_longer or (not is_clear and known.is_undercut(length, noise))
        if self._lost and (is_another or not self._is_back(plain, uncertain_s)):
            return Status.LOST
        status = judge(evidence, (model.capture_ns - model.seen_ns) * _NS, uncertain_s)
        is_vague = self._drift.gone.mean() > ASTRAY
        is_vague |= (model.capture_ns - self._kinked_ns) * _NS <= _UNBENT_S
        is_vague |= (model.capture_ns - self._free_ns) * _NS > _HELD_S
        is_vague |= any(self._hidden.for_longer_than(_HIDDEN_S))
        is_vague |= bool(self._leaps.any()) and not known.is_reached(length)
        is_vague |= bool(np.sqrt(np.mean(evidence.sigma**2)) > _VAGUE * length)
        if status is Status.TRACKING and (is_vague or is_longer):
            return Status.OCCLUDED
        return status

    def _is_back(self, plain: Bool, uncertain_s: float) -> bool:
        """Whether enough of a lost thread is plain to see: all, or all but what is hidden in between."""
        if plain.mean() >= 1 - ASTRAY:
            return True
        shows_ends = all(self.model.ends.seen) and not any(self._hidden.for_longer_than(0.0))
        return uncertain_s == 0 and shows_ends and plain.mean() >= _BACK

    def _trim(self, wrong: Bool) -> None:
        """Cuts off what has left the thread at an end, to be found anew."""
        start, stop = loose_ends(wrong)
        if 0 < start + stop < len(wrong) / 2:
            self._cut_off(start, stop)
            self.known_length = self.known_length.cut()

    def _give_up_hidden_ends(self) -> None:
        """What has been hidden at an end for long is no part of the thread until it is seen again."""
        start, stop = self._hidden.for_longer_than(_GONE_S)
        if 0 < start + stop < (1 - SOME) * RELIABILITY_SAMPLES:
            self._cut_off(start, stop)
            self._hidden = HiddenEnds(self.model.capture_ns)
            known = self.known_length = self.known_length.given_up(length_of(self.model.curve))
            self.model.ends = EndWatch(known.now, self.model.capture_ns, known.before_cut)

    def _cut_off(self, start: int, stop: int) -> None:
        """Takes so many samples off the ends."""
        last = RELIABILITY_SAMPLES - 1
        self.model.curve = nurbs.part(self.model.curve, start / last, 1 - stop / last)
        self._drift.cut(start, stop)
        self._bends = Bends()
        left = np.linspace(start / last, 1 - stop / last, RELIABILITY_SAMPLES)
        self._seen, self._held = resampled(self._seen, left), resampled(self._held, left)
        self._sigma = np.interp(left, EVENLY, self._sigma)

    def _start_again(self) -> None:
        """Looks from where the thread was last held, from the next field on."""
        model = self.model
        ends = EndWatch(self.known_length.now, model.capture_ns)
        self.model = replace(model, curve=self.last_good, motion=Motion.none(), ends=ends)

    def _take_up_whole(self, rest: Nurbs, images: Images) -> None:
        """Goes back to the last good curve, moved as a whole, if the images show more of it than of
        what is left."""
        whole = shifted(self.last_good, images)
        of_whole, of_rest = (length_of(curve) * shown(curve, images) for curve in (whole, rest))
        if of_whole > of_rest + _MORE * self.known_length.now:
            self.last_good = whole
            self._start_again()
            self._drift = Drift.everywhere()

    def _go_on_beyond(self, rest: Nurbs, images: Images) -> None:
        """Goes back to the whole thread where more of it shows beyond what hides an end."""
        whole = self._whole = self._whole.step(rest, images)
        if whole.is_found:
            self.known_length = self.known_length.again(whole.length)
            self.last_good = whole.curve
            self._start_again()
            self._drift = Drift()

    def _go_back(self, predicted: Nurbs, images: Images, neighbours: Neighbours) -> bool:
        """Goes back to where the thread was, if it still shows there; whether it does."""
        if (self.model.capture_ns - self._untracked_ns) * _NS > _TROUBLED_S:
            return False
        self._memory, before = self._memory.step(predicted, images, neighbours)
        if before is None:
            return False
        self.last_good, self.known_length = before
        self._start_again()
        self._drift, self._bends = Drift(), Bends()
        return True

    def _follow_by_forces(
        self, images: Images, neighbours: Neighbours
    ) -> tuple[Evidence, int, int]:
        model, config = self.model, self.config
        left, right = map(cutoff, images.both, images.levels)
        curve = paper.fit(model.curve, images.field, self.rig, (left, right), config.paper)
        fit = gauss_newton.observe(curve, images, config, neighbours)
        model.curve, inserted, removed = respace(curve, self.rig, config.paper.spacing_px)
        return Evidence.of(fit), inserted, removed

    def _follow_by_least_squares(
        self, images: Images, predicted: Nurbs, neighbours: Neighbours
    ) -> tuple[Evidence, int, int]:
        model = self.model
        best, self._held = fit_widely(
            model.curve,
            predicted,
            images,
            self._share_seen,
            self.config,
            neighbours.shown_in(images),
            self._own_length(),
            self._held,
        )
        self._share_seen = best.share
        # What was just drawn out may have been drawn out in depth.
        model.curve = best.without_half_seen_tips() if self._leaps.any() else best.fit.curve
        self._leaps = np.zeros(2, bool)
        if best.share > 0.3:
            known = covered(best.fit.both, neighbours)
            cut = length_of(best.fit.curve) / length_of(model.curve) - 1.0
            self._adjust_ends(images, best.fit.crowd.others, known, cut)
        self._cut_doubled_ends()
        model.curve, inserted, removed = rearrange(model.curve, self.rig)
        return best, inserted, removed

    def _own_length(self) -> float | None:
        """The thread's own length, where it was last seen from end to end and lay alone."""
        ends = self.model.ends
        return ends.length if self._is_clear and ends.is_constant else None

    def _learn_motion(self, before: Nurbs, evidence: Evidence, seconds: float) -> None:
        """An end that comes into sight does not move as fast as it is drawn out."""
        model, told = self.model, evidence.evenly_seen & evidence.alone
        first, last = np.array(model.ends.seen) & ~self._leaps
        model.motion = model.motion.learn(
            before, model.curve, told, (first, last), self.rig, seconds
        )

    def _follow_into_sight(
        self, images: Images, neighbours: Neighbours
    ) -> Iterator[tuple[Evidence, int, int]]:
        """Goes on in the same field while an end is drawn out far: by no more than the thread was long, for
        fear of a tool, or than comes in at the border."""
        model = self.model
        self._comes_in = model.ends.at_border or (self._comes_in and bool(self._leaps.any()))
        for _ in range(_LEAPS):
            before = model.curve
            may_be_longer = length_of(before) < max(self.known_length.possible)
            if not (self._leaps.any() and (self._comes_in or may_be_longer)):
                return
            step = self._follow_by_least_squares(images, before, neighbours)
            self._drift.grow(before, before, model.curve, step[0].evenly_seen, self.rig)
            yield step

    def _grow_ends_anew(
        self, images: Images, evidence: Evidence, neighbours: Neighbours
    ) -> Evidence:
        """Every now and then, the ends that are not plain to see, where the thread plainly ends elsewhere."""
        model, known = self.model, self.known_length
        rested_s = (model.capture_ns - self._regrown_ns) * _NS
        if not known.is_established or 0 <= rested_s < _REGROWN_S:
            return evidence
        tails = loose_tails(evidence.plain(neighbours))
        if not tails:
            return evidence
        self._regrown_ns = model.capture_ns
        fitted = partial(self._fitted, images, others=neighbours.shown_in(images))
        return self._taken(regrown(model.curve, tails, known, images, fitted), evidence)

    def _lead_back(self, images: Images, evidence: Evidence, neighbours: Neighbours) -> Evidence:
        """Every now and then, where other ridges run beside the thread, the curve without detours."""
        model = self.model
        rested_s = (model.capture_ns - self._led_back_ns) * _NS
        if not evidence.fit.crowd.others.any() or 0 <= rested_s < _LED_BACK_S:
            return evidence
        self._led_back_ns = model.capture_ns
        others, fitted = neighbours.shown_in(images), partial(self._fitted, images)
        found = led_back(model.curve, self.known_length, self.rig, others, fitted)
        return self._taken(found, evidence)

    def _fitted(self, images: Images, curve: Nurbs, others: Neighbours) -> Evidence:
        """A curve that was elsewhere, laid on the field."""
        reach_px = self.config.search_px
        return Evidence.of(gauss_newton.fit(curve, curve, images, reach_px, self.config, others))

    def _taken(self, found: Evidence | None, evidence: Evidence) -> Evidence:
        """Goes on with the curve that was found instead, if any."""
        if found is None:
            return evidence
        self.model.curve = found.fit.curve
        return found

    def _cut_doubled_ends(self) -> None:
        """Cuts off what has folded; a tip may lie on its own thread, where the curve is not too long."""
        model = self.model
        spare = max(1.0 - model.ends.length / length_of(model.curve), 0.0)
        start, stop = (
            tail.part if tail.is_fold else min(tail.part, spare)
            for tail in doubled_ends(model.curve, self.rig)
        )
        if start or stop:
            model.curve = nurbs.part(model.curve, start, 1.0 - stop)

    def _adjust_ends(self, images: Images, crowded: Bool, known: Bool, cut: float) -> None:
        """Moves the ends.

        Args:
            images: what shows them.
            crowded: (k,) samples beside other ridges.
            known: (k,) samples on other threads.
            cut: what tips were cut off to be found anew, as a part of the length that is left.
        """
        model = self.model
        tips = slice(_TIP), slice(-_TIP, None)
        ends = find_ends(model.curve, images)
        steps = [
            self._end_step(end, ends[end], bool(crowded[tip].any()), bool(known[tip].any()))
            for end, tip in enumerate(tips)
        ]
        start, stop = model.ends.moves(
            steps[0],
            steps[1],
            length_of(model.curve),
            images.field.stamp.capture_ns,
            is_known=self.known_length.is_established,
        )
        if start or stop:
            model.curve = with_ends(model.curve, -start, 1.0 + stop)
        self._leaps = np.array(
            [
                step is not None and min(moved, start + stop - cut) > _LEAP_PX * step.pixel
                for step, moved in zip(steps, (start, stop), strict=True)
            ]
        )

    def _end_step(
        self, end: int, step: EndStep | None, crowded: bool, on_another: bool
    ) -> EndStep | None:
        model = self.model
        alone = not (crowded or on_another)
        step = step and replace(step, alone=alone, on_another=on_another)
        other = self._mouths[1 - end]
        return self._mouths[end].steady(step, model.curve, end, other, self.rig, model.capture_ns)

    def _learn_levels(self, now: tuple[float, float]) -> None:
        old = self.model.levels
        self.model.levels = (0.8 * old[0] + 0.2 * now[0], 0.8 * old[1] + 0.2 * now[1])

    def _state(
        self, field: RidgeField, thread: str, status: Status, events: list[str]
    ) -> ThreadState:
        model = self.model
        depth = values_at(model.curve, EVENLY)[:, 2]
        return ThreadState(
            stamp=field.stamp,
            thread=thread,
            status=status,
            curve=model.curve,
            length=length_of(model.curve),
            energies=energies(model.curve, field, self.rig, model.levels),
            sigma=np.hypot(self._sigma, self._drift.px * depth / self.rig.focal),
            seen=self._seen,
            events=tuple(events),
        )

"""What a fitted curve is worth: what of it is seen, and whether the thread runs beside it instead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.metrics import arc_lengths
from suturetrack.nurbs import part
from suturetrack.tracking.gauss_newton import Fit
from suturetrack.tracking.sampling import View, values_at, views_at
from suturetrack.tracking.strands import SAME_STRAND_PX, Neighbours, Strand
from suturetrack.types import Bool, Float32, Float64, Int64, Nurbs, RidgeField, Status

RELIABILITY_SAMPLES = 64
_EVENLY = np.linspace(0, 1, RELIABILITY_SAMPLES)
_NEAR_PX = 1.5
_BESIDE_PX, _NOT_OWN_PX = np.arange(-30.0, 30.1, 1.5), 6.0
_NEXT_PX, _NOT_TAKEN_PX = np.arange(-10.0, 10.1, 1.0), 3.0
_CLEAR = 0.5
# Shares of the curve's length.
_MOST = 0.5
_SOME = 0.2
ASTRAY = 0.05
_LOST_AFTER_S = 0.2
_DRIFT = 0.35
_DRIFT_AT_REST_PX = 0.2
# How much of its drift is left to what moves as most of the thread does.
_TOGETHER = 0.2
_ANYWHERE_PX, _HOPELESS_PX, _GONE_PX, _MOVED_PX = 5.0, 15.0, 8.0, 2.0
# How far a hidden stretch bulges, of the way along it to what is seen, and what share of the curve has to be
# seen on both of its sides to hold it.
_BULGE, _HOLD = 0.15, 0.12
_GAP = 5
# Share that has to run alone, so that the others, which other ridges draw aside, hardly make it longer.
_CLEARLY = 0.94
_NOISE_SIGMAS = 3.0
# Share of the curve that the tips are at most.
_TIPS = 0.1
_BORDER_PX = 10.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one field says about a curve."""

    fit: Fit
    seen: Bool
    """(k,) at the fit's samples: both images show the thread there."""
    hidden: Bool
    """(k,) at the fit's samples: neither image does."""
    share: float
    """Share of the curve's length that is seen."""

    @classmethod
    def of(cls, fit: Fit) -> Evidence:
        """Judges each sample of the fit."""
        with np.errstate(invalid="ignore"):
            near = np.abs(fit.residual) < _NEAR_PX
        seen, hidden = np.all(near, axis=1), ~np.any(near, axis=1)
        return cls(fit, seen, hidden, float(np.sum(fit.samples.share * seen)))

    def without_half_seen_tips(self) -> Nurbs:
        """The curve without what only one image shows of it at its ends, if that is little: its depth is
        unknown, and it is found anew."""
        half, s = ~(self.seen | self.hidden), self.fit.samples.s
        start, stop = (int(np.argmin(flags)) for flags in (half, half[::-1]))
        if not 0 < start + stop <= _TIPS * len(half):
            return self.fit.curve
        return part(self.fit.curve, s[start] if start else 0.0, s[-1 - stop] if stop else 1.0)

    @cached_property
    def sigma(self) -> Float64:
        """(K,) standard deviation of the position, at evenly spaced parameters."""
        variance = np.trace(self.fit.covariance, axis1=1, axis2=2)
        return np.interp(_EVENLY, self.fit.samples.s, np.sqrt(variance))

    @cached_property
    def evenly_seen(self) -> Bool:
        """(K,) whether seen, at evenly spaced parameters."""
        return self._even(self.seen)

    @cached_property
    def evenly_hidden(self) -> Bool:
        """(K,) whether hidden, at evenly spaced parameters."""
        return self._even(self.hidden)

    @cached_property
    def alone(self) -> Bool:
        """(k,) whether no other ridge runs close beside the thread, at evenly spaced parameters."""
        return ~self._even(self.fit.crowd.others)

    @property
    def length_noise(self) -> float:
        """What noise in depth makes of a length."""
        return _NOISE_SIGMAS * float(np.median(self.sigma))

    def is_clear(self, plain: Bool) -> bool:
        """Whether nearly all of the thread is plain to see, with no other ridge beside it."""
        return bool((plain & self.alone).mean() > _CLEARLY)

    def astray(
        self,
        field: RidgeField,
        rig: StereoRig,
        levels: tuple[float, float],
        neighbours: Neighbours,
    ) -> tuple[Bool, Bool]:
        """(k,) whether the curve has left the thread, and whether it is plainly on it.

        It has left where both images show a thread beside a stretch that is unseen; and where it lies
        on another strand in an image, with a strand beside it that is nobody's. It is plainly on the
        thread where it is seen and lies on no other strand.
        """
        both, share = self.fit.views(rig), self.fit.samples.share
        unseen, left_alone, plain = ~self.seen, np.zeros(len(self.seen), bool), self.seen.copy()
        for image, view, level, others in zip(
            (field.left, field.right), both, levels, neighbours.both, strict=True
        ):
            own = Strand.of(view, share)
            all_seen = own.where(self.seen).joined(others)
            on_another = search.doubled(
                own.arrays, all_seen.arrays, SAME_STRAND_PX, search.APART_PX
            )
            double = self.seen & on_another
            unseen &= _beside(image, view, unseen, all_seen, _BESIDE_PX, _NOT_OWN_PX, level)
            left_alone |= _beside(image, view, double, all_seen, _NEXT_PX, _NOT_TAKEN_PX, level)
            plain &= ~double
        return self._even(unseen | left_alone), self._even(plain)

    def _even(self, flags: Bool) -> Bool:
        return flags[self._nearest]

    @cached_property
    def _nearest(self) -> Int64:
        s = self.fit.samples.s
        return np.clip(np.searchsorted(s, _EVENLY), 0, len(s) - 1)


def _beside(
    image: Float32,
    view: View,
    which: Bool,
    strands: Strand,
    offsets: Float64,
    near: float,
    level: float,
) -> Bool:
    """(k,) those of `which` samples beside which runs a thread that is further from all strands."""
    out = np.zeros(len(which), bool)
    if which.any():
        pixels, tangents = view.pixels[which], view.tangents[which]
        profiles = search.normal_profiles(image, pixels, tangents, offsets, 0.0)
        taken = search.covered(pixels, tangents, offsets, strands.pixels, near)
        out[which] = (np.where(taken, 0.0, profiles) > _CLEAR * level).any(axis=1)
    return out


class Doubt:
    """How far what is not seen may have moved away, px, at evenly spaced parameters.

    It grows with the curve's own motion there: a hidden stretch of a thread at rest stays where it
    was, and one that moves as the rest does goes on with it; one that was moving fast by itself may be
    anywhere, but for what a stretch that is held on both sides can bulge. What comes into the images is
    looked for anew.
    """

    def __init__(self) -> None:
        self.px: Float64 = np.zeros(RELIABILITY_SAMPLES)
        self.outside: Bool = np.zeros(RELIABILITY_SAMPLES, bool)
        """(k,) what is outside the images."""

    @classmethod
    def everywhere(cls) -> Doubt:
        """All may have moved, though not far: what is not seen at once is doubtful soon."""
        doubt = cls()
        doubt.px[:] = _MOVED_PX
        return doubt

    def grow(
        self, before: Nurbs, predicted: Nurbs, after: Nurbs, seen: Bool, rig: StereoRig
    ) -> None:
        """One field later, in which the curve moved from `before` to `after`."""
        s, both = _EVENLY, views_at(rig, after, _EVENLY)
        last, expected = (rig.project(values_at(curve, s))[0] for curve in (before, predicted))
        places = both[0].pixels
        outside = ~np.all([view.inside(rig.image_size, _BORDER_PX) for view in both], axis=0)
        moved, surprise = (_own_lengths(places - place, seen) for place in (last, expected))
        if seen.any():
            surprise = np.interp(s, s[seen], surprise[seen])
        drift = _DRIFT * moved + surprise + _DRIFT_AT_REST_PX
        comes_in = self.outside & ~outside
        doubted = np.minimum(np.hypot(self.px, drift), _BULGE * _from_held(seen, places))
        self.px = np.where(seen | comes_in, 0.0, doubted)
        self.outside = outside

    def cut(self, start: int, stop: int) -> None:
        """So many samples were cut off at the ends."""
        places = np.linspace(start, len(self.px) - 1 - stop, len(self.px))
        self.px = np.interp(places, np.arange(len(self.px)), self.px)
        self.outside = self.outside[np.rint(places).astype(int)]

    @property
    def anywhere(self) -> Bool:
        """(k,) what may be anywhere in the images."""
        return (self.px > _ANYWHERE_PX) & ~self.outside

    @property
    def hopeless(self) -> Bool:
        """(k,) what is surely elsewhere in the images."""
        return (self.px > _HOPELESS_PX) & ~self.outside

    @property
    def gone(self) -> Bool:
        """(k,) what has moved far outside the images, where it cannot be looked for."""
        return (self.px > _GONE_PX) & self.outside


def _own_lengths(steps: Float64, seen: Bool) -> Float64:
    """(k,) lengths of (k, 2) steps, without most of what is common to those that are seen."""
    lengths = np.linalg.norm(steps, axis=1)
    if not seen.any():
        return lengths
    apart = np.linalg.norm(steps - np.median(steps[seen], axis=0), axis=1)
    return np.minimum(lengths, apart + _TOGETHER * lengths)


def _from_held(seen: Bool, places: Float64) -> Float64:
    """(k,) way along (k, 2) places to the nearer of the long seen stretches around, px; infinite where
    there is none on one side."""
    held = search.solid(seen, np.ones(len(seen)), round(_HOLD * len(seen)))
    along = arc_lengths(places)
    before = np.maximum.accumulate(np.where(held, along, -np.inf))
    after = np.minimum.accumulate(np.where(held, along, np.inf)[::-1])[::-1]
    is_between = np.isfinite(before) & np.isfinite(after)
    return np.where(is_between, np.minimum(along - before, after - along), np.inf)


class HiddenEnds:
    """For how long what is next to the ends has been hidden, within the images.

    A stretch in the middle is held from both sides, one at an end from one side only: where its tip is
    nobody knows for long, and in the end it is gone, drawn away or cut off.
    """

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._shown_ns = [now_ns, now_ns]
        self._counts = 0, 0

    def step(self, hidden: Bool, now_ns: int) -> None:
        """Evenly spaced samples that are `hidden` now."""
        self._now_ns, self._counts = now_ns, (_run(hidden), _run(hidden[::-1]))
        for end, count in enumerate(self._counts):
            if count <= ASTRAY * len(hidden):
                self._shown_ns[end] = now_ns

    def for_longer_than(self, seconds: float) -> tuple[int, int]:
        """How many samples at the start and at the stop have been hidden for so long."""
        hidden_s = [(self._now_ns - shown_ns) * 1e-9 for shown_ns in self._shown_ns]
        start, stop = (
            count if time > seconds else 0
            for count, time in zip(self._counts, hidden_s, strict=True)
        )
        return start, stop


def _run(hidden: Bool) -> int:
    """How many are hidden before the first two that are not."""
    shown = np.flatnonzero(~hidden[:-1] & ~hidden[1:])
    return int(shown[0]) if len(shown) else len(hidden)


def loose_ends(wrong: Bool) -> tuple[int, int]:
    """How many of the evenly spaced samples at the start and at the stop are wrong, gaps included."""
    counts = []
    for flags in (wrong, wrong[::-1]):
        last = -1
        for j in np.flatnonzero(flags):
            if j - last > _GAP:
                break
            last = int(j)
        counts.append(last + 1)
    return counts[0], counts[1]


def judge(evidence: Evidence, unseen_s: float, uncertain_s: float) -> Status:
    """The status of a curve.

    Args:
        evidence: what the field says about it.
        unseen_s: time since half of it was last seen.
        uncertain_s: time since when more than a little of it may be anywhere or has another length.
    """
    if uncertain_s > _LOST_AFTER_S:
        return Status.LOST
    if evidence.share >= _MOST and uncertain_s == 0:
        return Status.TRACKING
    if evidence.share >= _SOME or unseen_s < _LOST_AFTER_S:
        return Status.OCCLUDED
    return Status.LOST

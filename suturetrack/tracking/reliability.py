"""What a fitted curve is worth: what of it is seen, and whether the thread runs beside it instead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from suturetrack.kernels import search
from suturetrack.nurbs import part
from suturetrack.tracking.gauss_newton import Fit
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import View, leading
from suturetrack.tracking.strands import SAME_STRAND_PX, Neighbours, Strand
from suturetrack.types import Bool, Float32, Float64, Int64, Nurbs, Status

RELIABILITY_SAMPLES = 64
EVENLY = np.linspace(0, 1, RELIABILITY_SAMPLES)
# Residual up to which an image shows the thread where the curve is.
_NEAR_PX = 1.5
# Where a thread is looked for beside what is unseen, and beside what lies on another strand, how far from all
# strands that are known, and its response, against a clear view's.
_BESIDE_PX, _NOT_OWN_PX = np.arange(-30.0, 30.1, 1.5), 6.0
_NEXT_PX, _NOT_TAKEN_PX = np.arange(-10.0, 10.1, 1.0), 3.0
_CLEAR = 0.5
# Shares of the curve's length: what has to be seen to be tracked, and to be held; what may be astray.
MOST, SOME, ASTRAY = 0.5, 0.2, 0.05
_LOST_AFTER_S = 0.2
# Samples from one that is wrong to the next one of the same end, at most.
_GAP = 5
# Share that has to run alone, so that the others, which other ridges draw aside, hardly make it longer.
_CLEARLY = 0.94
_NOISE_SIGMAS = 3.0
# What a fit leaves of the offsets, against their noise: it follows the rest. And so many samples it takes to
# tell, at least.
_LEFT_OVER, _FEWEST = 0.55, 10
# Share of the curve that the tips are at most.
_TIPS = 0.1


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
        """(K,) standard deviation of the position, at evenly spaced parameters; more than the fit's where
        it leaves more of the offsets, as of what moves fast or was compressed."""
        variance = np.trace(self.fit.covariance, axis1=1, axis2=2)
        return self._noisier * np.interp(EVENLY, self.fit.samples.s, np.sqrt(variance))

    @cached_property
    def _noisier(self) -> float:
        """How many times the noise that the fit assumed the offsets have, at least once."""
        crowd = self.fit.crowd
        left = self.fit.residual[self.seen & ~(crowd.others | crowd.itself)]
        if len(left) < _FEWEST:
            return 1.0
        return max(1.0, float(np.sqrt(np.mean(left**2))) / (_LEFT_OVER * self.fit.noise_px))

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

    @cached_property
    def length_noise(self) -> float:
        """What noise in depth makes of a length."""
        return _NOISE_SIGMAS * float(np.median(self.sigma))

    def is_clear(self, plain: Bool) -> bool:
        """Whether nearly all of the thread is plain to see, with no other ridge beside it."""
        return bool((plain & self.alone).mean() > _CLEARLY)

    def plain(self, neighbours: Neighbours) -> Bool:
        """(K,) whether the curve is plainly on the thread, at evenly spaced parameters: it is seen, and lies
        on no other strand."""
        left, right = (double for _, double in _strands_seen(self, neighbours))
        return self._even(self.seen & ~(left | right))

    def astray(self, images: Images, neighbours: Neighbours) -> Bool:
        """(K,) whether the curve has left the thread, at evenly spaced parameters.

        It has where both images show a thread beside a stretch that is unseen; and where it lies on
        another strand in an image, with a strand beside it that is nobody's.
        """
        unseen, left_alone = ~self.seen, np.zeros(len(self.seen), bool)
        shown = _strands_seen(self, neighbours)
        for image, view, level, (strands, double) in zip(
            images.both, self.fit.both, images.levels, shown, strict=True
        ):
            unseen &= _beside(image, view, unseen, strands, _BESIDE_PX, _NOT_OWN_PX, level)
            left_alone |= _beside(image, view, double, strands, _NEXT_PX, _NOT_TAKEN_PX, level)
        return self._even(unseen | left_alone)

    def _even(self, flags: Bool) -> Bool:
        return flags[self._nearest]

    @cached_property
    def _nearest(self) -> Int64:
        s = self.fit.samples.s
        return np.searchsorted((s[1:] + s[:-1]) / 2, EVENLY)


@lru_cache(maxsize=2)
def _strands_seen(evidence: Evidence, neighbours: Neighbours) -> tuple[tuple[Strand, Bool], ...]:
    """What each view shows of the thread and of others, and (k,) which seen samples lie on another strand."""
    shown = []
    for view, others in zip(evidence.fit.both, neighbours.both, strict=True):
        own = Strand.of(view, evidence.fit.samples.share)
        strands = own.where(evidence.seen).joined(others)
        double = search.doubled(own.arrays, strands.arrays, SAME_STRAND_PX, search.APART_PX)
        shown.append((strands, evidence.seen & double))
    return tuple(shown)


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


def loose_ends(wrong: Bool) -> tuple[int, int]:
    """How many of the evenly spaced samples at the start and at the stop are wrong, gaps included."""
    return leading(wrong, _GAP), leading(wrong[::-1], _GAP)


def judge(evidence: Evidence, unseen_s: float, uncertain_s: float) -> Status:
    """The status of a curve.

    Args:
        evidence: what the field says about it.
        unseen_s: time since half of it was last seen.
        uncertain_s: time since when more than a little of it may be anywhere or has another length.
    """
    if uncertain_s > _LOST_AFTER_S:
        return Status.LOST
    if evidence.share >= MOST and uncertain_s == 0:
        return Status.TRACKING
    if evidence.share >= SOME or unseen_s < _LOST_AFTER_S:
        return Status.OCCLUDED
    return Status.LOST

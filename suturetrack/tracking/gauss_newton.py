"""The default method: banded Gauss-Newton over the control points on stereo normal offsets.

Each sample of the curve is looked for along its normal in both images. The offsets found are rows in
the step of the control points, beside rows for the prediction, the stretch and the bending. Rows
count by the length of image curve that they stand for, so sampling and knots may change freely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from suturetrack.kernels import rows, search, spline
from suturetrack.nurbs import curve_from
from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.crowding import Crowd, crowded
from suturetrack.tracking.ends import end_shifts
from suturetrack.tracking.images import Images
from suturetrack.tracking.sampling import Samples, View, resampled
from suturetrack.tracking.strands import NOBODY, SAME_STRAND_PX, Neighbours, Strand
from suturetrack.types import Bool, Float32, Float64, Nurbs

# From place to place along the normals.
_STEP_PX = 0.5
# Offsets measured closer than this along the thread share their noise: the filter smears it.
_CORRELATION_PX = 4.0
# Reach of the search, and offset from which a measurement counts less, once rounds have halved both.
_REFINED_PX, _OUTLIER_PX = 3.0, 1.0
# How far what a view hides may leave the prediction, in depth as well, as a standard deviation.
_HIDDEN_DRIFT_PX = 3.0
# What a measurement is worth where another ridge, or another strand of the thread, draws it aside; and what
# the prediction is beside another ridge, in depth as well, against its errors around.
_CROWDED_WORTH, _CROWDED_HOLD = 0.02, 0.3
_LEAST_SURPRISE_PX, _SMOOTH = 0.3, 9
# Share of its second derivatives that the curve is asked to keep where the prediction holds, and the
# surprise from which on it does not.
_KEPT, _FAILED_PX = 0.95, 0.6
# A step that moves no sample further than this is the last: it is a part of what one reading is off.
_SETTLED_PX = 0.1
# So is the first one where the thread is as near as this to all of the curve: a second one moves no sample
# by more than 0.03 px in the median of fields.
_CALM_PX = 0.35
# How far from a free end, which nothing bends, it is asked to keep less.
_FREE_PX = 20.0
# A first search does not know the thread's direction yet where it has bent.
_LENIENCY = 0.4
# A local stretch comes and goes within so small a part of the curve: this is its inverse.
_EVEN = 150.0
# A thread that moves so far across itself between two fields is smeared to half its response.
_SMEARED_PX = 6.5
_LEAST_FADING = 0.25
# How well a known length is known, as a share of it, and what is further off is not that of the thread.
_LENGTH_DOUBT, _LENGTH_OUTLIER = 0.0015, 0.005
# What the views show differently at an end for other reasons than its depth, such as a hole.
_TIP_PX = 1.5


@dataclass(frozen=True, eq=False)
class Offsets:
    """What the search found beside the samples in one image."""

    offset: Float64
    """(k,) px along the normal, 0 where nothing was found."""
    response: Float64
    """(k,) of eq. (4) at the place found."""
    found: Bool
    """(k,)"""


@dataclass(frozen=True, eq=False)
class Fit:
    """A curve fitted to one field."""

    curve: Nurbs
    samples: Samples
    both: tuple[View, View]
    """The samples on the curve, left and right."""
    residual: Float64
    """(k, 2) px between the curve and what was found, left and right; nan where nothing was."""
    noise_px: float
    """Standard deviation that the offsets were taken to have."""
    covariance: Float64
    """(k, 3, 3) of the samples' positions, by that noise."""
    crowd: Crowd
    """Where other ridges run close beside the thread."""


def search_normals(
    image: Float32, view: View, share: Float64, level: Float64, reach_px: float, neighbours: Strand
) -> Offsets:
    """Looks for the thread along the normals of the samples, as one continuous line.

    What lies nearer to another strand of it, or to one of the `neighbours`, is theirs.
    """
    strand = Strand.of(view, share)
    every = strand.joined(neighbours)
    leniency = _LENIENCY if reach_px > _REFINED_PX else 0.0
    how = SAME_STRAND_PX, view.speed * share, level, reach_px, _STEP_PX, leniency
    return Offsets(*search.best_line(image, strand.arrays, every.arrays, *how))


def fit(
    before: Nurbs,
    predicted: Nurbs,
    images: Images,
    reach_px: float,
    config: TrackingConfig,
    neighbours: Neighbours = NOBODY,
    known_length: float | None = None,
    sprung: Bool | None = None,
) -> Fit:
    """Moves the predicted curve onto the field.

    Args:
        before: the curve in the last field, on the same knots.
        predicted: cubic, parametrised like its arc length.
        reach_px: how far along the normals the thread is looked for at first.
        neighbours: other threads that the field shows.
        known_length: of the thread, if it is known and all of it is in sight.
        sprung: (n,) at evenly spaced parameters, what the views tell no depth of.
    """
    samples = Samples.of(predicted.knots, config.samples_per_span)
    reference = _Reference.of(samples, predicted)
    control_points = predicted.control_points
    both = samples.views(images.rig, control_points)
    crowd = crowded(both, samples.share, images, neighbours)
    if sprung is not None:
        crowd = replace(crowd, others=crowd.others | resampled(sprung, samples.s))
    surprise: Float64 | None = None
    tips = end_shifts(predicted, images)
    faded = expected(before, samples, both, images)
    reach, outlier = reach_px, math.inf
    rounds = config.iterations + round(math.log2(max(reach_px / config.search_px, 1.0)))
    for _ in range(rounds):
        linear = _Linearized(samples, control_points, both, images, faded, reach, neighbours)
        surprise = linear.surprise(crowd) if surprise is None else surprise
        is_calm = linear.farthest_px < _CALM_PX
        if is_calm:
            outlier = _OUTLIER_PX
        equations = linear.equations(reference, faded, config, outlier, crowd, surprise)
        equations.add_tips(tips, predicted.control_points - control_points)
        step = equations.solve()
        if known_length is not None:
            step = linear.keeping_length(step, equations, known_length)
        control_points = control_points + step
        both = samples.views(images.rig, control_points)
        if is_calm or (math.isfinite(outlier) and linear.is_near(both)):
            break
        outlier = max(min(outlier, reach) / 2, _OUTLIER_PX)
        reach = max(reach / 2, _REFINED_PX)
    curve = curve_from(spline.DEGREE, predicted.knots, control_points)
    covariance = equations.covariance(samples)
    residual = _residual(both, linear)
    return Fit(curve, samples, both, residual, config.noise_px, covariance, crowd)


def observe(
    curve: Nurbs, images: Images, config: TrackingConfig, neighbours: Neighbours = NOBODY
) -> Fit:
    """What the field says about a curve that something else has fitted."""
    samples = Samples.of(curve.knots, config.samples_per_span)
    control_points = curve.control_points
    both = samples.views(images.rig, control_points)
    still = expected(curve, samples, both, images)
    crowd = crowded(both, samples.share, images, neighbours)
    linear = _Linearized(samples, control_points, both, images, still, _REFINED_PX, neighbours)
    reference, surprise = _Reference.of(samples, curve), linear.surprise(crowd)
    equations = linear.equations(reference, still, config, _OUTLIER_PX, crowd, surprise)
    equations.solve()
    residual, covariance = _residual(both, linear), equations.covariance(samples)
    return Fit(curve, samples, both, residual, config.noise_px, covariance, crowd)


def expected(
    before: Nurbs, samples: Samples, both: tuple[View, View], images: Images
) -> tuple[Float64, Float64]:
    """(k,) the response of the thread left and right where it moves, which smears it.

    Args:
        before: the curve in the last field.
        samples: where it is asked for.
        both: the samples in this field.
        images: what shows it.
    """
    last = images.rig.project(samples.values(before.control_points))
    left, right = (
        level * np.maximum(1 / (1 + (_across(view, pixels) / _SMEARED_PX) ** 4), _LEAST_FADING)
        for view, pixels, level in zip(both, last, images.levels, strict=True)
    )
    return left, right


def _across(view: View, pixels: Float64) -> Float64:
    """(k,) px along the normals from (k, 2) pixels to the samples."""
    return np.einsum("ij,ij->i", view.pixels - pixels, view.normals)


@dataclass(frozen=True, eq=False)
class _Reference:
    """What the curve should stay like where the images do not tell."""

    points: Float64
    """(k, 3) predicted samples."""
    second: Float64
    """(k, 3) predicted second derivatives."""
    speed: float
    """Length of the curve: |df/ds| everywhere."""

    @classmethod
    def of(cls, samples: Samples, curve: Nurbs) -> _Reference:
        points, first, second = (samples.values(curve.control_points, d) for d in range(3))
        return cls(points, second, float(np.sum(samples.share * _norm(first))))


class _Linearized:
    """The curve of one iteration in both images, and what was found beside it."""

    def __init__(
        self,
        samples: Samples,
        control_points: Float64,
        both: tuple[View, View],
        images: Images,
        levels: tuple[Float64, Float64],
        reach_px: float,
        neighbours: Neighbours,
    ) -> None:
        self.samples = samples
        self.points, self.first, self.second = (
            samples.values(control_points, times) for times in range(3)
        )
        self.views = both
        left, right = (
            search_normals(image, view, samples.share, level, reach_px, others)
            for image, view, level, others in zip(
                images.both, self.views, levels, neighbours.both, strict=True
            )
        )
        self.offsets = left, right
        self._hidden = ~(left.found | right.found)
        self._half_hidden = ~(left.found & right.found)
        self._amounts = [view.speed * samples.share / _CORRELATION_PX for view in self.views]
        self._per_unit = np.maximum(_norm(self.views[0].jacobian[:, 1]), 1e-12)

    def equations(
        self,
        reference: _Reference,
        levels: tuple[Float64, Float64],
        config: TrackingConfig,
        outlier_px: float,
        crowd: Crowd,
        surprise: Float64,
    ) -> _Equations:
        """The normal equations of the next step."""
        equations = _Equations(int(self.samples.first[-1]) + spline.ORDER)
        information, pull = self._past(reference, config, crowd, surprise)
        worth = np.where(crowd.others | crowd.itself, _CROWDED_WORTH, 1.0) / config.noise_px**2
        weights = []
        for amount, found, level in zip(self._amounts, self.offsets, levels, strict=True):
            weight = worth * amount * found.found * np.minimum(found.response / level, 1) ** 2
            weights.append(weight / (1 + (found.offset / outlier_px) ** 2) ** 2)
        together = crowd.others & ~self._half_hidden
        for view, found, weight in zip(self.views, self.offsets, weights, strict=True):
            alone = np.where(together, 0.0, weight)
            rows.add_measured_rows(
                view.tangents, view.jacobian, alone, found.offset, information, pull
            )
        if together.any():
            self._add_middle(together, weights[0] + weights[1], information, pull)
        equations.add(self.samples, 0, information, pull)
        equations.add(self.samples, 2, *self._shape(reference, config, surprise))
        return equations

    def _add_middle(
        self, which: Bool, weight: Float64, information: Float64, pull: Float64
    ) -> None:
        """Rows for the middle of what both views show at `which` samples, of the weight of both.

        What they show differently of ridges that blur into one another tells no depth.
        """
        both = [(view.normals[which, None] @ view.jacobian[which])[:, 0] for view in self.views]
        row = both[0] + both[1]
        offset = self.offsets[0].offset[which] + self.offsets[1].offset[which]
        weighted = weight[which, None] / 4 * row
        information[which] += weighted[:, :, None] * row[:, None, :]
        pull[which] += weighted * offset[:, None]

    def _past(
        self, reference: _Reference, config: TrackingConfig, crowd: Crowd, surprise: Float64
    ) -> tuple[Float64, Float64]:
        """The prediction.

        The drift is one of pixels, so that the past holds depth no tighter than the images do. Only
        where a view hides the thread, or it is not alone, it holds it in depth as well.
        """
        jacobians = self.views[0].jacobian, self.views[1].jacobian
        firmness = self._half_hidden / _HIDDEN_DRIFT_PX**2
        firmness += _CROWDED_HOLD * crowd.others / surprise**2
        drift = self._amounts[0] / config.drift_px**2 / 2
        held = firmness * self._amounts[0] * self._per_unit**2
        return rows.held_rows(jacobians, reference.points - self.points, drift, held)

    def _shape(
        self, reference: _Reference, config: TrackingConfig, surprise: Float64
    ) -> tuple[Float64, Float64]:
        """Little change of f'' across and along the tangent: a thread keeps its bends and its speed.

        So lengths stay where they were, which tells the depth of stretches along the epipolar lines. Where
        the prediction has failed, and at the ends, which each field draws out anew, little bending and an
        even speed are all there is to ask for. No speed is: noise in depth only ever adds to it, and a
        goal taken from the curve would keep what it adds.
        """
        speed = reference.speed
        bending = config.smoothing * self.samples.share / (self._per_unit * speed**3)
        stretch = self._amounts[0] / (config.stretch * speed) ** 2 / _EVEN**2
        kept = np.where(self._hidden, 1.0, _KEPT / (1 + (surprise / _FAILED_PX) ** 4))
        along = _CORRELATION_PX * np.cumsum(self._amounts[0])
        kept *= np.clip(np.minimum(along, along[-1] - along) / _FREE_PX, 0.0, 1.0)
        goal = kept[:, None] * reference.second - self.second
        return rows.shape_rows(self.first, goal, bending, stretch)

    def keeping_length(self, step: Float64, equations: _Equations, known: float) -> Float64:
        """The step with a last row, for the length of the whole.

        It tells how far stretches along the epipolar lines bow, of which the images show nothing. It is of
        the length that bends make: where the ends are is found elsewhere.
        """
        speed = _norm(self.first)
        length = float(np.sum(self.samples.share * speed))
        tangents = self.first / speed[:, None]
        row = self.samples.gather(self.samples.share[:, None] * tangents, 1)
        lacking = known - length - float(np.sum(row * step))
        row[0] += tangents[0]
        row[-1] -= tangents[-1]
        moved = equations.solve_for(row)
        doubt = _LENGTH_DOUBT * known * (1 + (lacking / (_LENGTH_OUTLIER * known)) ** 2)
        return step + lacking / (doubt**2 + float(np.sum(row * moved))) * moved

    def is_near(self, moved: tuple[View, View]) -> bool:
        """Whether the samples, which are there now, have hardly moved."""
        both = zip(moved, self.views, strict=True)
        steps = (float(np.abs(now.pixels - view.pixels).max()) for now, view in both)
        return max(steps) < _SETTLED_PX

    @property
    def farthest_px(self) -> float:
        """How far from the curve the thread was found, at most."""
        return max(float(np.abs(found.offset).max()) for found in self.offsets)

    def surprise(self, crowd: Crowd) -> Float64:
        """(k,) px by which the thread has left the curve where it is alone, and so in between."""
        left, right = (np.where(crowd.others, 0.0, np.abs(found.offset)) for found in self.offsets)
        away, either, s = np.maximum(left, right), ~(crowd.others | self._hidden), self.samples.s
        if not either.any():
            return np.ones(len(s))
        smooth = uniform_filter1d(away[either], _SMOOTH, mode="nearest")
        return np.asarray(_LEAST_SURPRISE_PX + np.interp(s, s[either], smooth))


class _Equations:
    """Normal equations of one step of the control points."""

    def __init__(self, count: int) -> None:
        self.band, self.gradient = spline.no_rows(count)

    def add_tips(self, tips: Sequence[tuple[float, Float64] | None], back: Float64) -> None:
        """Rows for what the views show differently at the ends.

        Args:
            tips: of `end_shifts`, of the predicted curve's start and stop.
            back: (n + 1, 3) from the control points to the predicted ones.
        """
        for end, tip in zip((0, -1), tips, strict=True):
            if tip is not None:
                shift, row = tip
                self._add_tip(end, row / _TIP_PX, (shift + float(row @ back[end])) / _TIP_PX)

    def _add_tip(self, end: int, row: Float64, right: float) -> None:
        """A row for the first or the last control point, which is the curve's end."""
        band, gradient = self.band[-3:] if end else self.band[:3], self.gradient.reshape(-1, 3)[end]
        gradient += right * row
        for i in range(3):
            band[i, : i + 1] += row[i] * row[i::-1]

    def solve(self) -> Float64:
        """(n + 1, 3) step; leaves the factor in the band."""
        spline.factorize(self.band)
        return self.solve_for(self.gradient)

    def solve_for(self, right: Float64) -> Float64:
        """(n + 1, 3) step for another right-hand side, after `solve`."""
        return spline.solve_factorized(self.band, right.reshape(-1)).reshape(-1, 3)

    def covariance(self, samples: Samples) -> Float64:
        """(k, 3, 3) of the samples, after `solve`."""
        inverse = spline.band_of_inverse(self.band)
        return spline.sample_covariance(samples.first, samples.table[0], inverse)

    def add(self, samples: Samples, times: int, information: Float64, pull: Float64) -> None:
        spline.add_rows(
            samples.first, samples.table[times], information, pull, self.band, self.gradient
        )


def _norm(vectors: Float64) -> Float64:
    squared = np.einsum("ij,ij->i", vectors, vectors)
    return np.asarray(np.maximum(np.sqrt(squared), np.finfo(float).tiny))


def _residual(moved: tuple[View, View], linear: _Linearized) -> Float64:
    """(k, 2) what is left of the offsets once the samples have moved there."""
    columns = [
        np.where(found.found, found.offset + _across(view, now.pixels), np.nan)
        for now, view, found in zip(moved, linear.views, linear.offsets, strict=True)
    ]
    return np.stack(columns, axis=1)

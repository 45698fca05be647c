"""From matched pixels to the curve: least squares, refined on the field, with few knots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.crest import Crest, View, find_crest
from suturetrack.initialization.ends import EndReading, read_end
from suturetrack.kernels import spline
from suturetrack.types import Float64, Nurbs

DEGREE = spline.DEGREE
SPACING_PX = 2.0
"""Distance of the samples that hold the curve, px."""
_LEAST_NOISE_PX = 0.03
_DENSE_ROUNDS = 4
_FINAL_ROUNDS = 3
_LEAST_SAMPLES = 3
_SIGNIFICANT = 25.0
"""Growth of a span's misfit, in units of the noise, that calls for a knot; four more unknowns grow
with it, and neighbouring samples err alike."""
_EVIDENCE_STEPS = 3
_STAY = 0.01
"""Weight, against that of a crest, which keeps samples from sliding along the thread."""
_STAY_DEEP = 3e-5
"""And one, of no weight where the crests tell, which keeps their disparity where they do not."""
_UNSEEN = 0.02
"""Trust in a crest below which a view does not see the thread."""
_STIFFEST = 1e9
_RIDGE = 1e-9
_END_NOISE_PX = 0.2
_OFF_PX = 0.2
"""By how much the rows of two views have to be off, at least, for that to be told from the bunching of
depth along the epipolar lines: calibrated ones seem to be off by up to 0.05."""
_SURELY = 4.0
"""Standard deviations by which they have to seem off, at least."""
_ANY_SLIP_PX = 1.0
"""What the rows may be off where no crest tells, px (standard deviation)."""
_LARGEST_END_STEP_PX = 2.0
_BEND_SAMPLES = 8.0
"""Samples over which the visible bending is averaged."""
_LEAST_FREEDOM = 0.3
"""What a straight stretch may bend in disparity, against one that bends as the thread on average."""


def image_parameters(left: Float64, right: Float64) -> Float64:
    """(k,) parameters from 0 to 1 in proportion to the mean length of the (k, 2) chains."""
    steps = [np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (left, right)]
    travelled = np.r_[0, np.cumsum(steps[0] + steps[1])]
    return travelled / travelled[-1]


def fit_marks(points: Float64, s: Float64, spans: int) -> Nurbs:
    """Least-squares curve through (k, 3) stereo points at parameters `s` (end of Section V)."""
    knots = nurbs.clamped_knots(np.linspace(0, 1, spans + 1)[1:-1], DEGREE)
    return _closest(knots, s, points, np.tile(np.eye(3), (len(s), 1, 1)))


_FARTHEST_PX = 1e5
"""Length in the images beyond which a curve has come apart."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Places on a curve, evenly spaced in the images, and what the images say there."""

    s: Float64
    """(k,) parameters."""
    points: Float64
    """(k, 3)."""
    length_px: float
    """Mean length of the projected curve."""
    jacobians: tuple[Float64, Float64]
    """(k, 2, 3) derivatives of the left and the right pixel."""
    crests: tuple[Crest, Crest]
    """The ridges of both views beside the curve."""
    outward: Float64
    """(2, 2, 2) view, end: unit vectors along the projected curve out of its ends."""
    ends: tuple[tuple[EndReading, EndReading], tuple[EndReading, EndReading]]
    """View, end: where the thread ends."""

    @classmethod
    def of(cls, curve: Nurbs, views: tuple[View, View], rig: StereoRig) -> Samples:
        """Samples `curve` and looks for the crests beside it.

        Raises:
            FloatingPointError: the curve has left the finite world.
        """
        fine = np.linspace(0, 1, 16 * len(curve.control_points))
        steps = [
            np.linalg.norm(np.diff(p, axis=0), axis=1)
            for p in rig.project(nurbs.evaluate(curve, fine))
        ]
        travelled = np.r_[0, np.cumsum((steps[0] + steps[1]) / 2)]
        if not travelled[-1] < _FARTHEST_PX:
            raise FloatingPointError("it runs out of both images")
        count = max(int(travelled[-1] / SPACING_PX), 2 * len(curve.control_points))
        s = np.interp(np.linspace(0, travelled[-1], count), travelled, fine)
        points = nurbs.evaluate(curve, s)
        pixels = rig.project(points)
        left, right = (find_crest(v, p) for v, p in zip(views, pixels, strict=True))
        outward = np.array([[p[0] - p[1], p[-1] - p[-2]] for p in pixels])
        outward /= np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-9)
        ends_left, ends_right = (
            (read_end(v.field, p), read_end(v.field, p[::-1]))
            for v, p in zip(views, pixels, strict=True)
        )
        return cls(
            s,
            points,
            float(travelled[-1]),
            rig.projection_jacobian(points),
            (left, right),
            outward,
            (ends_left, ends_right),
        )

    @property
    def rows_between_ends(self) -> Float64:
        """(2,) on how different rows the two views show each end; 0 where one does not tell, px."""
        offsets = np.array([[reading.offset_px for reading in ends] for ends in self.ends])
        left, right = offsets * self.outward[:, :, 1]
        return np.nan_to_num(left - right)

    @property
    def distance_px(self) -> float:
        """Mean distance from curve to crest, both views, px."""
        weights = np.concatenate([c.trust for c in self.crests])
        offsets = np.concatenate([np.abs(c.offsets) for c in self.crests])
        return float((weights * offsets).sum() / max(weights.sum(), 1e-9))

    @property
    def noise_px(self) -> float:
        """Root mean square of the offsets from curve to crest, px."""
        squares = sum((c.trust * c.offsets**2).sum() for c in self.crests)
        return float(np.sqrt(squares / max(sum(c.trust.sum() for c in self.crests), 1e-9)))


def refine(
    curve: Nurbs, views: tuple[View, View], rig: StereoRig
) -> tuple[Nurbs, Samples, Float64, float]:
    """Gauss-Newton on the crests of both views, as smooth as the evidence says, with few knots.

    Bending is measured in pixels, across the line of sight and in disparity apart, because the
    images inform depth far less; how much each is held back follows from the curve itself
    (MacKay's evidence).

    Args:
        curve: within a few pixels of the crests, with knots enough for any shape.
        views: left and right.
        rig: the cameras.

    Returns:
        The curve, what the images show beside it, (k,) the standard deviations of its samples, and
        how many px lower than the cameras say the right view shows the thread; 0 in doubt.
    """
    start = _Fit(curve, np.array([1.0, 100.0]))
    fit = start.improved(views, rig, _DENSE_ROUNDS)
    if abs(fit.slip_px) > max(_OFF_PX, _SURELY * fit.slip_sigma_px):
        fit = replace(fit, is_level=False).improved(views, rig, _DENSE_ROUNDS)
    fit = replace(fit, curve=with_needed_knots(fit.samples(views, rig)))
    fit = fit.improved(views, rig, _FINAL_ROUNDS)
    samples = fit.samples(views, rig)
    return fit.curve, samples, deviations(fit.curve, samples, fit.stiffness), fit.rows


@dataclass(frozen=True, eq=False)
class _Fit:
    """A curve on its way to the crests."""

    curve: Nurbs
    stiffness: Float64
    """(2,) what holds back the bending across the line of sight, and that in disparity."""
    is_level: bool = True
    """Whether the views are taken to be on the rows of the calibration."""
    rows: float = 0.0
    """By how many px the right view is taken to be lower."""
    slip_px: float = 0.0
    """By how many more the crests would have it."""
    slip_sigma_px: float = np.inf

    def samples(self, views: tuple[View, View], rig: StereoRig) -> Samples:
        return Samples.of(self.curve, views, rig.with_row_offset(self.rows))

    def improved(self, views: tuple[View, View], rig: StereoRig, rounds: int) -> _Fit:
        fit = self
        for _ in range(rounds):
            fit = _step(fit, fit.samples(views, rig))
        return fit


def deviations(curve: Nurbs, samples: Samples, stiffness: Float64) -> Float64:
    """(k,) standard deviations of the samples in space, by the noise of the crests."""
    noise = max(samples.noise_px, _LEAST_NOISE_PX) ** 2
    data, pull = _crest_equations(curve, samples)
    _add_ends(data, pull, samples, noise)
    across, bends = _bending_equations(curve, samples)
    factor = data / noise + stiffness[0] * across + stiffness[1] * bends
    if not spline.factorize(factor):
        raise FloatingPointError("the curve is not held by the images")
    first, table = spline.local_basis(samples.s, curve.knots)
    covariance = spline.sample_covariance(first, table[0], spline.band_of_inverse(factor))
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def with_needed_knots(samples: Samples) -> Nurbs:
    """A curve through the samples with as few knots as the crests allow.

    Spans are halved, by misfit, until none fits the crests significantly worse than the samples do.
    An end along an epipolar line has the depth of the samples: the crests say nothing of it.
    """
    disparity = _image_axes(samples)[:, 2:]
    held = _stay(samples) + _STAY_DEEP * np.einsum("kij,kil->kjl", disparity, disparity)
    information = sum(_information(samples), start=held)
    noise = max(samples.noise_px, _LEAST_NOISE_PX) ** 2
    interior = np.array([0.5])
    while True:
        curve = _closest(
            nurbs.clamped_knots(interior, DEGREE), samples.s, samples.points, information
        )
        moved = nurbs.evaluate(curve, samples.s) - samples.points
        excess = np.zeros(len(samples.s))
        for crest, jacobian in zip(samples.crests, samples.jacobians, strict=True):
            shift = np.einsum("ki,kij,kj->k", crest.normals, jacobian, moved)
            excess += crest.trust * ((crest.offsets - shift) ** 2 - crest.offsets**2)
        new = _splits(samples.s, excess / noise, interior)
        if not new:
            return curve
        interior = np.sort(np.r_[interior, new])


def _splits(s: Float64, excess: Float64, interior: Float64) -> list[float]:
    """Where spans with too much misfit are to be divided."""
    bounds = [0, *np.searchsorted(s, interior).tolist(), len(s)]
    new = []
    for a, b in pairwise(bounds):
        if b - a < 2 * _LEAST_SAMPLES or excess[a:b].sum() < _SIGNIFICANT:
            continue
        grown = np.cumsum(np.maximum(excess[a:b], 0))
        middle = int(np.searchsorted(grown, grown[-1] / 2))
        new.append(float(s[a + min(max(middle, _LEAST_SAMPLES), b - a - _LEAST_SAMPLES)]))
    return new


def _closest(knots: Float64, s: Float64, points: Float64, information: Float64) -> Nurbs:
    """The curve closest to (k, 3) points where (k, 3, 3) `information` says that it matters."""
    first, table = spline.local_basis(s, knots)
    count = len(knots) - DEGREE - 1
    band, gradient = np.zeros((3 * count, spline.BANDWIDTH)), np.zeros(3 * count)
    pull = np.einsum("kij,kj->ki", information, points)
    spline.add_rows(first, table[0], information, pull, band, gradient)
    band[:, 0] *= 1 + _RIDGE
    if not spline.factorize(band):
        raise FloatingPointError("the samples do not hold the curve")
    control_points = spline.solve_factorized(band, gradient).reshape(-1, 3)
    return nurbs.curve_from(DEGREE, knots, control_points)


def _step(fit: _Fit, samples: Samples) -> _Fit:
    curve, stiffness = fit.curve, fit.stiffness.copy()
    noise = max(samples.noise_px, _LEAST_NOISE_PX) ** 2
    data, pull = _crest_equations(curve, samples)
    _add_ends(data, pull, samples, noise)
    across, bends = _bending_equations(curve, samples)
    mixed, weight, shown = _slip_equations(curve, samples)
    c = curve.control_points.ravel()
    free = len(c) // 3 - 2
    step, slip, held_by = np.zeros_like(c), 0.0, 1.0
    for _ in range(_EVIDENCE_STEPS):
        factor = data / noise + stiffness[0] * across + stiffness[1] * bends
        if not spline.factorize(factor):
            raise FloatingPointError("the curve is not held by the images")
        smoothing = stiffness[0] * across + stiffness[1] * bends
        step = spline.solve_factorized(factor, pull / noise - _times(smoothing, c))
        # The slip is one more unknown, beside the band.
        per_px = spline.solve_factorized(factor, mixed / noise)
        held_by = weight - mixed @ per_px + noise / _ANY_SLIP_PX**2
        slip = (shown - mixed @ step) / held_by
        step = step if fit.is_level else step - slip * per_px
        inverse = spline.band_of_inverse(factor)
        for k, (energy, rank) in enumerate(((across, 2 * free), (bends, free))):
            held = rank - stiffness[k] * _trace(inverse, energy)
            bend = (c + step) @ _times(energy, c + step)
            stiffness[k] = min(max(held, 1.0) / max(bend, 1e-12), _STIFFEST)
    points = curve.control_points + step.reshape(-1, 3)
    rows = fit.rows if fit.is_level else fit.rows + slip
    curve = nurbs.curve_from(curve.degree, curve.knots, points)
    return _Fit(curve, stiffness, fit.is_level, rows, slip, float(np.sqrt(noise / held_by)))


def _slip_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, float, float]:
    """What the crests say about a slip of the right view's rows against the left one's: together
    with the control points, (3n,), its own weight, and what pulls at it."""
    first, table = spline.local_basis(samples.s, curve.knots)
    band, gradient = _empty(curve)
    weight = pull = 0.0
    nothing = np.zeros((len(samples.s), 3, 3))
    for side, crest, jacobian in zip((-0.5, 0.5), samples.crests, samples.jacobians, strict=True):
        down = side * crest.normals[:, 1]
        rows = np.einsum("ki,kij->kj", crest.normals, jacobian)
        mixed = (crest.trust * down)[:, None] * rows
        spline.add_rows(first, table[0], nothing, mixed, band, gradient)
        weight += float(crest.trust @ down**2)
        pull += float(crest.trust @ (down * crest.offsets))
    return gradient, weight, pull


def _crest_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, Float64]:
    first, table = spline.local_basis(samples.s, curve.knots)
    band, gradient = _empty(curve)
    views = zip(samples.crests, samples.jacobians, _information(samples), strict=True)
    for crest, jacobian, information in views:
        rows = np.einsum("ki,kij->kj", crest.normals, jacobian)
        pull = (crest.trust * crest.offsets)[:, None] * rows
        spline.add_rows(first, table[0], information, pull, band, gradient)
    nothing = np.zeros((len(samples.s), 3))
    spline.add_rows(first, table[0], _stay(samples), nothing, band, gradient)
    return band, gradient


def _information(samples: Samples) -> list[Float64]:
    """What the crests of each view say about a sample's place in space, each (k, 3, 3)."""
    information = []
    for crest, jacobian in zip(samples.crests, samples.jacobians, strict=True):
        rows = np.einsum("ki,kij->kj", crest.normals, jacobian)
        information.append(crest.trust[:, None, None] * rows[:, :, None] * rows[:, None])
    return information


def _stay(samples: Samples) -> Float64:
    """(k, 3, 3) what keeps the samples from sliding along the thread, and from going anywhere
    where a view does not see them."""
    normals = samples.crests[0].normals
    tangents = np.c_[normals[:, 1], -normals[:, 0]]
    rows = np.einsum("ki,kij->kj", tangents, samples.jacobians[0])
    image = _image_axes(samples)
    unseen = np.minimum(samples.crests[0].trust, samples.crests[1].trust) < _UNSEEN
    anywhere = unseen[:, None, None] * np.einsum("kij,kil->kjl", image, image)
    return _STAY * (rows[:, :, None] * rows[:, None] + anywhere)


def _add_ends(band: Float64, gradient: Float64, samples: Samples, noise: float) -> None:
    """Rows that draw the ends of the curve along itself to those of the thread.

    Views that show an end on different rows are not to be reconciled by its depth.
    """
    apart = samples.rows_between_ends
    for view, jacobian in enumerate(samples.jacobians):
        for end in (0, 1):
            reading = samples.ends[view][end]
            if np.isnan(reading.offset_px):
                continue
            row = samples.outward[view, end] @ jacobian[-end]
            weight = noise / (_END_NOISE_PX**2 + apart[end] ** 2 / 4)
            at = (len(gradient) - 3) * end
            offset = np.clip(reading.offset_px, -_LARGEST_END_STEP_PX, _LARGEST_END_STEP_PX)
            gradient[at : at + 3] += weight * offset * row
            for a in range(3):
                for b in range(a + 1):
                    band[at + a, a - b] += weight * row[a] * row[b]


def _bending_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, Float64]:
    """Bands of the bending across the line of sight and of that in disparity.

    Disparity may bend more where the thread visibly bends more.
    """
    first, table = spline.local_basis(samples.s, curve.knots)
    second = table[2] / samples.length_px**2 * np.sqrt(samples.length_px / len(samples.s))
    image = _image_axes(samples)
    across = image[:, :2]
    bend = np.einsum("kij,kj->ki", across, spline.combine(first, second, curve.control_points))
    squared = gaussian_filter1d((bend**2).sum(1), _BEND_SAMPLES)
    freedom = squared / max(squared.mean(), 1e-12) + _LEAST_FREEDOM
    bands = []
    for rows, weights in ((across, np.ones_like(freedom)), (image[:, 2:], 1 / freedom)):
        band, gradient = _empty(curve)
        information = weights[:, None, None] * np.einsum("kij,kil->kjl", rows, rows)
        spline.add_rows(first, second, information, np.zeros((len(rows), 3)), band, gradient)
        bands.append(band)
    return bands[0], bands[1]


def _image_axes(samples: Samples) -> Float64:
    """(k, 3, 3) derivatives of u and v in the left view and of the disparity."""
    left, right = samples.jacobians
    return np.concatenate([left, (left - right)[:, :1]], axis=1)


def _empty(curve: Nurbs) -> tuple[Float64, Float64]:
    n = curve.control_points.size
    return np.zeros((n, spline.BANDWIDTH)), np.zeros(n)


def _times(band: Float64, x: Float64) -> Float64:
    """Product of a symmetric matrix, given by its lower band, and a vector."""
    out = band[:, 0] * x
    for d in range(1, band.shape[1]):
        out[d:] += band[d:, d] * x[:-d]
        out[:-d] += band[d:, d] * x[d:]
    return out


def _trace(inverse: Float64, band: Float64) -> float:
    """Trace of the product of two symmetric matrices, of which one has no entries off the band."""
    return float((inverse[:, 0] * band[:, 0]).sum() + 2 * (inverse[:, 1:] * band[:, 1:]).sum())

"""The curve refined on the field, as smooth as the evidence says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.initialization.crest import View
from suturetrack.initialization.knots import with_needed_knots
from suturetrack.initialization.samples import Samples
from suturetrack.kernels import spline
from suturetrack.types import Float64, Nurbs

_DENSE_ROUNDS = 4
_FINAL_ROUNDS = 3
_EVIDENCE_STEPS = 3
_STIFFEST = 1e9
_OFF_PX = 0.08
"""By how much the rows of two views have to be off, at least, for that to be told from the bunching of
depth along the epipolar lines: calibrated ones seem to be off by up to 0.05."""
_SURELY = 6.0
"""Standard deviations by which they have to seem off, at least."""
_ANY_SLIP_PX = 1.0
"""What the rows may be off where no crest tells, px (standard deviation)."""


def refine(
    curve: Nurbs, views: tuple[View, View], rig: StereoRig, *, are_moved: bool = False
) -> tuple[Nurbs, Samples, Float64, float]:
    """Gauss-Newton on the crests of both views, as smooth as the evidence says, with few knots.

    Bending is measured in pixels, across the line of sight and in disparity apart, because the
    images inform depth far less; how much each is held back follows from the curve itself
    (MacKay's evidence).

    Args:
        curve: within a few pixels of the crests, with knots enough for any shape.
        views: left and right.
        rig: the cameras.
        are_moved: whether the views are on other rows than the calibration says, so that none of them
            is to be believed.

    Returns:
        The curve, what the images show beside it, (k,) the standard deviations of its samples, and
        how many px lower than the cameras say the right view shows the thread; 0 in doubt.

    Raises:
        FloatingPointError: the images do not hold the curve, or it runs out of both.
    """
    start = _Fit(curve, np.array([1.0, 100.0]))
    fit = start.improved(views, rig, _DENSE_ROUNDS)
    off_px = 0.0 if are_moved else _OFF_PX
    if abs(fit.slip_px) > max(off_px, _SURELY * fit.slip_sigma_px):
        fit = replace(fit, is_level=False).improved(views, rig, _DENSE_ROUNDS)
    fit = replace(fit, curve=with_needed_knots(fit.samples(views, rig)))
    fit = fit.improved(views, rig, _FINAL_ROUNDS)
    samples = fit.samples(views, rig)
    return fit.curve, samples, _deviations(fit.curve, samples, fit.stiffness), fit.rows


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


def _deviations(curve: Nurbs, samples: Samples, stiffness: Float64) -> Float64:
    """(k,) standard deviations of the samples in space, by the noise of the crests.

    What the ends tell is not in it: the depth of a thread between them would seem known as well.
    """
    data, _ = _crest_equations(curve, samples)
    across, deep = _bending_equations(curve, samples)
    factor = data / samples.variance + stiffness[0] * across + stiffness[1] * deep
    if not spline.factorize(factor):
        raise FloatingPointError("the curve is not held by the images")
    first, table = spline.local_basis(samples.s, curve.knots)
    covariance = spline.sample_covariance(first, table[0], spline.band_of_inverse(factor))
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def _step(fit: _Fit, samples: Samples) -> _Fit:
    curve, stiffness, noise = fit.curve, fit.stiffness.copy(), samples.variance
    data, pull = _image_equations(curve, samples)
    across, deep = _bending_equations(curve, samples)
    c = curve.control_points.ravel()
    free = len(c) // 3 - 2
    step = np.zeros_like(c)
    for _ in range(_EVIDENCE_STEPS):
        smoothing = stiffness[0] * across + stiffness[1] * deep
        factor = data / noise + smoothing
        if not spline.factorize(factor):
            raise FloatingPointError("the curve is not held by the images")
        step = spline.solve_factorized(factor, pull / noise - _times(smoothing, c))
        inverse = spline.band_of_inverse(factor)
        for k, (energy, rank) in enumerate(((across, 2 * free), (deep, free))):
            held = rank - stiffness[k] * _trace(inverse, energy)
            bend = (c + step) @ _times(energy, c + step)
            stiffness[k] = min(max(held, 1.0) / max(bend, 1e-12), _STIFFEST)
    slipping = _slip_equations(curve, samples)
    slip, sigma = _slip(curve, samples, smoothing, slipping)
    if not fit.is_level:
        step = step - slip * spline.solve_factorized(factor, slipping[0] / noise)
    return replace(
        fit,
        curve=nurbs.curve_from(
            curve.degree, curve.knots, curve.control_points + step.reshape(-1, 3)
        ),
        stiffness=stiffness,
        rows=fit.rows if fit.is_level else fit.rows + slip,
        slip_px=slip,
        slip_sigma_px=sigma,
    )


def _slip(
    curve: Nurbs, samples: Samples, smoothing: Float64, slipping: tuple[Float64, float, float]
) -> tuple[float, float]:
    """How many px lower the right view's rows seem to lie, and the standard deviation of that.

    It is one more unknown, beside the band of what is asked of the curve. The ends tell nothing of it: in a
    hole that a thread goes into the views show different ones. `slipping` is of `_slip_equations`.
    """
    crests, pull = _crest_equations(curve, samples)
    mixed, weight, shown = slipping
    noise = samples.variance
    factor = crests / noise + smoothing
    if not spline.factorize(factor):
        return 0.0, np.inf
    step = spline.solve_factorized(
        factor, pull / noise - _times(smoothing, curve.control_points.ravel())
    )
    per_px = spline.solve_factorized(factor, mixed / noise)
    held_by = weight - mixed @ per_px + noise / _ANY_SLIP_PX**2
    return float((shown - mixed @ step) / held_by), float(np.sqrt(noise / held_by))


def _slip_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, float, float]:
    """What the crests say about a slip of the right view's rows against the left one's: together
    with the control points, (3n,), its own weight, and what pulls at it."""
    mixed, weight, pull = np.zeros((len(samples.s), 3)), 0.0, 0.0
    for side, crest, rows in zip((-0.5, 0.5), samples.crests, samples.crest_rows(), strict=True):
        down = side * crest.normals[:, 1]
        mixed += (crest.trust * down)[:, None] * rows
        weight += float(crest.trust @ down**2)
        pull += float(crest.trust @ (down * crest.offsets))
    return _rows(curve, samples, 0, np.zeros((len(mixed), 3, 3)), mixed)[1], weight, pull


def _image_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, Float64]:
    """Rows that draw the curve onto the crests, and its ends along itself to those of the thread."""
    band, gradient = _crest_equations(curve, samples)
    for end, (information, pull) in enumerate(zip(*samples.end_equations(), strict=True)):
        at = (len(gradient) - 3) * end
        gradient[at : at + 3] += pull
        for a in range(3):
            for b in range(a + 1):
                band[at + a, a - b] += information[a, b]
    return band, gradient


def _crest_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, Float64]:
    """Rows that draw the curve onto the crests."""
    views = zip(samples.crests, samples.crest_rows(), strict=True)
    pull = sum((c.trust * c.offsets)[:, None] * rows for c, rows in views)
    information = samples.crest_information() + samples.rest_information()
    return _rows(curve, samples, 0, information, np.asarray(pull))


def _bending_equations(curve: Nurbs, samples: Samples) -> tuple[Float64, Float64]:
    """Bands of the bending across the line of sight and of that in disparity."""
    second = spline.evaluate(samples.s, curve.knots, curve.control_points)[2]
    across, deep = samples.bending_information(second)
    nothing = np.zeros_like(second)
    return (
        _rows(curve, samples, 2, across, nothing)[0],
        _rows(curve, samples, 2, deep, nothing)[0],
    )


def _rows(
    curve: Nurbs, samples: Samples, order: int, information: Float64, pull: Float64
) -> tuple[Float64, Float64]:
    """Band and gradient of what (k, 3, 3) and (k, 3) ask of a derivative at the samples."""
    first, table = spline.local_basis(samples.s, curve.knots)
    band, gradient = spline.no_rows(len(curve.control_points))
    spline.add_rows(first, table[order], information, pull, band, gradient)
    return band, gradient


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

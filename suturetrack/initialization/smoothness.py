"""How well two arms are one strand: Gaussian processes of its shape and of its depth."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve, cholesky

from suturetrack.initialization.depth import Disparities
from suturetrack.initialization.segments import Ridges
from suturetrack.polylines import arc_lengths
from suturetrack.types import Float64

ROUGHEST = 3e-5
"""How rough a strand is at most: spectral density of the change of its curvature in an image, 1/px^3."""
_USUAL = ROUGHEST / 3
"""And what is taken where it is the same strand in any case."""
_ROUGHNESSES = tuple(ROUGHEST / 10**k for k in (1.5, 1.0, 0.5, 0.0))
"""Those that are told apart: to a smoother strand it would be a bend where others draw it aside."""
_LONG, _CLEAR = 40, 0.5
"""Points, and strength against the average, from which a segment tells how rough strands are."""
_PART, _SKIPPED, _EVERY = 60, 4, 2
"""Points of its parts, those at its ends that do not count, and which of them do."""
_NOISE_PX = 0.25
_DISPARITY_BEND = 1e-4
"""Spectral density of the change of slope in disparity, 1/px."""
_ANYWHERE_PX = 100.0
_ANY_CURVATURE = 0.05

_Prior = Callable[[Float64], Float64]
"""(k, k) covariance at (k,) places along a strand."""


def bend(one: Float64, other: Float64, roughness: float) -> float:
    """How much more two arms of pixels, (k, 2) and (m, 2) from their ends inwards, have to bend as one
    strand of a roughness than as two."""
    t = arc_lengths(np.r_[one[::-1], other])
    variances = [np.full(len(arm), _NOISE_PX**2) for arm in (one, other)]
    return _excess(t, (one[::-1], other), variances, partial(_curving, roughness=roughness))


def bending(pixels: Float64, roughness: float) -> float:
    """How much (k, 2) pixels have to bend as one strand of a roughness."""
    variance = np.full(len(pixels), _NOISE_PX**2)
    return _energy(arc_lengths(pixels), pixels, variance, partial(_curving, roughness=roughness))[0]


def step(one: Disparities, other: Disparities) -> float:
    """How much more the disparity of two arms has to change as one strand than as two."""
    t = arc_lengths(np.r_[one.pixels[::-1], other.pixels])
    values = one.value[::-1, None], other.value[:, None]
    variances = [one.variance[::-1], other.variance]
    return max(_excess(t, values, variances, _sloping), 0.0)


@lru_cache(maxsize=4)  # Each view is asked about several times.
def roughness(ridges: Ridges) -> float:
    """How rough the strands of a view may be where they meet: the step above what is likeliest for the
    roughest part of its clear long segments."""
    sizes = np.array([len(segment) for segment in ridges.segments])
    long = np.flatnonzero(sizes >= _LONG)
    if not len(long):
        return ROUGHEST
    level = _CLEAR * np.average(ridges.strengths[long], weights=sizes[long])
    parts = [
        ridges.segments[i][k : min(k + _PART, sizes[i] - _SKIPPED) : _EVERY]
        for i in long[ridges.strengths[long] > level]
        for k in range(_SKIPPED, sizes[i] - _SKIPPED - _PART // 2, _PART)
    ]
    rougher = pairwise(_ROUGHNESSES)
    smooth, rough = next(rougher)
    for part in parts:
        while rough < ROUGHEST and _surprise(part, rough) < _surprise(part, smooth):
            smooth, rough = next(rougher)
    return rough if parts else ROUGHEST


def shape_energy(pixels: Float64, variance: Float64) -> float:
    """How much (k, 2) pixels, with (k,) variances, have to bend as one strand."""
    return _energy(arc_lengths(pixels), pixels, variance, partial(_curving, roughness=_USUAL))[0]


def depth_energy(travelled: Float64, disparities: Float64, variance: Float64) -> float:
    """How much (k,) disparities, with variances, have to change along a strand, at (k,) places along it."""
    return _energy(travelled, disparities[:, None], variance, _sloping)[0]


def _surprise(pixels: Float64, roughness: float) -> float:
    """Minus the logarithm, but for a constant, of how likely (k, 2) pixels are of a strand of a roughness."""
    variance = np.full(len(pixels), _NOISE_PX**2)
    energy, spread = _energy(
        arc_lengths(pixels), pixels, variance, partial(_curving, roughness=roughness)
    )
    return energy + spread


def _excess(
    t: Float64, values: tuple[Float64, Float64], variances: list[Float64], prior: _Prior
) -> float:
    """Energy of (k, d) and (m, d) values at the places t as one strand, less that as two."""
    n = len(values[0])
    one, _ = _energy(t, np.concatenate(values), np.concatenate(variances), prior)
    return (
        one
        - _energy(t[:n], values[0], variances[0], prior)[0]
        - _energy(t[n:], values[1], variances[1], prior)[0]
    )


def _energy(t: Float64, values: Float64, variance: Float64, prior: _Prior) -> tuple[float, float]:
    """Minus the exponent of the Gaussian process `prior` at noisy values (k, d), and the logarithm of what
    that is normalised by."""
    covariance = prior(t - t[0])
    covariance[np.diag_indices(len(t))] += variance
    values = values - values.mean(0)
    factor = cholesky(covariance, lower=True)
    energy = 0.5 * float((values * cho_solve((factor, True), values)).sum())
    return energy, values.shape[1] * float(np.log(np.diag(factor)).sum())


def _sloping(t: Float64) -> Float64:
    """(k, k) covariance of a line whose slope drifts."""
    least, gap, centred = np.minimum.outer(t, t), abs(np.subtract.outer(t, t)), t - t.mean()
    drift = least * least * (least / 3 + gap / 2)
    return _DISPARITY_BEND * drift + _ANYWHERE_PX**2 + np.outer(centred, centred)


def _curving(t: Float64, roughness: float) -> Float64:
    """(k, k) covariance of a curve whose curvature drifts."""
    least, gap, centred = np.minimum.outer(t, t), abs(np.subtract.outer(t, t)), t - t.mean()
    drift = least * least * least * (least * (least / 20 + gap / 8) + gap * gap / 12)
    bent = _ANY_CURVATURE**2 * np.outer(centred**2, centred**2)
    return roughness * drift + _ANYWHERE_PX**2 + np.outer(centred, centred) + bent

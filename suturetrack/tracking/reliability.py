"""What a fitted curve is worth: what of it is seen, and whether the thread runs beside it instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import search
from suturetrack.tracking.gauss_newton import Fit
from suturetrack.tracking.sampling import Samples, values_at, views
from suturetrack.types import Bool, Float64, Nurbs, RidgeField, Status

RELIABILITY_SAMPLES = 64
_NEAR_PX = 1.5
_BESIDE_PX = np.arange(-30.0, 30.1, 1.5)
_CLEAR = 0.5
# Shares of the curve's length.
_MOST = 0.5
_SOME = 0.2
_ASTRAY = 0.05
_LOST_AFTER_S = 0.2
_DRIFT = 0.35
_DRIFT_AT_REST_PX = 0.2
_ANYWHERE_PX = 8.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one field says about a curve."""

    fit: Fit
    seen: Bool
    """(k,) at the fit's samples: both images show the thread there."""
    share: float
    """Share of the curve's length that is seen."""

    @classmethod
    def of(cls, fit: Fit) -> Evidence:
        """Judges each sample of the fit."""
        left, right = fit.offsets
        with np.errstate(invalid="ignore"):
            near = np.all(np.abs(fit.residual) < _NEAR_PX, axis=1)
        seen = left.found & right.found & near
        return cls(fit, seen, float(np.sum(fit.samples.share * seen)))

    def evenly(self) -> tuple[Float64, Bool]:
        """Standard deviation, and whether seen, at evenly spaced parameters."""
        s, at = self.fit.samples.s, np.linspace(0, 1, RELIABILITY_SAMPLES)
        sigma = np.sqrt(np.trace(self.fit.covariance, axis1=1, axis2=2))
        nearest = np.clip(np.searchsorted(s, at), 0, len(s) - 1)
        return np.interp(at, s, sigma), self.seen[nearest]

    def astray(self, field: RidgeField, rig: StereoRig, levels: tuple[float, float]) -> float:
        """Share of the curve that is unseen although both images show a thread beside it."""
        unseen = np.flatnonzero(~self.seen)
        if not len(unseen):
            return 0.0
        curve, samples = self.fit.curve, self.fit.samples
        places = Samples.at(curve.knots, samples.s)
        both = views(
            rig, places.values(curve.control_points), places.values(curve.control_points, 1)
        )
        beside = np.ones(len(unseen), bool)
        for image, view, level in zip((field.left, field.right), both, levels, strict=True):
            profiles = search.normal_profiles(
                image, view.pixels[unseen], view.tangents[unseen], _BESIDE_PX
            )
            own = _own(view.pixels[unseen], view.normals[unseen], view.pixels[self.seen])
            beside &= (np.where(own, 0.0, profiles) > _CLEAR * level).any(axis=1)
        return float(np.sum(samples.share[unseen] * beside))


class Doubt:
    """How far what is not seen may have moved away, px, at evenly spaced parameters.

    It grows with the curve's own motion there: a hidden stretch of a thread at rest stays where it
    was, one that was moving fast may be anywhere.
    """

    def __init__(self) -> None:
        self.px: Float64 = np.zeros(RELIABILITY_SAMPLES)

    def grow(self, before: Nurbs, after: Nurbs, seen: Bool, rig: StereoRig) -> None:
        """One field later, in which the curve moved from `before` to `after`."""
        s = np.linspace(0, 1, RELIABILITY_SAMPLES)
        moved = rig.project(values_at(after, s))[0] - rig.project(values_at(before, s))[0]
        drift = _DRIFT * np.linalg.norm(moved, axis=1) + _DRIFT_AT_REST_PX
        self.px = np.where(seen, 0.0, np.hypot(self.px, drift))

    @property
    def share(self) -> float:
        """Share of the curve that may be anywhere."""
        return float(np.mean(self.px > _ANYWHERE_PX))


def judge(evidence: Evidence, astray: float, doubted: float, unseen_s: float) -> Status:
    """The status of a curve.

    Args:
        evidence: what the field says about it.
        astray: share of it beside which a thread runs.
        doubted: share of it that may be anywhere.
        unseen_s: time since half of it was last seen.
    """
    if astray > _ASTRAY or doubted > _ASTRAY:
        return Status.LOST
    if evidence.share >= _MOST:
        return Status.TRACKING
    if evidence.share >= _SOME or unseen_s < _LOST_AFTER_S:
        return Status.OCCLUDED
    return Status.LOST


def _own(pixels: Float64, normals: Float64, seen: Float64) -> Bool:
    """(k, m) where the normals' offsets meet the seen part of the curve itself."""
    places = pixels[:, None, :] + _BESIDE_PX[None, :, None] * normals[:, None, :]
    if not len(seen):
        return np.zeros(places.shape[:2], bool)
    away = np.linalg.norm(places[:, :, None, :] - seen[None, None, ::2, :], axis=-1)
    return away.min(axis=-1) < 6.0

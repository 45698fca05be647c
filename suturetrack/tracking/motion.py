"""How the thread moves: a smooth velocity along it, from one curve to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import rows, spline
from suturetrack.nurbs import clamped_knots, curve_from
from suturetrack.tracking.sampling import Samples, derivatives_at, greville, values_at, views
from suturetrack.types import Bool, Float64, Nurbs

_KNOTS = clamped_knots(np.linspace(0, 1, 6)[1:-1], spline.DEGREE)
_PLACES = np.linspace(0, 1, 40)
_SAMPLES = Samples.at(_KNOTS, _PLACES)
# Share of the way to a measured velocity that each field goes, and how soon one fades that is not seen.
_GAIN, _FADING_S = 0.9, 0.5
# A longer time between two fields tells no velocity.
_LONGEST_STEP_S = 0.25
# Rows that keep the velocity even along the thread, against those that measure it.
_STIFFNESS = 1e-3


@dataclass(frozen=True, eq=False)
class Motion:
    """Velocity along the curve, a coarse spline over [0, 1]; calibration's unit per second."""

    coefficients: Float64
    """(m, 3)"""

    @classmethod
    def none(cls) -> Motion:
        """Standing still."""
        return cls(np.zeros((len(_KNOTS) - spline.ORDER, 3)))

    def predict(self, curve: Nurbs, seconds: float) -> Nurbs:
        """The cubic curve after `seconds`; where it is after a long or backward step in time."""
        if not 0 < seconds <= _LONGEST_STEP_S:
            return curve
        step = spline.evaluate(greville(curve.knots), _KNOTS, self.coefficients)[0] * seconds
        return curve_from(curve.degree, curve.knots, curve.control_points + step)

    def learn(
        self,
        before: Nurbs,
        after: Nurbs,
        seen: Bool,
        ends_seen: tuple[bool, bool],
        rig: StereoRig,
        seconds: float,
    ) -> Motion:
        """The velocity, corrected by the step from curve to curve.

        Across the thread the images tell how it moved; along it, only its ends do.

        Args:
            before, after: the curve in two fields, `seconds` apart.
            seen: (k,) whether the thread is seen at k parameters spaced evenly over [0, 1].
            ends_seen: whether the start and the stop are.
        """
        if not 0 < seconds <= _LONGEST_STEP_S:
            return Motion.none()
        points, first, _ = derivatives_at(after, _PLACES)
        moved = points - values_at(before, _PLACES)
        told = seen[np.round(_PLACES * (len(seen) - 1)).astype(int)].astype(float)
        information, no_pull = np.zeros((len(_PLACES), 3, 3)), np.zeros_like(moved)
        for view in views(rig, points, first):
            rows.add_measured_rows(
                view.tangents, view.jacobian, told, np.zeros_like(told), information, no_pull
            )
            for end, end_seen in ((0, ends_seen[0]), (-1, ends_seen[1])):
                if end_seen and told[end]:
                    information[end] += view.jacobian[end].T @ view.jacobian[end]
        measured = _fit(information, moved / seconds)
        share = float(seen.mean())
        kept = self.coefficients * np.exp(-(1 - share) * seconds / _FADING_S)
        return Motion(kept + _GAIN * share * (measured - kept))


def _fit(information: Float64, velocity: Float64) -> Float64:
    """(m, 3) coefficients of the smoothest velocity that the information allows."""
    band, right = spline.no_rows(len(_KNOTS) - spline.ORDER)
    pull = (information @ velocity[:, :, None])[:, :, 0]
    spline.add_rows(_SAMPLES.first, _SAMPLES.table[0], information, pull, band, right)
    scale = float(np.trace(information, axis1=1, axis2=2).mean()) + np.finfo(float).tiny
    even = np.broadcast_to(_STIFFNESS * scale * np.eye(3), information.shape)
    spline.add_rows(_SAMPLES.first, _SAMPLES.table[1], even, np.zeros_like(pull), band, right)
    band[:, 0] += 1e-6 * scale
    spline.factorize(band)
    return spline.solve_factorized(band, right).reshape(-1, 3)

"""A pose on the thread for a gripper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack import nurbs
from suturetrack.types import Float64, Grasp, InputError, ThreadState

AWAY_FROM_CAMERA = (0.0, 0.0, 1.0)
_SAMPLES = 512


@dataclass(frozen=True)
class GraspPoint:
    """Where to take the thread: exactly one of `distance`, `fraction` and `near`."""

    distance: float | None = None
    """Arc length from the start of the curve, calibration's unit; negative: from its end."""
    fraction: float | None = None
    """Part of the curve's length from its start, in [0, 1]."""
    near: tuple[float, float, float] | None = None
    """The point of the curve nearest to this one, rectified left frame, calibration's unit."""


def grasp(
    state: ThreadState,
    where: GraspPoint,
    approach: tuple[float, float, float] = AWAY_FROM_CAMERA,
) -> Grasp:
    """The gripper's pose on the thread.

    z runs along the thread towards growing s. The roll about it is chosen so that x, in which the
    gripper moves in, is as near as the thread lets it to `approach`; y completes the right-handed
    frame.

    Args:
        state: a state with a curve; whether its status is good enough to act on is the caller's to
            say.
        where: the place on the curve.
        approach: direction in which the gripper moves in, rectified left frame; any length.

    Raises:
        InputError: there is no curve, the place is not on it, or the approach has no direction
            across the thread.
    """
    if state.curve is None:
        raise InputError(f"thread {state.thread!r} has no curve to grasp")
    s = _parameter(state, where)
    at = np.array([s])
    z = nurbs.tangents(state.curve, at)[0]
    return Grasp(
        state.stamp,
        state.thread,
        nurbs.evaluate(state.curve, at)[0],
        _frame(z, np.asarray(approach, float)),
        float(np.interp(s, np.linspace(0, 1, len(state.sigma)), state.sigma)),
    )


def _parameter(state: ThreadState, where: GraspPoint) -> float:
    given = [v for v in (where.distance, where.fraction, where.near) if v is not None]
    if len(given) != 1:
        raise InputError("grasp: give exactly one of distance, fraction and near")
    assert state.curve is not None
    s = np.linspace(0, 1, _SAMPLES)
    if where.near is not None:
        points = nurbs.evaluate(state.curve, s)
        return float(s[np.argmin(np.linalg.norm(points - where.near, axis=1))])
    travelled = nurbs.arc_lengths(state.curve, s)
    if where.fraction is not None:
        if not 0 <= where.fraction <= 1:
            raise InputError(f"grasp: fraction {where.fraction} must be from 0 to 1")
        along = where.fraction * travelled[-1]
    else:
        distance = where.distance or 0.0
        along = distance if distance >= 0 else travelled[-1] + distance
        if not 0 <= along <= travelled[-1]:
            raise InputError(
                f"grasp: distance {distance} lies off the thread, which is {travelled[-1]:.6g} long"
            )
    return float(np.interp(along, travelled, s))


def _frame(z: Float64, approach: Float64) -> Float64:
    across = approach - (approach @ z) * z
    size = float(np.linalg.norm(across))
    if not np.isfinite(size) or size <= 1e-3 * float(np.linalg.norm(approach)):
        raise InputError("grasp: the approach runs along the thread; give one across it")
    x = across / size
    return np.stack([x, np.cross(z, x), z], axis=1)

"""A pose on the thread for a gripper."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from suturetrack import nurbs
from suturetrack.types import Float64, Grasp, InputError, Status, ThreadState

AWAY_FROM_CAMERA = (0.0, 0.0, 1.0)
_SAMPLES = 512
_LEAST_ACROSS = 0.1
"""Sine of the angle between approach and thread below which the roll would follow the noise."""


@dataclass(frozen=True)
class GraspPoint:
    """Where to take the thread: exactly one of the four."""

    from_start: float | None = None
    """Arc length from the start of the curve, calibration's unit."""
    from_end: float | None = None
    """Arc length from the end of the curve, calibration's unit."""
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
    frame. The pose depends on the curve and the approach alone, so it moves only as the thread does.

    Args:
        state: its age is the caller's to judge.
        where: the place on the curve.
        approach: direction in which the gripper moves in, rectified left frame; any length.

    Raises:
        InputError: there is no curve, the thread is lost or unseen there, the place is not on it, or
            the approach runs within 6 degrees along it.
    """
    if state.curve is None:
        raise InputError(f"thread {state.thread!r} was not found yet; there is no curve to grasp")
    if state.status is Status.LOST:
        raise InputError(
            f"thread {state.thread!r} is lost; wait until it is found again, or seed it"
        )
    s = _parameter(state, where)
    samples = s * (len(state.seen) - 1)
    if not state.seen[[math.floor(samples), math.ceil(samples)]].all():
        raise InputError(
            f"thread {state.thread!r} is not seen at {100 * s:.0f} % of the curve; take it elsewhere"
        )
    at = np.array([s])
    z = nurbs.tangents(state.curve, at)[0]
    return Grasp(
        state.stamp,
        state.thread,
        nurbs.evaluate(state.curve, at)[0],
        _frame(z, np.asarray(approach, float)),
        float(np.interp(samples, np.arange(len(state.sigma)), state.sigma)),
    )


def _parameter(state: ThreadState, where: GraspPoint) -> float:
    given = [v for v in vars(where).values() if v is not None]
    if len(given) != 1:
        raise InputError("grasp: give exactly one of from_start, from_end, fraction and near")
    assert state.curve is not None
    s = np.linspace(0, 1, _SAMPLES)
    if where.near is not None:
        points = nurbs.evaluate(state.curve, s)
        return float(s[np.argmin(np.linalg.norm(points - where.near, axis=1))])
    travelled = nurbs.arc_lengths(state.curve, s)
    return float(np.interp(_distance(where, float(travelled[-1])), travelled, s))


def _distance(where: GraspPoint, length: float) -> float:
    """Arc length from the start of a curve of this length."""
    if where.fraction is not None:
        if not 0 <= where.fraction <= 1:
            raise InputError(f"grasp: fraction {where.fraction} must be from 0 to 1")
        return where.fraction * length
    distance = where.from_start if where.from_start is not None else where.from_end
    assert distance is not None
    if not 0 <= distance <= length:
        raise InputError(
            f"grasp: the place lies off the thread, at {100 * distance / length:.4g} % of its length"
        )
    return distance if where.from_start is not None else length - distance


def _frame(z: Float64, approach: Float64) -> Float64:
    across = approach - (approach @ z) * z
    size = float(np.linalg.norm(across))
    if not size > _LEAST_ACROSS * float(np.linalg.norm(approach)):
        raise InputError("grasp: the approach runs along the thread; give one across it")
    x = across / size
    return np.stack([x, np.cross(z, x), z], axis=1)

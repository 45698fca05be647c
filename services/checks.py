"""What a message must fulfil beyond its types before a process believes it."""

from __future__ import annotations

import itertools
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.messages import (
    Forget,
    Forgotten,
    GraspReply,
    GraspRequest,
    Health,
    SeedReply,
    ToolPose,
    ToolSnap,
)
from suturetrack.camera import LARGEST_SIDE, Camera, StereoRig
from suturetrack.types import (
    Colours,
    Energies,
    Grasp,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
    ThreadState,
    Truth,
)

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""Names of rigs, processes and threads; they become parts of keys."""
LARGEST_TIME = 2**63 - 1


def check(message: object) -> None:
    """Raises ValueError, naming the field, when a message holds impossible values."""
    _CHECKS[type(message)](message)


def check_name(name: str, what: str) -> None:
    """Raises ValueError for a name that cannot be part of a key."""
    if not isinstance(name, str):
        raise ValueError(f"{what} {name!r}: a name is a string")
    if not NAME.fullmatch(name):
        raise ValueError(f"{what} {name[:80]!r}: use 1 to 64 of A-Z a-z 0-9 _ -")


def check_rig(name: str) -> None:
    """Raises InputError for a name that no rig can have."""
    try:
        check_name(name, "rig")
    except ValueError as error:
        raise InputError(str(error)) from error


def _require(condition: object, complaint: str) -> None:
    if not condition:
        raise ValueError(complaint)


def _numbers(array: NDArray[Any], shape: tuple[int | None, ...], name: str) -> None:
    fits = array.ndim == len(shape) and all(
        wanted in (None, size) for size, wanted in zip(array.shape, shape, strict=True)
    )
    _require(fits, f"{name} has shape {array.shape}, expected {shape}")
    _require(np.isfinite(array).all(), f"{name} holds values that are not finite")


def _stamp(stamp: Stamp) -> None:
    for name in ("frame", "capture_ns", "released_ns", "period_ns"):
        _require(0 <= getattr(stamp, name) <= LARGEST_TIME, f"{name} {getattr(stamp, name)}")


def _frame(frame: StereoFrame) -> None:
    _stamp(frame.stamp)
    shape = frame.left.shape
    _require(len(shape) == 2 or (len(shape) == 3 and shape[2] == 3), f"images of shape {shape}")
    _require(shape == frame.right.shape, f"left is {shape}, right is {frame.right.shape}")


def _field(field: RidgeField) -> None:
    _stamp(field.stamp)
    shape = field.left.shape
    _require(len(shape) == 3 and shape[2] == 2, f"a field of shape {shape}, expected (H, W, 2)")
    _require(shape == field.right.shape, f"left is {shape}, right is {field.right.shape}")
    for view in itertools.chain(*field.own.values()) if field.own else (field.left, field.right):
        # NaN fails both comparisons.
        bounded = view.min() >= -1.001 and view.max() <= 1.001
        _require(bounded, "a field holds components that are not within [-1, 1]")
    for colours in field.colours or ():
        _colours(colours, shape)


def _colours(colours: Colours, shape: tuple[int, ...]) -> None:
    pixels = colours.pixels.astype(np.int64)
    inside = (pixels < (shape[1], shape[0])).all()
    _require(inside, "colours of pixels outside the view")
    order = pixels[:, 1] * shape[1] + pixels[:, 0]
    _require((np.diff(order) > 0).all(), "colours of pixels that are not in order, row by row")


def _curve(curve: Nurbs) -> None:
    points, knots = curve.control_points, curve.knots
    _require(1 <= curve.degree <= 9, f"degree {curve.degree}")
    _numbers(points, (None, 3), "control_points")
    _require(len(points) > curve.degree, f"{len(points)} control points of degree {curve.degree}")
    _numbers(knots, (len(points) + curve.degree + 1,), "knots")
    _require((np.diff(knots) >= 0).all(), "knots that decrease")
    _require(knots[0] < knots[-1], "knots that span nothing")
    _numbers(curve.weights, (len(points),), "weights")
    _require((curve.weights > 0).all(), "weights that are not positive")


def _energies(energies: Energies) -> None:
    values = [energies.image_left, energies.image_right, energies.end, energies.internal]
    _require(not np.isinf(values).any(), "energies that are infinite")


def _state(state: ThreadState) -> None:
    _stamp(state.stamp)
    check_name(state.thread, "thread")
    _energies(state.energies)
    # Infinite where nothing holds the curve; NaN fails the comparison.
    _require(state.sigma.ndim == 1 and (state.sigma >= 0).all(), "sigma is no list of deviations")
    _require(state.seen.shape == state.sigma.shape, "seen and sigma differ in length")
    if state.curve is None:
        _require(np.isnan(state.length), "a length without a curve")
    else:
        _require(len(state.sigma) > 1, f"{len(state.sigma)} deviations along a curve")
        _curve(state.curve)
        _require(np.isfinite(state.length) and state.length >= 0, f"length {state.length}")


def _truth(truth: Truth) -> None:
    _stamp(truth.stamp)
    check_name(truth.thread, "thread")
    _numbers(truth.points, (None, 3), "points")
    _require(truth.visible.shape == (len(truth.points),), "visible and points differ in length")
    _require(np.isfinite(truth.length) and truth.length >= 0, f"length {truth.length}")


def _seed(seed: Seed) -> None:
    check_name(seed.thread, "thread")
    _require((seed.pixel is None) != (seed.point is None), "exactly one of pixel and point")
    _require(np.isfinite(seed.pixel or seed.point or ()).all(), "a seed that is not finite")


def _seed_reply(reply: SeedReply) -> None:
    check_name(reply.thread, "thread")
    _require(np.isfinite(reply.candidates).all(), "candidates that are not finite")
    if reply.stamp is not None:
        _stamp(reply.stamp)
    if reply.curve is not None:
        _curve(reply.curve)


def _grasp(grasp: Grasp) -> None:
    _stamp(grasp.stamp)
    check_name(grasp.thread, "thread")
    _numbers(grasp.position, (3,), "position")
    _numbers(grasp.rotation, (3, 3), "rotation")
    _rotation(grasp.rotation, "rotation")
    _require(np.isfinite(grasp.sigma) and grasp.sigma >= 0, f"sigma {grasp.sigma}")


def _thread(message: Forget | Forgotten) -> None:
    check_name(message.thread, "thread")


def _grasp_request(request: GraspRequest) -> None:
    check_name(request.thread, "thread")
    numbers = [np.ravel(v) for v in vars(request.where).values() if v is not None]
    _require(len(numbers) == 1, "exactly one of from_start, from_end, fraction and near")
    _require(np.isfinite(numbers[0]).all(), "a place that is not finite")
    _require(np.isfinite(request.approach).all() and any(request.approach), "no approach")


def _grasp_reply(reply: GraspReply) -> None:
    check_name(reply.thread, "thread")
    _require((reply.grasp is None) == bool(reply.reason), "either a grasp or a reason")
    if reply.grasp is not None:
        _grasp(reply.grasp)


def _tool_pose(pose: ToolPose) -> None:
    check_name(pose.tool, "tool")
    _require(0 <= pose.time_ns <= LARGEST_TIME, f"time_ns {pose.time_ns}")
    _numbers(pose.position, (3,), "position")
    _numbers(pose.rotation, (3, 3), "rotation")
    _rotation(pose.rotation, "rotation")


def _tool_snap(snap: ToolSnap) -> None:
    _stamp(snap.stamp)
    check_name(snap.tool, "tool")
    _numbers(snap.tip, (3,), "tip")
    _require(np.isfinite(snap.point or ()).all(), "a point that is not finite")


def _health(health: Health) -> None:
    check_name(health.process, "process")
    _require(0 <= health.time_ns <= LARGEST_TIME, f"time_ns {health.time_ns}")
    if health.stamp is not None:
        _stamp(health.stamp)
    figures = [health.rate_hz, health.run_rate_hz, health.memory_mb]
    for latency in (health.latency, health.run_latency):
        figures += [latency.p50_ms, latency.p99_ms, latency.max_ms]
    _require(np.isfinite(figures).all(), "figures that are not finite")
    counts = (health.frames, health.dropped, health.refused, health.restarts)
    _require(min(counts) >= 0, "counts that are negative")


def _rig(rig: StereoRig) -> None:
    width, height = rig.image_size
    fits = 1 <= min(width, height) <= max(width, height) <= LARGEST_SIDE
    _require(fits, f"image_size {rig.image_size}")
    _require(0 < rig.metres_per_unit < np.inf, f"metres_per_unit {rig.metres_per_unit}")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        _camera(camera, side)
    _require(rig.baseline > 0, f"baseline {rig.baseline}")


def _camera(camera: Camera, side: str) -> None:
    _numbers(camera.matrix, (3, 3), f"{side} matrix")
    _numbers(camera.distortion, (None,), f"{side} distortion")
    _require(camera.distortion.size in (0, 4, 5, 8, 12, 14), f"{side} distortion coefficients")
    _numbers(camera.rectification, (3, 3), f"{side} rectification")
    _rotation(camera.rectification, f"{side} rectification")
    _numbers(camera.projection, (3, 4), f"{side} projection")
    _require(min(camera.projection[0, 0], camera.projection[1, 1]) > 0, f"{side} focal length")


def _rotation(matrix: NDArray[Any], name: str) -> None:
    _require(np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6), f"{name} is no rotation")


def _anything(message: object) -> None:
    del message


_CHECKS: dict[type[Any], Any] = {
    StereoFrame: _frame,
    RidgeField: _field,
    ThreadState: _state,
    Truth: _truth,
    Seed: _seed,
    SeedReply: _seed_reply,
    Grasp: _grasp,
    Forget: _thread,
    Forgotten: _thread,
    GraspRequest: _grasp_request,
    GraspReply: _grasp_reply,
    Stamp: _stamp,
    ToolPose: _tool_pose,
    ToolSnap: _tool_snap,
    Health: _health,
    StereoRig: _rig,
    type(None): _anything,
}

"""The values that stages exchange.

Pixels are `(u, v)` with the centre of the top-left pixel at (0, 0). Points are in the rectified left
camera's frame (x right, y down, z forward), in the unit of the calibration. Times are integer
nanoseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
UInt16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]


class InputError(ValueError):
    """The user's input is at fault; the message is one line: what is wrong, what would be right."""


def check_ranges(config: object, prefix: str, **ranges: tuple[float, float]) -> None:
    """Raises InputError for a parameter, or a number of several, outside its range; None is in all.

    Args:
        prefix: what the options of the configuration begin with.
        ranges: by parameter, the least and the greatest value.
    """
    for name, (least, greatest) in ranges.items():
        value = getattr(config, name)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if not all(least <= number <= greatest for number in numbers):
            given, option = " ".join(map(str, numbers)), name.replace("_", "-")
            raise InputError(f"--{prefix}.{option} {given}: use {least:g} to {greatest:g}")


def read_only(view: Float32) -> Float32:
    """The array, to which nobody may write from now on, as to fields from the wire.

    Kernels are compiled apart for arrays that may be written to.
    """
    view.flags.writeable = False
    return view


@dataclass(frozen=True, order=True)
class Stamp:
    """Which frame a value belongs to; given by the source and passed on unchanged by every stage."""

    frame: int
    """Number of the frame, from 0 in recorded input."""
    capture_ns: int
    """Time of the exposure, in ns; for recorded input, the recording's own time."""
    released_ns: int
    """Wall clock when the source let the frame go, in ns: equal to `capture_ns` for live input.
    Latencies are counted from here."""
    period_ns: int = 0
    """Time until the source lets the next frame go, in ns; 0 where nothing is promised: in lock-step
    and in recordings."""


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """One exposure of both cameras, as the cameras gave it (not rectified)."""

    stamp: Stamp
    left: Image
    """(H, W, 3) BGR or (H, W) gray, uint8."""
    right: Image
    """As `left`."""


@dataclass(frozen=True, eq=False)
class Colours:
    """The colours of those pixels of a view that look like thread."""

    pixels: UInt16
    """(k, 2) rectified (u, v), row by row."""
    bgr: Image
    """(k, 3) of each."""

    def reduced(self, scale: int) -> Colours:
        """Those of every `scale`-th pixel, from the first, of a view that is reduced to them."""
        kept = (self.pixels % scale == 0).all(1)
        return Colours(self.pixels[kept] // np.uint16(scale), self.bgr[kept])

    def raised(self, rows: int) -> Colours:
        """Those of a view that is moved up by so many rows."""
        moved = self.pixels - np.array([0, rows])
        kept = moved[:, 1] >= 0
        return Colours(moved[kept].astype(np.uint16), self.bgr[kept])


@dataclass(frozen=True, eq=False)
class RidgeField:
    """The segmented stereo pair, V_o of Algorithm 1, in rectified pixels.

    The direction of a vector is that of the thread up to its sign; its length, in [0, 1], tells how
    much the pixel looks like thread.
    """

    stamp: Stamp
    left: Float32
    """(H, W, 2) float32, components along (u, v)."""
    right: Float32
    """As `left`."""
    own: Mapping[str, tuple[Float32, Float32]] = field(default_factory=dict)
    """Of several threads, by name: left and right as they look for that thread alone. `left` and
    `right` then show all of them."""
    colours: tuple[Colours, Colours] | None = None
    """Of the left and the right view; None where the images are gray."""

    def of(self, thread: str) -> RidgeField:
        """Where to look for a thread: the field of its own, if there is one."""
        own = self.own.get(thread)
        return self if own is None else RidgeField(self.stamp, *own, colours=self.colours)


@dataclass(frozen=True, eq=False)
class Seed:
    """Where the user says that a thread is: exactly one of `pixel` and `point`."""

    thread: str = "0"
    pixel: tuple[float, float] | None = None
    """(u, v) in the raw left image."""
    point: tuple[float, float, float] | None = None
    """(x, y, z) in the rectified left frame, calibration's unit."""


@dataclass(frozen=True, eq=False)
class Nurbs:
    """A NURBS curve (eq. 2) with clamped knots over [0, 1]; the formulas are in `suturetrack.nurbs`."""

    degree: int
    knots: Float64
    """(n + degree + 2,) non-decreasing, the end knots with multiplicity degree + 1."""
    control_points: Float64
    """(n + 1, 3) rectified left frame, calibration's unit; (n + 1, 2) for curves in an image."""
    weights: Float64
    """(n + 1,) positive; 1 for every curve this program makes (Section IV)."""


class Status(StrEnum):
    """What a curve is worth."""

    TRACKING = "tracking"
    """The curve is held and most of it is seen."""
    OCCLUDED = "occluded"
    """Less than half of it is seen, a part may be elsewhere, its length does not fit, no look at it was sure
    as yet, or its seed lies on another strand as well."""
    LOST = "lost"
    """The thread is not where the curve says, or nobody can tell."""


@dataclass(frozen=True)
class Energies:
    """The paper's energies of one state; `nan` where there is no curve."""

    image_left: float = float("nan")
    """Eq. (4) with b = 1 over u in [0, 1]: -1 is a perfect match, 0 is none."""
    image_right: float = float("nan")
    end: float = float("nan")
    """Eq. (7), both views added."""
    internal: float = float("nan")
    """Bending of the curve: integral of squared curvature over arc length, times length; no unit."""


@dataclass(frozen=True, eq=False)
class ThreadState:
    """One thread at one frame."""

    stamp: Stamp
    thread: str
    status: Status
    curve: Nurbs | None
    """None until the thread was found for the first time."""
    length: float
    """Arc length of the curve, calibration's unit; nan without a curve."""
    energies: Energies
    sigma: Float64
    """(K,) standard deviation of the position at K parameters spaced evenly over [0, 1], calibration's
    unit: how well the images hold the curve there."""
    seen: Bool
    """(K,) whether the images show the thread there."""
    events: tuple[str, ...] = ()
    """What happened at this frame, in words: found, lost, recovered, control points inserted, ..."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """A pose on the thread for a gripper, in the rectified left frame."""

    stamp: Stamp
    thread: str
    position: Float64
    """(3,) calibration's unit."""
    rotation: Float64
    """(3, 3) columns x, y, z of the gripper; z runs along the thread's tangent."""
    sigma: float
    """Standard deviation of the position, calibration's unit."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Where a synthetic thread really is."""

    stamp: Stamp
    thread: str
    points: Float64
    """(N, 3) centreline from end to end, rectified left frame, calibration's unit."""
    length: float
    """Arc length, calibration's unit."""
    visible: Bool
    """(N,) whether both cameras see the point: inside both images and hidden by nothing."""

"""Where the thread was of late: if it shows there still, and the curve is elsewhere, the curve is wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from suturetrack.camera import StereoRig
from suturetrack.polylines import resample
from suturetrack.tracking.crowding import covered
from suturetrack.tracking.images import Images
from suturetrack.tracking.length import KnownLength
from suturetrack.tracking.sampling import View, length_of, values_at, views_at
from suturetrack.tracking.strands import Neighbours
from suturetrack.types import Bool, Float64, Nurbs

# How many curves are remembered, how far apart, and how often they are looked for.
_CURVES, _APART_NS, _PAUSE_NS = 6, 400_000_000, 90_000_000
# By what part the lengths of what is one curve differ.
_AS_LONG = 0.04
# How far a place may be from where the rest of the thread takes it to count less for that, times of weighing,
# and how firmly the thread keeps its shape, as a part of its places.
_OFF_PX, _ROUNDS, _FIRM, _SHAPE = 4.0, 5, 0.05, np.diag([1.0, 1.0, 1.0, 0.0])
# How far all of them are at most where there is nothing to tell.
_NEAR_PX = 4.0
# What is further than this from the curve lies elsewhere, and by how much the thread is off there at most.
_AWAY_PX, _BESIDE_PX = 8.0, np.arange(-3.0, 3.1)
# How much of what lies elsewhere has to be seen, what share of it, and of the rest; from which response on,
# against a clear view, it is.
_LEAST_PX, _SHOWN, _REST, _CLEAR = 25.0, 0.25, 0.85, 0.4
_PLACES = np.linspace(0, 1, 100)


class Known:
    """What was known of a thread: its curve, and its length."""

    def __init__(self, curve: Nurbs, length: KnownLength) -> None:
        self.curve, self.length = curve, length
        self._places = _places(curve)
        self._middle = self._places.mean(axis=0)
        self._size = float(np.std(self._places - self._middle))
        self._terms = self._affine(self._places)

    def carried(self, places: Float64, rig: StereoRig) -> Nurbs | None:
        """The curve, moved, turned and stretched as most of its places have been; None where that takes all
        of them near to where they are now.

        Args:
            places: (k, 3) where they are now.
            rig: the cameras.
        """
        a, moves = self._terms, places - self._places
        pixel = float(places[:, 2].mean()) / rig.focal
        weights = np.ones((len(a), 1))
        for _ in range(_ROUNDS):
            x = np.linalg.solve(
                a.T @ (weights * a) + _FIRM * len(a) * _SHAPE, a.T @ (weights * moves)
            )
            off_px = np.linalg.norm(moves - a @ x, axis=1, keepdims=True) / pixel
            if off_px.max() < _NEAR_PX:
                return None
            weights = 1 / (1 + (off_px / _OFF_PX) ** 2)
        points = self.curve.control_points
        return replace(self.curve, control_points=points + self._affine(points) @ x)

    def _affine(self, points: Float64) -> Float64:
        """(n, 4) of (n, 3) points: what an affine map multiplies."""
        return np.column_stack([(points - self._middle) / self._size, np.ones(len(points))])


@dataclass(frozen=True, eq=False)
class Memory:
    """The thread as it was tracked in the last seconds.

    The edge of a tool that moves over the thread takes the curve with it, little by little, and looks like
    the thread. But that shows again behind the tool, where the rest of it says that it has to be.
    """

    known: tuple[Known, ...] = ()
    """The oldest first."""
    learned_ns: int = -(1 << 62)
    looked_ns: int = -(1 << 62)

    def learned(self, curve: Nurbs, length: KnownLength, now_ns: int) -> Memory:
        """With a curve that is tracked."""
        if 0 <= now_ns - self.learned_ns < _APART_NS:
            return self
        known = (*self.known, Known(curve, length))[-_CURVES:]
        return replace(self, known=known, learned_ns=now_ns)

    def step(
        self, curve: Nurbs, images: Images, others: Neighbours
    ) -> tuple[Memory, tuple[Nurbs, KnownLength] | None]:
        """Looks for the thread in the next field, every now and then.

        Args:
            curve: as it is followed.
            images: the next field.
            others: other threads.

        Returns:
            What is remembered from now on, and the last curve that shows where `curve` is not, with what was
            known of its length; None if none does. What was learned since is forgotten.
        """
        now = images.field.stamp.capture_ns
        if 0 <= now - self.looked_ns < _PAUSE_NS:
            return self, None
        places, length = _places(curve), length_of(curve)
        left = images.rig.project(places)[0]
        for count in range(len(self.known), 0, -1):
            known = self.known[count - 1]
            if abs(length_of(known.curve) / length - 1) > _AS_LONG:
                continue
            there = known.carried(places, images.rig)
            if there is not None and _shows(there, left, images, others):
                return replace(self, known=self.known[:count], looked_ns=now), (there, known.length)
        return replace(self, looked_ns=now), None


def _places(curve: Nurbs) -> Float64:
    """(k, 3) evenly spaced along the curve."""
    return resample(values_at(curve, np.linspace(0, 1, 4 * len(_PLACES))), len(_PLACES))


def _shows(before: Nurbs, left: Float64, images: Images, others: Neighbours) -> bool:
    """Whether both images show the thread where it was, away from the curve's places in the left one."""
    both = views_at(images.rig, before, _PLACES)
    is_away = cdist(both[0].pixels, left).min(axis=1) > _AWAY_PX
    step_px = float(np.mean(both[0].speed)) / (len(_PLACES) - 1)
    if np.count_nonzero(is_away) * step_px < _LEAST_PX:
        return False
    is_away &= ~covered(both, others)
    is_seen = _seen(both, images)
    shown, rest = is_seen[is_away], is_seen[~is_away]
    is_plain = shown.sum() > max(_SHOWN * len(shown), _LEAST_PX / step_px)
    return bool(is_plain and rest.sum() > _REST * len(rest))


def _seen(both: tuple[View, View], images: Images) -> Bool:
    """(k,) whether both images show a thread next to the places."""
    responses = [
        view.profiles(image, _BESIDE_PX).max(axis=1) / level
        for view, image, level in zip(both, images.both, images.levels, strict=True)
    ]
    return np.minimum(*responses) > _CLEAR

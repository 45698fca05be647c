"""Threads that move, and the fields that a perfect segmentation would make of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import erfc

from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.polylines import arc_lengths, polyline_length
from suturetrack.types import Nurbs, RidgeField, Seed, Stamp

WIDTH_PX = 1.5
FPS = 30


def stamp(frame: int) -> Stamp:
    time = round(frame * 1e9 / FPS)
    return Stamp(frame, time, time)


def thread(
    time: float, length: float = 100.0, depth: float = 200.0, bend: float = 1.0
) -> np.ndarray:
    """(600, 3) points of a thread of exact length, fixed at its start, that swings and bends."""
    s = np.linspace(0, 1, 601)
    heading = bend * (1.3 * np.sin(5 * s + 0.6 * np.sin(1.5 * time)) + 0.4 * s * np.sin(2 * time))
    rise = 0.25 * np.sin(7 * s + time)
    middle = lambda x: (x[1:] + x[:-1]) / 2  # noqa: E731
    step = np.stack(
        [
            np.cos(middle(rise)) * np.cos(middle(heading)),
            np.cos(middle(rise)) * np.sin(middle(heading)),
            np.sin(middle(rise)),
        ],
        axis=1,
    )
    points = np.r_[np.zeros((1, 3)), np.cumsum(step, axis=0)]
    return points * (length / polyline_length(points)) + [-0.22 * length - 5, -10.0, depth]


def seed_at(rig: StereoRig, point: np.ndarray, name: str = "0") -> Seed:
    """A seed at a (3,) point of a thread, as the left view shows it."""
    u, v = rig.project_raw(point)[0]
    return Seed(name, pixel=(float(u), float(v)))


def seed_on(rig: StereoRig, points: np.ndarray, name: str = "0") -> Seed:
    """A seed in the middle of (n, 3) points of a thread."""
    return seed_at(rig, points[len(points) // 2], name)


def kinked(points: np.ndarray, by: float) -> np.ndarray:
    """(601, 3) points of a thread, with a kink in depth in its middle, so far away."""
    peak = np.clip(1 - np.abs(np.arange(601) - 300) / 60, 0, 1)[:, None]
    return np.asarray(points * (1 + by / points[300, 2] * peak))


def curve_through(points: np.ndarray, spans: int = 24) -> Nurbs:
    """A cubic curve on (m, 3) points, parametrised like their arc length."""
    travelled = arc_lengths(points)
    knots = nurbs.clamped_knots(np.linspace(0, 1, spans + 1)[1:-1], 3)
    return nurbs.fit(points, travelled / travelled[-1], knots, 3)


def paint(
    rig: StereoRig,
    threads: Sequence[np.ndarray],
    frame: int,
    hidden: Sequence[tuple[float, float, float]] = (),
    strength: float = 0.8,
    noise: float = 0.02,
) -> RidgeField:
    """The field of (k, 3) polylines; `hidden` are circles (u, v, radius) blank in the left view, and
    in the right one around the same 3-D place at the threads' mean depth."""
    rng = np.random.default_rng(frame)
    views = [np.zeros((rig.image_size[1], rig.image_size[0], 2)) for _ in range(2)]
    for points in threads:
        for view, pixels in zip(views, rig.project(points), strict=True):
            _add(view, pixels, strength)
    depth = np.mean([points[:, 2].mean() for points in threads]) if threads else 1.0
    disparity = rig.focal * rig.baseline / depth
    v, u = np.mgrid[: rig.image_size[1], : rig.image_size[0]]
    for cu, cv, radius in hidden:
        views[0][np.hypot(u - cu, v - cv) < radius] = 0
        views[1][np.hypot(u - cu + disparity, v - cv) < radius] = 0
    left, right = ((view + rng.normal(0, noise, view.shape)).astype(np.float32) for view in views)
    return RidgeField(stamp(frame), left, right)


def _add(view: np.ndarray, pixels: np.ndarray, strength: float) -> None:
    """Adds one line, keeping the stronger vector at each pixel."""
    height, width, _ = view.shape
    dense = np.linspace(0, len(pixels) - 1, 2 * int(polyline_length(pixels)))
    line = np.stack(
        [np.interp(dense, np.arange(len(pixels)), pixels[:, i]) for i in (0, 1)], axis=1
    )
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    around = np.stack(np.meshgrid(np.arange(-5, 6), np.arange(-5, 6)), axis=-1).reshape(-1, 2)
    place = np.round(line)[:, None, :] + around
    away = place - line[:, None, :]
    forward = (away * along[:, None, :]).sum(-1)
    aside = away[..., 1] * along[:, None, 0] - away[..., 0] * along[:, None, 1]
    magnitude = strength * np.exp(-0.5 * (aside / WIDTH_PX) ** 2)
    beyond = np.zeros_like(forward)
    beyond[0], beyond[-1] = -forward[0], forward[-1]
    near = np.abs(forward) <= 0.6
    near[[0, -1]] = beyond[[0, -1]] > -0.6
    magnitude *= np.where(near, 1.0, 0.0)
    start = (line[:1] - line) @ along[0]
    stop = (line - line[-1:]) @ along[-1]
    for end, outward in ((0, start), (-1, stop)):
        close = np.abs(outward) < 12
        reach = outward[:, None] + forward * (-1 if end == 0 else 1)
        close &= np.linalg.norm(line - line[end], axis=1) < 12
        fade = 0.5 * erfc(reach / (np.sqrt(2) * WIDTH_PX))
        magnitude[close] *= fade[close]
    column, row = place[..., 0].astype(int), place[..., 1].astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (magnitude > 0.003)
    order = np.argsort(magnitude[inside])
    vectors = (magnitude[..., None] * along[:, None, :])[inside][order]
    target = row[inside][order], column[inside][order]
    stronger = np.linalg.norm(vectors, axis=1) > np.linalg.norm(view[target], axis=1)
    view[target[0][stronger], target[1][stronger]] = vectors[stronger]

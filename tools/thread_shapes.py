"""Shapes in which simulated threads begin; lengths in mm."""

from __future__ import annotations

import numpy as np
from thread_physics import RADIUS, Array


def meander(
    rng: np.random.Generator, length: float, link: float, box: tuple[float, float], apart: float
) -> Array:
    """(N + 1, 3) a random winding, kinked shape of exact length, that fits the box, centred on it."""
    count = round(length / link)
    s = (np.arange(count) + 0.5) * length / count
    while True:
        heading = rng.uniform(0, 6) + rng.uniform(1.2, 2.3) * np.sin(
            2 * np.pi * (s / rng.uniform(70, 140) + rng.uniform())
        )
        heading += rng.uniform(0, 0.35) * np.sin(
            2 * np.pi * (s / rng.uniform(20, 40) + rng.uniform())
        )
        rise = rng.uniform(0.2, 0.45) * np.sin(2 * np.pi * (s / rng.uniform(35, 60)))
        step = np.c_[np.cos(heading) * np.cos(rise), np.sin(heading) * np.cos(rise), np.sin(rise)]
        nodes = np.r_[np.zeros((1, 3)), np.cumsum(step * length / count, axis=0)]
        nodes -= (nodes.max(0) + nodes.min(0)) / 2
        extent = np.ptp(nodes, axis=0)
        if extent[0] < box[0] and extent[1] < box[1] and separation(nodes[:, :2]) > apart:
            nodes[:, 2] -= nodes[:, 2].min() - 2 * RADIUS
            return nodes


def separation(nodes: Array, beyond: int = 8) -> float:
    """Smallest distance of nodes that are not neighbours along the thread."""
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    far = np.abs(np.subtract.outer(np.arange(len(nodes)), np.arange(len(nodes)))) > beyond
    return float(distance[far].min())


def tangle(rng: np.random.Generator, length: float, link: float, box: tuple[float, float]) -> Array:
    """(N + 1, 3) a random shape of exact length with crossings and neighbours, each pass on top."""
    count = round(length / link)
    s = (np.arange(count) + 0.5) * length / count
    far = np.abs(np.subtract.outer(np.arange(count + 1), np.arange(count + 1))) > 8
    while True:
        heading = rng.uniform(0, 6) + rng.uniform(-1, 1) * 2 * np.pi * s / rng.uniform(60, 120)
        for wave in (rng.uniform(70, 140), rng.uniform(35, 60)):
            heading += rng.uniform(0.4, 1.6) * np.sin(2 * np.pi * (s / wave + rng.uniform()))
        step = np.c_[np.cos(heading), np.sin(heading)] * length / count
        flat = np.r_[np.zeros((1, 2)), np.cumsum(step, axis=0)]
        flat -= (flat.max(0) + flat.min(0)) / 2
        extent = np.ptp(flat, axis=0)
        tightest = np.abs(np.diff(heading)).max() / (length / count)
        if extent[0] > box[0] or extent[1] > box[1] or tightest > 1 / 4:
            continue
        distance = np.where(far, np.linalg.norm(flat[:, None] - flat[None], axis=2), np.inf)
        beside = int(((distance > 1.2) & (distance < 3.0)).any(1).sum())
        if 3 <= len(crossing_pairs(flat)) <= 6 and beside > 14:
            return np.c_[flat, 0.3 + 0.022 * np.r_[0, s]]


def crossing_pairs(flat: Array) -> list[tuple[int, int]]:
    """Pairs of links of an (N + 1, 2) polyline that cross."""
    a, d = flat[:-1], np.diff(flat, axis=0)
    offset = a[None] - a[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = d[:, None, 0] * d[None, :, 1] - d[:, None, 1] * d[None, :, 0]
        t = (offset[..., 0] * d[None, :, 1] - offset[..., 1] * d[None, :, 0]) / area
        u = (offset[..., 0] * d[:, None, 1] - offset[..., 1] * d[:, None, 0]) / area
    cross = (t > 0) & (t < 1) & (u > 0) & (u < 1)
    return [(int(i), int(j)) for i, j in np.argwhere(cross) if j > i + 1]


def overhand(link: float, length: float) -> Array:
    """(N + 1, 3) an open overhand knot with straight tails."""
    t = np.linspace(-2.12, 2.12, 4000)
    height = np.clip(t**5 - 10 * t, -9.6, 9.6)
    loop = np.c_[1.9 * (t**3 - 3 * t), 1.7 * (t**4 - 4 * t**2), 0.19 * height]
    tails = [loop[i] + [way * 60.0, 1.0, 0.0] for i, way in ((0, -1), (-1, 1))]
    curve = np.r_[[tails[0]], loop, [tails[1]]]
    travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    s = travelled[-1] / 2 + np.arange(-length / 2, length / 2 + link / 2, link)
    nodes = np.stack([np.interp(s, travelled, column) for column in curve.T], axis=1)
    nodes[:, 2] += 1.0 - nodes[:, 2].min()
    return nodes

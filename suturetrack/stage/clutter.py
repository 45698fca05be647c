"""Lines that are not the thread: veins and other threads, laid where they mislead most."""

from __future__ import annotations

import numpy as np

from suturetrack.stage.appearance import Surface
from suturetrack.stage.background import wander
from suturetrack.stage.painter import Strand
from suturetrack.types import Float64


def misleading_lines(rng: np.random.Generator, points: Float64) -> list[Float64]:
    """(N, 2) lines on the table around a thread at (N, 3) `points`.

    The first goes on past the thread's fixed end, the next two cross at shallow angles.
    """
    flat = points[:, :2]
    tangent = np.gradient(flat, axis=0)
    heading = np.arctan2(tangent[:, 1], tangent[:, 0])
    past = heading[0] + np.pi + rng.normal(0, 0.12)
    gap = rng.uniform(0.5, 3.0) * np.array([np.cos(past), np.sin(past)])
    lines = [wander(rng, flat[0] + gap, past, rng.uniform(30, 60), 40.0)]
    for place in (rng.uniform(0.25, 0.45), rng.uniform(0.55, 0.8)):
        i = int(place * len(flat))
        angle = heading[i] + rng.choice([-1, 1]) * np.radians(rng.uniform(10, 28))
        halves = [wander(rng, flat[i], angle + turn, 35.0, 60.0) for turn in (np.pi, 0.0)]
        lines.append(np.concatenate([halves[0][::-1], halves[1][1:]]))
    return lines


def stray_threads(
    rng: np.random.Generator, points: Float64, surface: Surface, radius: float
) -> list[Strand]:
    """Other threads of the same kind on the table: one crosses at a shallow angle, one lies apart."""
    crossing = misleading_lines(rng, points)[1]
    corner = points.mean(0)[:2] + rng.choice([-1, 1], 2) * rng.uniform(20, 32, 2)
    apart = wander(rng, corner, rng.uniform(0, 2 * np.pi), 60.0, 30.0)
    return [
        Strand(np.column_stack([line, np.full(len(line), radius)]), np.array([radius]), surface)
        for line in (crossing, apart)
    ]

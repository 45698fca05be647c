"""Stored motions of threads, played at any time and varied by a seed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files

import numpy as np
from scipy.interpolate import CubicSpline

from suturetrack.types import Float64

_WARP_WAVES = 3


@dataclass(frozen=True, eq=False)
class Motion:
    """Paths of points over time, in mm, in the table's frame."""

    rate_hz: float
    tracks: dict[str, Float64]
    """(T, N, 3) for each thread or tool: N nodes from end to end, or a tool's points."""

    @cached_property
    def duration(self) -> float:
        """Seconds that are stored."""
        return (len(next(iter(self.tracks.values()))) - 1) / self.rate_hz

    def at(self, name: str, time: float) -> Float64:
        """(N, 3) points at `time` in seconds, by cubic interpolation; held before and after."""
        track = self.tracks[name]
        position = np.clip(time * self.rate_hz, 0, len(track) - 1)
        i = min(int(position), len(track) - 2)
        t = position - i
        p0, p1, p2, p3 = (track[np.clip(i + k, 0, len(track) - 1)] for k in (-1, 0, 1, 2))
        slope, curve = p2 - p0, 2 * p0 - 5 * p1 + 4 * p2 - p3
        return p1 + 0.5 * t * (slope + t * (curve + t * (3 * (p1 - p2) + p3 - p0)))


def load_motion(name: str) -> Motion:
    """The stored motion with that name."""
    path = files("suturetrack.stage") / "motions" / f"{name}.npz"
    with path.open("rb") as file, np.load(file) as stored:
        tracks = {key: stored[key].astype(np.float64) for key in stored.files if key != "rate_hz"}
        return Motion(float(stored["rate_hz"]), tracks)


@dataclass(frozen=True, eq=False)
class Warp:
    """A smooth change of the table's space that turns one motion into many alike."""

    scale: Float64
    """(3,) along x, y, z; a negative one mirrors."""
    waves: Float64
    """(k, 5) wave vector along x and y, phase, displacement along x and y."""

    @classmethod
    def draw(cls, rng: np.random.Generator, strength: float = 1.0) -> Warp:
        """A random one; `strength` 0 mirrors only."""
        scale = np.exp(strength * rng.uniform([-0.1, -0.1, -0.2], [0.1, 0.1, 0.4]))
        scale[0] *= rng.choice([-1.0, 1.0])
        angle, phase, way = rng.uniform(0, 2 * np.pi, (3, _WARP_WAVES))
        number = 2 * np.pi / rng.uniform(60, 110, _WARP_WAVES)
        size = strength * rng.uniform(0, 1.6, _WARP_WAVES)
        columns = [number * np.cos(angle), number * np.sin(angle), phase]
        return cls(scale, np.stack([*columns, size * np.cos(way), size * np.sin(way)], axis=1))

    def __call__(self, points: Float64) -> Float64:
        """(..., 3) -> (..., 3), mm."""
        phase = points[..., :2] @ self.waves[:, :2].T + self.waves[:, 2]
        moved = np.array(points)
        moved[..., :2] += np.sin(phase) @ self.waves[:, 3:]
        return moved * self.scale


def smoothing_matrix(nodes: int, samples: int) -> Float64:
    """(samples, nodes): evenly spaced samples of the cubic spline through the nodes."""
    spline = CubicSpline(np.arange(nodes), np.eye(nodes))
    return np.asarray(spline(np.linspace(0, nodes - 1, samples)))

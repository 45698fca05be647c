"""How threads and light look, and what the sensor adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from suturetrack.types import Float32, Float64

# BGR at full light; share of ambient light, strength and exponent of the highlight.
COLOURS = {
    "violet": ((120.0, 38.0, 78.0), (0.45, 0.17, 10.0)),
    "black": ((34.0, 30.0, 30.0), (0.5, 0.20, 10.0)),
    "blue": ((150.0, 72.0, 28.0), (0.45, 0.17, 10.0)),
    "undyed": ((205.0, 222.0, 228.0), (0.55, 0.20, 10.0)),
}


@dataclass(frozen=True)
class Picture:
    """How the images look; what is None is chosen by the scenario and the seed."""

    thread: str | None = None
    """Colour of every thread, a name in `COLOURS`."""
    background: str | None = None
    """Name of a texture."""
    shadow: float | None = None
    """Share of the light that a shadow takes, 0 to 1."""
    noise: float = 2.0
    """Standard deviation of the sensor's noise, gray levels."""


DEFAULT_PICTURE = Picture()


@dataclass(frozen=True, eq=False)
class Light:
    """A lamp far away."""

    direction: Float64
    """(3,) unit vector from the table to the lamp, table's frame."""
    shadow: float
    """Share of the light that a shadow takes."""

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Light:
        """A random one, 20 to 45 degrees from straight above."""
        tilt, way = np.radians(rng.uniform(20, 45)), rng.uniform(0, 2 * np.pi)
        direction = [np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)]
        return cls(np.array(direction), rng.uniform(0.3, 0.55))


def shading(points: Float64, light: Float64) -> Float64:
    """(n, 4) cosines for `tubes.shade` of a strand through (n, 3) points of the camera's frame.

    `light` is the unit vector to the lamp in the camera's frame.
    """
    tangent = _unit(np.gradient(points, axis=0))
    viewer = _unit(-points)
    across = _unit(np.cross(tangent, viewer))
    front = np.cross(across, tangent)
    half = _unit(light + viewer)
    sums = [across @ light, front @ light, (across * half).sum(1), (front * half).sum(1)]
    return np.stack(sums, axis=1)


def noise_pool(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """(H + 64, W + 64, 3) int8 noise, standard deviation 16, to cut a frame's noise from."""
    shape = (size[1] + 64, size[0] + 64, 3)
    return np.clip(rng.standard_normal(shape, np.float32) * 16, -127, 127).astype(np.int8)


def vignetting(size: tuple[int, int], loss: float) -> Float32:
    """(H, W) share of the light that arrives; `loss` is missing in the corners."""
    x, y = (np.linspace(-1, 1, n, dtype=np.float32) for n in size)
    return (1 - loss * (x[None] ** 2 + y[:, None] ** 2) / 2).astype(np.float32)


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

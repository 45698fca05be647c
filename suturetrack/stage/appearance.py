"""How threads, tools and light look, and what the lens and the sensor add."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from suturetrack.types import Float32, Float64, Image


@dataclass(frozen=True)
class Picture:
    """How the images are taken and look; what is None is chosen by the scenario and the seed."""

    thread: str | None = None
    """Colour of every thread, a name in `COLOURS`."""
    background: str | None = None
    """Name of a texture, one of `TEXTURES`."""
    shadow: float | None = None
    """Share of the light that a shadow takes, 0 to 1."""
    noise: float | None = None
    """Standard deviation of the sensor's noise, gray levels."""
    blur_px: float = 0.55
    """Standard deviation of the lens's blur where it is in focus, px."""
    defocus_px: float = 0.6
    """Blur added where the depth is off by a tenth, px."""
    shutter: float | None = None
    """Share of the frame's time for which light is gathered, 0 to 1."""
    vignetting: float | None = None
    """Share of the light that is missing in the corners."""
    drift: float | None = None
    """How far exposure and white balance swing, as a share."""
    jpeg: int | None = None
    """Quality of JPEG compression, 1 to 100; None for none."""
    size: tuple[int, int] = (640, 480)
    """Width and height, px."""
    distortion: float = 0.0
    """Radial distortion k1 of both lenses, below 0 for barrels; 0 gives rectified images."""
    calibration_error_px: float = 0.0
    """How far the real cameras are off their calibration, about, px."""
    half_pixel: bool = False
    """Whether the real cameras count pixels from corners, not from centres."""


LIMITS = {
    "shadow": (0, 1),
    "noise": (0, 50),
    "blur_px": (0, 20),
    "defocus_px": (0, 20),
    "shutter": (0, 1),
    "vignetting": (0, 1),
    "drift": (0, 0.9),
    "jpeg": (1, 100),
    "distortion": (-0.5, 0.5),
    "calibration_error_px": (0, 20),
}
"""Lowest and highest value of a `Picture`'s numbers."""


@dataclass(frozen=True)
class Surface:
    """What a thread or a tool is made of."""

    colour: tuple[float, float, float]
    """BGR in full light, 0 to 255."""
    ambient: float
    """Share of the light that comes from everywhere."""
    highlight: float
    """Strength of the highlight."""
    sharpness: float
    """Exponent of the highlight."""


COLOURS = {
    "violet": Surface((120.0, 38.0, 78.0), 0.45, 0.17, 10.0),
    "black": Surface((34.0, 30.0, 30.0), 0.5, 0.2, 10.0),
    "blue": Surface((150.0, 72.0, 28.0), 0.45, 0.17, 10.0),
    "undyed": Surface((205.0, 222.0, 228.0), 0.55, 0.2, 10.0),
}
STEEL = Surface((150.0, 146.0, 142.0), 0.25, 0.75, 22.0)


@dataclass(frozen=True, eq=False)
class Look:
    """A `Picture` with everything chosen."""

    lamp: Float64
    """(3,) unit vector from the table to the lamp, table's frame."""
    shadow: float
    noise: float
    blur_px: float
    defocus_px: float
    vignetting: float
    jpeg: int | None
    tint: Float64
    """(3,) BGR gain."""
    swing: Float64
    """(3, 3) amplitude, frequency in rad/s and phase of the gain of each channel."""

    @classmethod
    def draw(cls, rng: np.random.Generator, picture: Picture) -> Look:
        """What the seed chooses where the picture leaves a choice."""
        tilt, way = np.radians(rng.uniform(20, 45)), rng.uniform(0, 2 * np.pi)
        lamp = [np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)]
        drift = rng.uniform(0.0, 0.06)
        drift = drift if picture.drift is None else picture.drift
        exposure = [drift, rng.uniform(0.3, 1.0), rng.uniform(0, 2 * np.pi)]
        swing = exposure + np.column_stack(
            [rng.uniform(-0.3, 0.3, 3) * drift, np.zeros(3), rng.uniform(-0.4, 0.4, 3)]
        )
        return cls(
            lamp=np.array(lamp),
            shadow=_or(picture.shadow, rng.uniform(0.3, 0.55)),
            noise=_or(picture.noise, rng.uniform(1.2, 2.8)),
            blur_px=picture.blur_px,
            defocus_px=picture.defocus_px,
            vignetting=_or(picture.vignetting, rng.uniform(0.05, 0.3)),
            jpeg=picture.jpeg,
            tint=rng.uniform(0.94, 1.06, 3),
            swing=swing,
        )

    def gain(self, time: float) -> Float32:
        """(3,) exposure and white balance at `time` in s."""
        amplitude, frequency, phase = self.swing.T
        return (self.tint * (1 + amplitude * np.sin(frequency * time + phase))).astype(np.float32)


def shading(points: Float64, lamp: Float64) -> Float64:
    """(n, 4) cosines for `tubes.shade` of a strand through (n, 3) points of the camera's frame.

    `lamp` is the unit vector to the lamp in the camera's frame.
    """
    tangent = _unit(np.gradient(points, axis=0))
    viewer = _unit(-points)
    across = _unit(np.cross(tangent, viewer))
    front = np.cross(across, tangent)
    half = _unit(lamp + viewer)
    sums = [across @ lamp, front @ lamp, (across * half).sum(1), (front * half).sum(1)]
    return np.stack(sums, axis=1)


def noise_pool(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.int8]:
    """(H + 64, W + 64, 3) noise to cut a frame's noise from; standard deviation 16.

    Red and blue are smoother than green, as behind a Bayer filter.
    """
    noise = rng.standard_normal((size[1] + 64, size[0] + 64, 3), np.float32)
    for channel, blur in ((0, 0.7), (1, 0.45), (2, 0.7)):
        noise[..., channel] = cv2.GaussianBlur(noise[..., channel], (0, 0), blur)
    return np.clip(noise * (16 / noise.std(axis=(0, 1))), -127, 127).astype(np.int8)


def vignette(size: tuple[int, int], loss: float) -> Float32:
    """(H, W) share of the light that arrives; `loss` is missing in the corners."""
    x, y = (np.linspace(-1, 1, n, dtype=np.float32) for n in size)
    return (1 - loss * (x[None] ** 2 + y[:, None] ** 2) / 2).astype(np.float32)


def compressed(image: Image, quality: int | None) -> Image:
    """The image after JPEG of that quality."""
    if quality is None:
        return image
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)


def _or(given: float | None, drawn: float) -> float:
    return drawn if given is None else given


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

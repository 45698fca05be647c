"""From a stereo pair to the ridge vector field: eq. (1) and Algorithm 1 (Section III)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import ridge
from suturetrack.types import Float32, Image, InputError, RidgeField, Seed, StereoFrame

Channel = Literal["learned", "gray", "blue", "green", "red"]
Polarity = Literal["auto", "dark", "bright", "both"]

_WEIGHTS = {
    "learned": (29, 150, 77),
    "gray": (29, 150, 77),
    "blue": (256, 0, 0),
    "green": (0, 256, 0),
    "red": (0, 0, 256),
}
# Hue by half the angle in degrees: OpenCV's 180 hues for the directions of half a turn.
_HUES = (2 * np.arange(256) % 180).astype(np.uint8)
_SIGNS = {"auto": (1.0, 1.0), "dark": (1.0, 1.0), "bright": (-1.0, -1.0), "both": (-1.0, 1.0)}


@dataclass(frozen=True)
class SegmentationConfig:
    """How the images are turned into the ridge vector field."""

    sigmas: tuple[float, ...] = (1.2,)
    """Standard deviations of the Gaussian whose second derivatives are taken, px: about half the
    thread's width. Of several, the one with the longest vector counts at each pixel."""
    beta: float = 0.5
    """Beta of eq. (1): how far a ridge may be from straight and endless before it fades."""
    c: float | None = None
    """c of eq. (1), grey levels: the strength S at which a ridge counts by 40 %. None: half the
    99.8th percentile of S, steadied over time."""
    blur: float = 1.2
    """Standard deviation of the Gaussian G of Algorithm 1, px, on a window of 5x5."""
    channel: Channel = "learned"
    """Which channel, or mix of channels, is looked at. `learned`: gray until a seed shows what
    tells the thread from its surroundings."""
    polarity: Polarity = "auto"
    """Whether the thread is darker or brighter than its surroundings. `auto`: dark until a seed
    shows otherwise."""

    def __post_init__(self) -> None:
        if not self.sigmas or min(self.sigmas) <= 0 or self.blur <= 0 or self.beta <= 0:
            raise InputError("segmentation: sigmas, beta and blur must be positive")
        if self.c is not None and self.c <= 0:
            raise InputError("segmentation: c must be positive, or None for an automatic value")


class Segmenter:
    """Turns stereo frames into ridge vector fields.

    The buffers of a field are used again four steps later; who keeps a field longer copies it.
    """

    def __init__(self, rig: StereoRig, config: SegmentationConfig = SegmentationConfig()) -> None:
        width, height = rig.image_size
        self._rig = rig
        self._config = config
        self._weights: Float32 = np.array(_WEIGHTS[config.channel], np.float32) / np.float32(256)
        self._views = _View(height, width, config), _View(height, width, config)
        self._steps = 0

    def step(self, frame: StereoFrame) -> RidgeField:
        """The field of `frame`, in rectified pixels.

        Raises:
            InputError: the images are not uint8, gray or BGR, of the rig's size, and alike.
        """
        self._check(frame)
        images = self._rig.rectify(frame.left, frame.right)
        slot = self._steps % _SLOTS
        self._steps += 1
        left, right = (
            view.segment(image, self._weights, slot)
            for view, image in zip(self._views, images, strict=True)
        )
        return RidgeField(frame.stamp, left, right)

    def learn(self, frame: StereoFrame, seed: Seed) -> None:
        """Learn from the surroundings of `seed` what tells the thread from the background."""

    def warm_up(self) -> None:
        """Compile (or load) the kernels, so that the first frame is as quick as the next."""
        width, height = self._rig.image_size
        for shape in ((height, width, 3), (height, width)):
            blank = np.zeros(shape, np.uint8)
            _View(height, width, self._config).segment(blank, self._weights, 0)

    def _check(self, frame: StereoFrame) -> None:
        width, height = self._rig.image_size
        for name, image in (("left", frame.left), ("right", frame.right)):
            if image.dtype != np.uint8:
                raise InputError(f"{name} image: {image.dtype} pixels; 8-bit pixels are expected")
            if image.shape[:2] != (height, width) or image.shape[2:] not in ((), (3,)):
                raise InputError(
                    f"{name} image: shape {image.shape}; ({height}, {width}) gray or "
                    f"({height}, {width}, 3) BGR fits the calibration"
                )
        if frame.left.ndim != frame.right.ndim:
            raise InputError("one image is gray and the other in colour; both must be alike")


_SLOTS = 4


class _View:
    """The buffers and the running c of one view."""

    def __init__(self, height: int, width: int, config: SegmentationConfig) -> None:
        self._config = config
        self._taps = [gaussian_taps(sigma) for sigma in config.sigmas]
        self._kernel = gaussian_kernel(config.blur)
        self._plane = np.empty((height, width), np.float32)
        self._channels = [np.empty((height, width), np.uint8) for _ in range(3)]
        self._vectors = np.empty((2, height, width), np.float32)
        self._strength = np.zeros(((height + 3) // 4, width), np.float32)
        self._outputs = np.empty((_SLOTS, height, width, 2), np.float32)
        self._c = config.c

    def segment(self, image: Image, weights: Float32, slot: int) -> Float32:
        if image.ndim == 2:
            np.copyto(self._plane, image)
        else:
            cv2.split(image, self._channels)
            ridge.mix_channels(*self._channels, weights, self._plane)
        if self._c is None:
            self._filter(1.0)
            self._c = self._automatic_c()
        self._filter(self._c)
        if self._config.c is None:
            self._c += _PULL * (self._automatic_c() - self._c)
        ridge.blur_angles(self._vectors, self._kernel, self._outputs[slot])
        return self._outputs[slot]

    def _filter(self, c: float) -> None:
        shape = 0.5 / self._config.beta**2, 0.5 / c**2
        for i, taps in enumerate(self._taps):
            ridge.ridge_vectors(
                self._plane,
                taps,
                shape,
                _SIGNS[self._config.polarity],
                i > 0,
                self._vectors,
                self._strength,
            )

    def _automatic_c(self) -> float:
        return max(math.sqrt(ridge.quantile(self._strength, 0.998)) / 2, _LEAST_C)


_PULL = 0.1
_LEAST_C = 1.0


def gaussian_taps(sigma: float) -> Float32:
    """(3, r + 1) the right halves, centre first, of a Gaussian and of its first two derivatives.

    The derivatives are those of unit parabolas exactly, multiplied by sigma and sigma^2 so that
    scales compare. Cut at 3 sigma and filled up with zeros to r, a multiple of 4.
    """
    radius = math.ceil(3 * sigma)
    x = np.arange(-(-radius // 4) * 4 + 1, dtype=float)
    smooth = np.where(x <= radius, np.exp(-(x**2) / (2 * sigma**2)), 0)
    smooth /= smooth[0] + 2 * smooth[1:].sum()
    slope = x * smooth
    slope *= sigma / (2 * (x * slope).sum())
    curve = (x**2 / sigma**2 - 1) * smooth
    curve -= smooth * (curve[0] + 2 * curve[1:].sum())
    curve *= sigma**2 / (x**2 * curve).sum()
    return np.array([smooth, slope, curve], np.float32)


def gaussian_kernel(sigma: float) -> Float32:
    """(5, 5) the kernel G of Algorithm 1, sum 1."""
    g = np.exp(-(np.arange(-2, 3) ** 2) / (2 * sigma**2))
    kernel = np.outer(g, g)
    return (kernel / kernel.sum()).astype(np.float32)


def direction_image(field_view: Float32) -> Image:
    """The field of one view in false colour (Fig. 2): hue is direction, brightness is length.

    Args:
        field_view: (H, W, 2) float32, a view of a `RidgeField`.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    length, angle = cv2.cartToPolar(*cv2.split(field_view), angleInDegrees=True)
    hue = cv2.LUT(cv2.convertScaleAbs(angle, alpha=0.5), _HUES)
    value = cv2.convertScaleAbs(length, alpha=255)
    return cv2.cvtColor(cv2.merge([hue, np.full_like(hue, 255), value]), cv2.COLOR_HSV2BGR)

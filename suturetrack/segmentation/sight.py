"""A thread is looked for in both views: the mix of channels, eq. (1) and Algorithm 1."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import ridge, rims, smears
from suturetrack.segmentation.config import SegmentationConfig
from suturetrack.segmentation.contrast import GRAY, SIGMAS, Contrast, channel_means
from suturetrack.segmentation.smear import SCALES, Band
from suturetrack.types import Float32, Float64, Image, StereoFrame

Pair = tuple[Float32, Float32]

_WEIGHTS = {
    "learned": GRAY,
    "gray": GRAY,
    "blue": np.array([1.0, 0.0, 0.0]),
    "green": np.array([0.0, 1.0, 0.0]),
    "red": np.array([0.0, 0.0, 1.0]),
}
_SIGNS = {"auto": (1.0, 1.0), "dark": (1.0, 1.0), "bright": (-1.0, -1.0), "both": (-1.0, 1.0)}
SLOTS = 4
"""Fields whose buffers are in use at the same time."""
# Share of the way that the automatic c goes at each step.
_PULL = 0.1
# How far from the middle of a thread its ground begins, in sigmas.
_GROUND = 2.5
# How far around it a vector depends on the image, in sigmas.
_AROUND = 8.0
# How far beside something a filter still sees it, in sigmas.
_FLANK = 1.0
# Least automatic c, grey levels: what a flawless picture's rounding makes.
_LEAST_C = 1.0
# Least learned c, grey levels: of a channel that shows nothing of the thread.
_FAINTEST_C = 0.01


@dataclass(frozen=True, eq=False)
class Look:
    """What is looked for, in both views."""

    weights: Float64
    """(3,) of blue, green and red."""
    relative: bool
    """Whether the weights are those of channels divided by their means."""
    sigmas: tuple[float, ...]
    signs: tuple[float, float]
    """See `ridge.ridge_field`."""
    across: Float64 | None = None
    """(3,) of `Contrast.across`; None until a thread is learned."""
    wider: tuple[float, ...] = ()
    """Of `Contrast.wider`."""

    def mix(self, means: Float64) -> tuple[Float32, float | None]:
        """The weights for an image with such means, and c, if it was learned.

        The weights are whole 256ths: sums of grey values are exact in float32.
        """
        weights = self.weights / means if self.relative else self.weights
        weights = np.rint(weights / np.abs(weights).sum() * 256) / 256
        c = None
        if self.across is not None:
            c = max(abs(float(self.across * means @ weights)) / 2, _FAINTEST_C)
        return weights.astype(np.float32), c


def first_look(config: SegmentationConfig) -> Look:
    """What is looked for before a seed has taught anything."""
    sigmas = config.sigmas or SIGMAS[:1]
    return Look(_WEIGHTS[config.channel], False, sigmas, _SIGNS[config.polarity])


def learned_look(config: SegmentationConfig, thread: Contrast) -> Look:
    """What is looked for once a thread was learned."""
    signs, sigmas = _SIGNS[config.polarity], config.sigmas or (thread.sigma,)
    if config.channel == "learned":
        weights = -thread.weights if config.polarity == "bright" else thread.weights
        return Look(weights, True, sigmas, signs, thread.across, thread.wider)
    weights = _WEIGHTS[config.channel]
    if config.polarity == "auto" and thread.across @ weights < 0:
        signs = _SIGNS["bright"]
    return Look(weights, False, sigmas, signs, thread.across, thread.wider)


class Sight:
    """One look at both views."""

    def __init__(self, rig: StereoRig, config: SegmentationConfig, look: Look) -> None:
        width, height = rig.image_size
        self._rig = rig
        self._views = _View(height, width, config), _View(height, width, config)
        self.look = look

    def step(self, frame: StereoFrame, slot: int, bands: tuple[Band, Band] | None = None) -> Pair:
        """Both fields of a frame, in the slot's buffers; `bands` are where the thread moves."""
        left, right = self._views
        left.see(frame.left, self.look)
        right.see(frame.right, self.look)
        planes = self._rig.rectify(left.plane, right.plane, out=(left.rectified, right.rectified))
        of_left, of_right = bands or (None, None)
        return (
            left.find(planes[0], self.look, slot, of_left),
            right.find(planes[1], self.look, slot, of_right),
        )


class _View:
    """The buffers and the running c of one view."""

    def __init__(self, height: int, width: int, config: SegmentationConfig) -> None:
        self._config = config
        self._filter = _Filter((height, width), config.beta, config.blur)
        self._smears = _Smears((height, width), config)
        self._channels = [np.empty((height, width), np.uint8) for _ in range(3)]
        self._outputs = np.empty((SLOTS, height, width, 2), np.float32)
        self._relative_c: float | None = None
        self._brightness = 1.0
        self._c: float | None = None
        self.plane = np.empty((height, width), np.float32)
        self.rectified = np.empty((height, width), np.float32)

    def see(self, image: Image, look: Look) -> None:
        """Mix the channels of the raw image into `plane`."""
        means = channel_means(image)
        weights, self._c = look.mix(means)
        self._brightness = float(np.abs(weights) @ means)
        if image.ndim == 2:
            np.multiply(image, weights.sum(), out=self.plane)
        else:
            cv2.split(np.ascontiguousarray(image), self._channels)
            ridge.mix_channels(*self._channels, weights, self.plane)

    def find(self, plane: Float32, look: Look, slot: int, band: Band | None = None) -> Float32:
        """The field of the rectified plane, in the slot's buffer."""
        out, c = self._outputs[slot], self._config.c or self._c
        if c is None:
            self._find_ridges_by_their_quantile(plane, look, out)
            return out
        self._filter.find_ridges(plane, look, c, out)
        if band is not None:
            self._smears.add(plane, look, c, band, out)
        return out

    def _find_ridges_by_their_quantile(self, plane: Float32, look: Look, out: Float32) -> None:
        find = self._filter.find_ridges
        if self._relative_c is None:
            find(plane, look, _LEAST_C, out)
            self._relative_c = self._automatic_c() / self._brightness
        find(plane, look, max(self._relative_c * self._brightness, _LEAST_C), out)
        self._relative_c += _PULL * (self._automatic_c() / self._brightness - self._relative_c)

    def _automatic_c(self) -> float:
        return max(math.sqrt(ridge.quantile(self._filter.strength, 0.998)) / 2, _LEAST_C)


class _Filter:
    """Eq. (1) and Algorithm 1 on images of one size; the rims of what is learned fade."""

    def __init__(self, size: tuple[int, int], beta: float, blur: float) -> None:
        height, width = size
        self._beta, self._kernel = beta, gaussian_kernel(blur)
        self.strength = np.empty(((height + 3) // 4, width), np.float32)
        """See `ridge.ridge_field`."""

    def find_ridges(
        self, plane: Float32, look: Look, c: float, out: Float32, times: float = 1
    ) -> None:
        """Writes the field of a plane into `out`, at so many times the look's scale."""
        shape = 0.5 / self._beta**2, 0.5 / c**2
        sigmas = tuple(times * sigma for sigma in look.sigmas)
        taps = ridge.taps_of(sigmas)
        ridge.ridge_field(plane, *taps, shape, look.signs, self._kernel, out, self.strength)
        if look.relative and look.signs == _SIGNS["dark"]:
            rims.fade_rims(plane, _GROUND * max(sigmas), out)


class _Smears:
    """A moving thread at wider scales, in an image of half the size."""

    def __init__(self, size: tuple[int, int], config: SegmentationConfig) -> None:
        height, width = ((length + 1) // 2 for length in size)
        self._filter = _Filter((height, width), config.beta, config.blur / 2)
        self._plane = np.empty((height, width), np.float32)
        self._field = np.empty((height, width, 2), np.float32)
        self._dark = np.empty((height, width), np.uint8)
        self._mask = np.empty(size, np.uint8)

    def add(self, plane: Float32, look: Look, c: float, band: Band, field: Float32) -> None:
        """Adds to the field of a plane what moves fast in the band and does not show."""
        smeared = band.look_at(field)
        if not smeared.any():
            return
        band.paint(smeared, self._mask)
        painted = np.flatnonzero(self._mask.any(axis=1)) // 2
        if len(painted) == 0:
            return
        size = self._plane.shape[::-1]
        cv2.resize(plane, size, dst=self._plane, interpolation=cv2.INTER_AREA)
        for scale, wider in zip(SCALES, look.wider, strict=True):
            times = scale.times / 2
            around, flank = (round(k * times * max(look.sigmas)) for k in (_AROUND, _FLANK))
            rows = slice(max(painted[0] - around, 0), painted[-1] + around)
            self._filter.find_ridges(self._plane[rows], look, c, self._field[rows], times)
            bounds = scale.bounds(wider)
            smears.find_longer_than(bounds[1], self._field[rows], self._dark[rows])
            # The flanks of what is too dark are none either.
            beside = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * flank + 1,) * 2)
            cv2.dilate(self._dark[rows], beside, dst=self._dark[rows])
            smears.keep_longer_of_half(self._field, self._dark, bounds, self._mask, field)


def gaussian_kernel(sigma: float) -> Float32:
    """(5, 5) the kernel G of Algorithm 1, sum 1."""
    g = np.exp(-(np.arange(-2, 3) ** 2) / (2 * sigma**2))
    kernel = np.outer(g, g)
    return (kernel / kernel.sum()).astype(np.float32)

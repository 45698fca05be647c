"""From a stereo pair to the ridge vector field: eq. (1) and Algorithm 1 (Section III)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.contrast import (
    GRAY,
    SIGMAS,
    Contrast,
    channel_means,
    contrast_along,
    contrast_at,
)
from suturetrack.kernels import ridge, rims
from suturetrack.silhouette import is_cut_out, silhouette_scale, silhouettes
from suturetrack.types import (
    Float32,
    Float64,
    Image,
    InputError,
    RidgeField,
    Seed,
    Stamp,
    StereoFrame,
)

Channel = Literal["learned", "gray", "blue", "green", "red"]
Polarity = Literal["auto", "dark", "bright", "both"]
_Pair = tuple[Float32, Float32]

_WEIGHTS = {
    "learned": GRAY,
    "gray": GRAY,
    "blue": np.array([1.0, 0.0, 0.0]),
    "green": np.array([0.0, 1.0, 0.0]),
    "red": np.array([0.0, 0.0, 1.0]),
}
_SIGNS = {"auto": (1.0, 1.0), "dark": (1.0, 1.0), "bright": (-1.0, -1.0), "both": (-1.0, 1.0)}
# Fields whose buffers are in use at the same time.
_SLOTS = 4
# Share of the way that the automatic c, and a learned contrast, go at each step.
_PULL, _ADAPT = 0.1, 0.2
# What is left at each step of the contrast of a thread that stays lost.
_FADE = 0.5
# How far from the middle of a thread its ground begins, in sigmas.
_GROUND = 2.5
# Fewest pixels of a curve from which contrast is learned.
_FEWEST_PIXELS = 8
# Least automatic c, grey levels: what a flawless picture's rounding makes.
_LEAST_C = 1.0


@dataclass(frozen=True)
class SegmentationConfig:
    """How the images are turned into the ridge vector field."""

    sigmas: tuple[float, ...] | None = None
    """Standard deviations of the Gaussian whose second derivatives are taken, px: a third to half of
    the thread's width. Of several, the one with the longest vector counts at each pixel. None: 1.2
    until a seed shows how wide the thread is."""
    beta: float = 0.5
    """Beta of eq. (1): how far a ridge may be from straight and endless before it fades."""
    c: float | None = None
    """c of eq. (1), grey levels: the strength S at which a ridge counts by 40 %. None: half the
    99.8th percentile of S until a seed shows the thread's S, then half of that; it follows the
    brightness of the image."""
    blur: float = 1.2
    """Standard deviation of the Gaussian G of Algorithm 1, px, on a window of 5x5."""
    channel: Channel = "learned"
    """Which channel, or mix of channels, is looked at. `learned`: gray until a seed shows what
    tells the thread from its surroundings."""
    polarity: Polarity = "auto"
    """Whether the thread is darker or brighter than its surroundings. `auto`: dark until a seed
    shows otherwise."""
    adapt: bool = True
    """Whether what was learned of a thread follows, once a second, how it looks along its curve."""

    def __post_init__(self) -> None:
        if not all(sigma > 0 for sigma in (self.beta, self.blur, *(self.sigmas or (1.0,)))):
            raise InputError("segmentation: sigmas, beta and blur must be positive")
        if self.sigmas == () or (self.c is not None and not self.c > 0):
            raise InputError(
                "segmentation: give sigmas and a positive c, or None for automatic ones"
            )


class Segmenter:
    """Turns stereo frames into ridge vector fields.

    Each learned thread is looked for in a field of its own; of several, the longest vectors make the
    field of all. The buffers of a field are used again four steps later; who keeps a field longer
    copies it.
    """

    def __init__(self, rig: StereoRig, config: SegmentationConfig = SegmentationConfig()) -> None:
        self._rig = rig
        self._config = config
        self._threads: dict[str, Contrast] = {}
        self._clear: dict[str, Contrast] = {}
        """As they were when they were seen last."""
        self._seeded: set[str] = set()
        self._first = _Sight(rig, config, _first_look(config))
        self._sights: dict[str, _Sight] = {}
        self._all: Float32 | None = None
        self._steps = 0
        self._is_cut_out = False

    @property
    def threads(self) -> tuple[str, ...]:
        """Names of the threads that were learned."""
        return tuple(self._threads)

    @property
    def unlearned(self) -> frozenset[str]:
        """Names of the threads whose seeds have taught nothing."""
        return frozenset(self._seeded - self._threads.keys())

    def step(self, frame: StereoFrame) -> RidgeField:
        """The field of `frame`, in rectified pixels.

        Raises:
            InputError: the images are not uint8, gray or BGR, of the rig's size, and alike.
        """
        self._check(frame)
        frame = self._seen(frame)
        slot = self._steps % _SLOTS
        self._steps += 1
        own = {name: sight.step(frame, slot) for name, sight in self._sights.items()}
        if len(own) > 1:
            return joined(frame.stamp, own, self._room_for_all(slot))
        return RidgeField(
            frame.stamp, *(own.popitem()[1] if own else self._first.step(frame, slot))
        )

    def learn(self, frame: StereoFrame, seed: Seed) -> None:
        """Learn at `seed` what tells its thread from the surroundings: colours, width, contrast.

        A seed with no ridge within 8 px teaches nothing. Where the thread was cut out of its picture,
        only its outline counts from then on.

        Raises:
            InputError: as `step`, or the seed lies outside the left image.
        """
        self._check(frame)
        own = self._config.channel == "learned" and self._config.polarity == "auto"
        self._is_cut_out = own and is_cut_out(frame)
        frame = self._seen(frame)
        image = self._rig.rectify(frame.left, frame.right)[0]
        pixel = self._locate(seed)
        contrast = contrast_at(image, pixel)
        self._seeded.add(seed.thread)
        if contrast is not None:
            if self._is_cut_out:
                contrast = replace(contrast, sigma=max(silhouette_scale(frame.left), SIGMAS[0]))
            self._clear[seed.thread] = contrast
            self._look_for(seed.thread, contrast)

    def forget(self, thread: str) -> None:
        """Look for a thread no more; without any, look as before the first was learned."""
        self._seeded.discard(thread)
        if self._threads.pop(thread, None) is not None:
            del self._clear[thread], self._sights[thread]
            self._is_cut_out &= bool(self._threads)

    def adapt(self, frame: StereoFrame, pixels: Float64, thread: str = "0") -> None:
        """Follow slow changes of the light: go a part of the way to what a held curve shows.

        Args:
            frame: the frame that the curve belongs to.
            pixels: (N, 2) raw left pixels along the curve, where the thread is seen.
            thread: which thread this is; one that was never learned is left alone, and every one
            where the configuration says so.

        Raises:
            InputError: as `step`.
        """
        self._check(frame)
        frame = self._seen(frame)
        width, height = self._rig.image_size
        inside = (pixels >= 0).all(1) & (pixels <= (width - 1, height - 1)).all(1)
        learned = self._config.adapt and thread in self._threads
        if not learned or np.count_nonzero(inside) < _FEWEST_PIXELS:
            return
        old, clear = self._threads[thread], self._clear[thread]
        seen = contrast_along(frame.left, pixels[inside], old.sigma)
        # What was lost may be as clear as before, or as faint as it was found again.
        nearer = min(old, clear, key=lambda contrast: abs(contrast.strength - seen.strength))
        followed = nearer.follow(seen, _ADAPT)
        if followed is not nearer:
            self._clear[thread] = followed
            self._look_for(thread, followed)

    def fade(self, thread: str = "0") -> None:
        """Look for a thread that is lost as if it stood out less than before, down to a quarter of what
        it did when it was seen last.

        Focus, smoke or light may have changed at once, when no curve is held that could show it.
        """
        if not self._config.adapt or thread not in self._threads:
            return
        self._look_for(thread, self._threads[thread].fainter(_FADE, self._clear[thread]))

    def warm_up(self) -> None:
        """Compile (or load) the kernels, so that the first frame is as quick as the next."""
        width, height = self._rig.image_size
        # Learned, so that rims fade as well.
        sight = _Sight(self._rig, self._config, replace(self._first.look, relative=True))
        for shape in ((height, width, 3), (height, width)):
            black = np.zeros(shape, np.uint8)
            field = sight.step(StereoFrame(Stamp(0, 0, 0), black, black), 0)
            ridge.keep_longer(field[0], field[1])

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

    def _seen(self, frame: StereoFrame) -> StereoFrame:
        return silhouettes(frame) if self._is_cut_out else frame

    def _locate(self, seed: Seed) -> tuple[float, float]:
        if seed.pixel is not None:
            u, v = self._rig.rectify_pixels(np.array(seed.pixel, float))
        else:
            u, v = self._rig.project(np.array(seed.point, float))[0]
        width, height = self._rig.image_size
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
            raise InputError(
                f"seed at ({u:.0f}, {v:.0f}) px: outside the left image of {width}x{height}"
            )
        return float(u), float(v)

    def _look_for(self, thread: str, contrast: Contrast) -> None:
        self._threads[thread] = contrast
        look = _learned_look(self._config, contrast)
        if thread in self._sights:
            self._sights[thread].look = look
        else:
            self._sights[thread] = _Sight(self._rig, self._config, look)

    def _room_for_all(self, slot: int) -> _Pair:
        width, height = self._rig.image_size
        if self._all is None:
            self._all = np.empty((_SLOTS, 2, height, width, 2), np.float32)
        left, right = self._all[slot]
        return left, right


def joined(stamp: Stamp, own: Mapping[str, _Pair], out: _Pair | None = None) -> RidgeField:
    """The field of several threads: at each pixel the longest of their vectors.

    Args:
        stamp: of the frame.
        own: by thread, left and right, (H, W, 2) float32 each.
        out: where to put left and right; without it, new arrays that nobody may write to.
    """
    first, *others = own.values()
    left, right = out or (np.empty_like(first[0]), np.empty_like(first[1]))
    for side, longest in enumerate((left, right)):
        np.copyto(longest, first[side])
        for other in others:
            ridge.keep_longer(other[side], longest)
        longest.flags.writeable = out is not None
    return RidgeField(stamp, left, right, own)


@dataclass(frozen=True, eq=False)
class _Look:
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

    def mix(self, means: Float64) -> tuple[Float32, float | None]:
        """The weights for an image with such means, and c, if it was learned.

        The weights are whole 256ths: sums of grey values are exact in float32.
        """
        weights = self.weights / means if self.relative else self.weights
        weights = np.rint(weights / np.abs(weights).sum() * 256) / 256
        c = None
        if self.across is not None:
            c = abs(float(self.across * means @ weights)) / 2
        return weights.astype(np.float32), c


def _first_look(config: SegmentationConfig) -> _Look:
    sigmas = config.sigmas or SIGMAS[:1]
    return _Look(_WEIGHTS[config.channel], False, sigmas, _SIGNS[config.polarity])


def _learned_look(config: SegmentationConfig, thread: Contrast) -> _Look:
    signs, sigmas = _SIGNS[config.polarity], config.sigmas or (thread.sigma,)
    if config.channel == "learned":
        weights = -thread.weights if config.polarity == "bright" else thread.weights
        return _Look(weights, True, sigmas, signs, thread.across)
    weights = _WEIGHTS[config.channel]
    if config.polarity == "auto" and thread.across @ weights < 0:
        signs = _SIGNS["bright"]
    return _Look(weights, False, sigmas, signs, thread.across)


class _Sight:
    """One look at both views."""

    def __init__(self, rig: StereoRig, config: SegmentationConfig, look: _Look) -> None:
        width, height = rig.image_size
        self._rig = rig
        self._views = _View(height, width, config), _View(height, width, config)
        self.look = look

    def step(self, frame: StereoFrame, slot: int) -> _Pair:
        """Both fields of a frame, in the slot's buffers."""
        left, right = self._views
        left.see(frame.left, self.look)
        right.see(frame.right, self.look)
        planes = self._rig.rectify(left.plane, right.plane, out=(left.rectified, right.rectified))
        return left.filter(planes[0], self.look, slot), right.filter(planes[1], self.look, slot)


class _View:
    """The buffers and the running c of one view."""

    def __init__(self, height: int, width: int, config: SegmentationConfig) -> None:
        self._config = config
        self._kernel = gaussian_kernel(config.blur)
        self._channels = [np.empty((height, width), np.uint8) for _ in range(3)]
        self._strength = np.empty(((height + 3) // 4, width), np.float32)
        self._outputs = np.empty((_SLOTS, height, width, 2), np.float32)
        self._relative_c: float | None = None
        self._brightness = 1.0
        self._c: float | None = None
        self.plane = np.empty((height, width), np.float32)
        self.rectified = np.empty((height, width), np.float32)

    def see(self, image: Image, look: _Look) -> None:
        """Mix the channels of the raw image into `plane`."""
        means = channel_means(image)
        weights, self._c = look.mix(means)
        self._brightness = float(np.abs(weights) @ means)
        if image.ndim == 2:
            np.multiply(image, weights.sum(), out=self.plane)
        else:
            cv2.split(np.ascontiguousarray(image), self._channels)
            ridge.mix_channels(*self._channels, weights, self.plane)

    def filter(self, plane: Float32, look: _Look, slot: int) -> Float32:
        """Eq. (1) and Algorithm 1 on the rectified plane, into the slot's buffer; rims fade where a
        thread was learned."""
        out, c = self._outputs[slot], self._config.c or self._c
        if c is None:
            self._find_ridges_by_their_quantile(plane, look, out)
        else:
            self._find_ridges(plane, look, c, out)
        return out

    def _find_ridges_by_their_quantile(self, plane: Float32, look: _Look, out: Float32) -> None:
        if self._relative_c is None:
            self._find_ridges(plane, look, _LEAST_C, out)
            self._relative_c = self._automatic_c() / self._brightness
        self._find_ridges(plane, look, max(self._relative_c * self._brightness, _LEAST_C), out)
        self._relative_c += _PULL * (self._automatic_c() / self._brightness - self._relative_c)

    def _find_ridges(self, plane: Float32, look: _Look, c: float, out: Float32) -> None:
        shape = 0.5 / self._config.beta**2, 0.5 / c**2
        taps = ridge.taps_of(look.sigmas)
        ridge.ridge_field(plane, *taps, shape, look.signs, self._kernel, out, self._strength)
        if look.relative and look.signs == _SIGNS["dark"]:
            rims.fade_rims(plane, _GROUND * max(look.sigmas), out)

    def _automatic_c(self) -> float:
        return max(math.sqrt(ridge.quantile(self._strength, 0.998)) / 2, _LEAST_C)


def gaussian_kernel(sigma: float) -> Float32:
    """(5, 5) the kernel G of Algorithm 1, sum 1."""
    g = np.exp(-(np.arange(-2, 3) ** 2) / (2 * sigma**2))
    kernel = np.outer(g, g)
    return (kernel / kernel.sum()).astype(np.float32)

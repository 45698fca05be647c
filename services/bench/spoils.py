"""What makes good footage hard: light, lens, sensor, order, and a gripper over the thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.kernels import tubes
from suturetrack.stage.appearance import Look, compressed
from suturetrack.stage.cameras import Viewpoint
from suturetrack.stage.painter import Painter, Strand, gripper_strands
from suturetrack.stage.play import jaws
from suturetrack.types import Bool, Float32, Float64, Image

Pair = tuple[Image, Image]
_FIXED_POSE = Viewpoint(np.eye(3), np.zeros(3))
# How far the gripper is above the thread, over it, and away from it at most.
_LIFT_MM, _OVER_MM, _AWAY_MM = 3.0, 8.0, 40.0


@dataclass(frozen=True)
class Spoil:
    """One way to make footage hard."""

    image: Callable[[Image, float, Float64], Image] | None = None
    """(image, time in s, (4,) numbers drawn from [0, 1) for the whole run) -> image."""
    gripper: bool = False
    """A gripper comes and goes over the thread."""
    step: int = 1
    """Only every so manyth frame, so that all moves as many times as fast; below 0 from the last one back."""


def _noise(image: Image, time: float, draw: Float64) -> Image:
    rng = np.random.default_rng([int(1e9 * draw[0]), round(1e6 * time)])
    return _image(image + rng.normal(0, 6 + 6 * draw[1], image.shape))


def _blur(image: Image, _: float, draw: Float64) -> Image:
    sigma = image.shape[1] * (1 + draw[0]) / 640
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def _jpeg(image: Image, _: float, draw: Float64) -> Image:
    return compressed(image, int(15 + 25 * draw[0]))


def _dark(image: Image, _: float, draw: Float64) -> Image:
    return _image(255 * (image / 255) ** (1.6 + 0.6 * draw[0]))


def _flicker(image: Image, time: float, draw: Float64) -> Image:
    return _image(image * (0.8 + 0.25 * np.sin((20 + 20 * draw[0]) * time + 6 * draw[1])))


def _spot(image: Image, time: float, draw: Float64) -> Float64:
    """(H, W) a soft spot of a sixth of the height that goes round in 3 s, 1 in its middle."""
    height, width = image.shape[:2]
    turn = 2 * np.pi * (time / 3 + draw[0])
    u, v = width * (0.5 + 0.3 * np.cos(turn)), height * (0.5 + 0.3 * np.sin(turn + draw[1]))
    y, x = np.ogrid[:height, :width]
    return np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * (height / 6) ** 2))


def _glare(image: Image, time: float, draw: Float64) -> Image:
    return _lit(image, 1.0, 130 * _spot(image, time, draw))


def _shadow(image: Image, time: float, draw: Float64) -> Image:
    return _lit(image, 1 - 0.65 * _spot(image, time, draw), 0.0)


def _gray(image: Image, *_: object) -> Image:
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _lit(image: Image, share: float | Float64, more: float | Float64) -> Image:
    planes = image if image.ndim == 3 else image[..., None]
    add_axis = partial(np.expand_dims, axis=-1)
    return _image(planes * add_axis(share) + add_axis(more)).reshape(image.shape)


def _image(values: Float64) -> Image:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


SPOILS = {
    "nothing": Spoil(),
    "noise": Spoil(_noise),
    "blur": Spoil(_blur),
    "jpeg": Spoil(_jpeg),
    "dark": Spoil(_dark),
    "gray": Spoil(_gray),
    "flicker": Spoil(_flicker),
    "glare": Spoil(_glare),
    "shadow": Spoil(_shadow),
    "every-third": Spoil(step=3),
    "backwards": Spoil(step=-1),
    "gripper": Spoil(gripper=True),
}
"""Ways to make footage hard, by name."""


class Gripper:
    """A gripper that goes along the thread, and every few seconds away from it and back, drawn over footage.

    Args:
        rig: the cameras of the footage.
        draw: (4,) numbers from [0, 1): where it is at first, and where it comes from.
    """

    def __init__(self, rig: StereoRig, draw: Float64) -> None:
        self._rig, self._draw = rig, draw
        heading, rise = 2 * np.pi * draw[0], np.radians(15 + 25 * draw[1])
        flat = [np.cos(heading) * np.cos(rise), np.sin(heading) * np.cos(rise), -np.sin(rise)]
        self._back = np.array(flat)
        lamp = np.array([0.3, -0.3, -1.0])
        self._look = Look(
            lamp / np.linalg.norm(lamp), 0, 0, 0.6, 0, 0, None, np.ones(3), np.zeros((3, 3))
        )
        self._fragments = tubes.make_fragments(rig.image_size)
        width, height = rig.image_size
        self._silent = np.zeros((height, width, 3), np.int8)

    def over(self, pair: Pair, thread: Float64, time: float) -> Pair:
        """Both raw images with the gripper over a (N, 3) thread of the rectified left frame."""
        left, right = (
            self._painted(painter, image, thread, time)
            for painter, image in zip(self._painters(pair, thread), pair, strict=True)
        )
        return left, right

    def hides(self, pair: Pair, thread: Float64, time: float) -> Bool:
        """(N,) whether the gripper covers the places of the thread in either view."""
        strands = self._strands(thread, time)
        views = self._painters(pair, thread)
        return np.any([p.hides(s, thread) for p in views for s in strands], axis=0)

    def _painters(self, pair: Pair, thread: Float64) -> list[Painter]:
        focus = float(thread[:, 2].mean())
        return [
            Painter(
                self._rig,
                bool(k),
                _FIXED_POSE,
                self._look,
                _coloured(image),
                focus,
                self._fragments,
            )
            for k, image in enumerate(pair)
        ]

    def _painted(self, painter: Painter, image: Image, thread: Float64, time: float) -> Image:
        painter.expose(self._strands(thread, time), 1.0)
        picture = painter.develop(np.ones(3, np.float32), self._silent)
        return _gray(picture) if image.ndim == 2 else picture

    def _strands(self, thread: Float64, time: float) -> list[Strand]:
        mm = self._rig.mm_per_unit
        place = 1 - abs(1 - (2 * self._draw[2] + 0.2 * time) % 2)
        goal = mm * thread[round(place * (len(thread) - 1))] - [0, 0, _LIFT_MM]
        away = np.clip(
            _AWAY_MM * np.sin(2 * np.pi * (time / 4 + self._draw[3])) - _OVER_MM, -_OVER_MM, None
        )
        gripper = jaws(goal + away * self._back, self._back, opening=3.0)
        return [
            replace(s, points=s.points / mm, radius=s.radius / mm) for s in gripper_strands(gripper)
        ]


def _coloured(image: Image) -> Float32:
    planes = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    return planes.astype(np.float32)


class Spoiler:
    """Spoils one run.

    Args:
        spoil: how.
        rig: the cameras of the footage.
        draw: (4,) numbers from [0, 1): what it is like, this time.
    """

    def __init__(self, spoil: Spoil, rig: StereoRig, draw: Float64) -> None:
        self._image, self._draw = spoil.image, draw
        self._gripper = Gripper(rig, draw) if spoil.gripper else None

    def spoiled(self, pair: Pair, thread: Float64, time: float) -> Pair:
        """Both raw images, so many seconds after the first; the thread is (N, 3), rectified left frame."""
        if self._gripper is not None:
            pair = self._gripper.over(pair, thread, time)
        if self._image is not None:
            pair = self._image(pair[0], time, self._draw), self._image(pair[1], time, self._draw)
        return pair

    def in_sight(self, pair: Pair, thread: Float64) -> Float64:
        """(n, 3) those of the thread's places that are in sight in the first pair; all if none is."""
        if self._gripper is None:
            return thread
        shown = thread[~self._gripper.hides(pair, thread, 0.0)]
        return shown if len(shown) else thread

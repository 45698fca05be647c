"""What lies under the threads: textures of the table, seen by both cameras."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.stage.cameras import Viewpoint
from suturetrack.types import Float32, Float64

# Texture pixels a mm, and pixels along its sides.
_TEXTURE_PER_MM = 6.0
_TEXTURE_SIZE = 2048


def smooth_noise(
    rng: np.random.Generator, cells: int, octaves: int, falloff: float = 0.5
) -> Float32:
    """(S, S) noise with `cells` lumps along the side and finer ones on top; standard deviation 1."""
    total = np.zeros((_TEXTURE_SIZE, _TEXTURE_SIZE), np.float32)
    for octave in range(octaves):
        grid = rng.standard_normal((cells * 2**octave,) * 2).astype(np.float32)
        grid = cv2.resize(grid, (_TEXTURE_SIZE,) * 2, interpolation=cv2.INTER_CUBIC)
        total += falloff**octave * grid
    return (total - total.mean()) / total.std()


def marbled(rng: np.random.Generator) -> Float32:
    """Construction paper in swirls of red and orange; (S, S, 3) BGR."""
    warp = [smooth_noise(rng, 6, 4) for _ in range(2)]
    swirl = smooth_noise(rng, 10, 5)
    bands = np.sin(2.2 * swirl + 1.7 * warp[0]) + 0.35 * smooth_noise(rng, 40, 4)
    share = 1 / (1 + np.exp(-2.0 * (bands + 0.5 * warp[1])))[..., None]
    red, orange = rng.normal([38, 34, 172], 8), rng.normal([62, 118, 224], 8)
    paper = red + (orange - red) * share
    fibres = 1 + 0.035 * smooth_noise(rng, 256, 3, 0.8)[..., None]
    light = 1 + 0.06 * smooth_noise(rng, 2, 2)[..., None]
    return (paper * fibres * light).astype(np.float32)


def plain(rng: np.random.Generator) -> Float32:
    """A sheet of one light colour; (S, S, 3) BGR."""
    colour = rng.uniform([120, 120, 130], [200, 200, 220]).astype(np.float32)
    return np.full((_TEXTURE_SIZE, _TEXTURE_SIZE, 3), colour)


TEXTURES: dict[str, Callable[[np.random.Generator], Float32]] = {
    "marbled": marbled,
    "plain": plain,
}


def look(texture: Float32, rig: StereoRig, view: Viewpoint, blur_px: float) -> list[Float32]:
    """The texture of the table's plane as both cameras see it: two (H, W, 3) BGR images."""
    width, height = rig.image_size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    images = []
    for right in (False, True):
        place = _on_table(rig, view, rig.rectify_pixels(grid, right=right), right)
        uv = (place * _TEXTURE_PER_MM + _TEXTURE_SIZE / 2).astype(np.float32)
        image = cv2.remap(texture, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        images.append(cv2.GaussianBlur(image, (0, 0), blur_px))
    return images


def _on_table(rig: StereoRig, view: Viewpoint, pixels: Float64, right: bool) -> Float64:
    """(H, W, 2) x and y on the table of (H, W, 2) rectified pixels."""
    projection = rig.right.projection if right else rig.left.projection
    rays = (pixels - projection[:2, 2]) / projection[[0, 1], [0, 1]]
    rays = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ view.rotation
    camera = view.to_table(np.array([rig.baseline if right else 0.0, 0.0, 0.0]))
    return camera[:2] - rays[..., :2] * (camera[2] / rays[..., 2:])

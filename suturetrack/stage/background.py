"""What lies under the threads: textures of the table, seen by both cameras."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from suturetrack.camera import StereoRig
from suturetrack.stage.cameras import Viewpoint
from suturetrack.types import Float32, Float64

# Texture pixels a mm, and pixels along its sides; its middle is the table's origin.
_PER_MM = 8.0
_SIZE = 2048
# Width and depth of a vein along its way.
_TAPER = (0.4, 0.7, 0.9, 1.0, 1.0, 0.9, 0.7, 0.4)


def smooth_noise(
    rng: np.random.Generator, cells: int, octaves: int, falloff: float = 0.5
) -> Float32:
    """(S, S) noise with `cells` lumps along the side and finer ones on top; standard deviation 1."""
    fine = min(4 * cells * 2 ** (octaves - 1), _SIZE)
    total = np.zeros((fine, fine), np.float32)
    for octave in range(octaves):
        grid = rng.standard_normal((cells * 2**octave,) * 2, np.float32)
        grid = cv2.resize(grid, (fine, fine), interpolation=cv2.INTER_CUBIC)
        total += falloff**octave * grid
    total = (total - total.mean()) / total.std()
    return np.asarray(cv2.resize(total, (_SIZE, _SIZE), interpolation=cv2.INTER_CUBIC), np.float32)


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


def tissue(rng: np.random.Generator) -> Float32:
    """Wet, lumpy tissue with veins and glints; (S, S, 3) BGR."""
    lumps = cv2.GaussianBlur(smooth_noise(rng, 12, 3, 0.45), (0, 0), _PER_MM)
    slope = [cv2.Sobel(lumps, cv2.CV_32F, *way, ksize=5) for way in ((1, 0), (0, 1))]
    way = rng.uniform(0, 2 * np.pi)
    lit = np.float32(np.cos(way)) * slope[0] + np.float32(np.sin(way)) * slope[1]
    light = 1 + 0.13 * lit / lit.std() + 0.07 * smooth_noise(rng, 3, 2)
    pale, red = rng.normal([128, 146, 196], 12), rng.normal([66, 72, 158], 10)
    share = 1 / (1 + np.exp(-1.1 * smooth_noise(rng, 9, 4)))[..., None]
    texture = (pale + (red - pale) * share) * light[..., None]
    texture = texture.astype(np.float32) * (1 + 0.03 * smooth_noise(rng, 200, 3, 0.8)[..., None])
    half = _SIZE / 2 / _PER_MM
    veins = [
        wander(
            rng, rng.uniform(-half, half, 2), rng.uniform(0, 2 * np.pi), rng.uniform(20, 90), 25.0
        )
        for _ in range(rng.integers(50, 80))
    ]
    texture = with_veins(texture, rng, veins, (0.2, 1.1))
    return with_glints(texture, rng, lit)


def plain(rng: np.random.Generator) -> Float32:
    """A sheet of one light colour; (S, S, 3) BGR."""
    colour = rng.uniform([120, 120, 130], [200, 200, 220]).astype(np.float32)
    return np.full((_SIZE, _SIZE, 3), colour)


TEXTURES: dict[str, Callable[[np.random.Generator], Float32]] = {
    "marbled": marbled,
    "tissue": tissue,
    "plain": plain,
}


def wander(
    rng: np.random.Generator, start: Float64, heading: float, length: float, straight: float
) -> Float64:
    """(N, 2) a random smooth line on the table, mm, that turns over lengths of about `straight`."""
    s = np.arange(0, length, 0.5)
    turn = sum(
        rng.normal(0, 0.5) * (np.sin(s / scale + phase) - np.sin(phase))
        for scale in (straight / 2, straight / 5)
        for phase in rng.uniform(0, 2 * np.pi, 1)
    )
    step = 0.5 * np.stack([np.cos(heading + turn), np.sin(heading + turn)], axis=1)
    return start + np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])


def with_veins(
    texture: Float32, rng: np.random.Generator, lines: list[Float64], widths: tuple[float, float]
) -> Float32:
    """The texture with veins along (N, 2) lines on the table, mm wide within `widths`, tapering off."""
    ink = np.zeros((_SIZE, _SIZE), np.float32)
    for line in lines:
        width, depth = rng.uniform(*widths) * _PER_MM, rng.uniform(0.25, 0.75)
        pixels = np.round((line * _PER_MM + _SIZE / 2) * 16).astype(np.int32)
        vein = np.zeros((_SIZE, _SIZE), np.uint8)
        for piece, share in zip(np.array_split(np.arange(len(pixels)), 8), _TAPER, strict=True):
            part = pixels[piece[0] : piece[-1] + 2]
            thickness = max(round(width * share), 1)
            cv2.polylines(vein, [part], False, round(255 * share), thickness, cv2.LINE_AA, shift=4)
        ink = np.maximum(ink, vein * np.float32(depth / 255))
    ink = cv2.GaussianBlur(ink, (0, 0), 0.12 * _PER_MM)[..., None]
    return texture * (1 - ink * np.array([0.3, 0.5, 0.42], np.float32))


def with_glints(texture: Float32, rng: np.random.Generator, facing: Float32) -> Float32:
    """The texture with small bright spots in clusters where it faces the light."""
    wet = smooth_noise(rng, 14, 2) + facing / (2 * facing.std())
    speck = smooth_noise(rng, 150, 2, 0.6)
    glint = np.clip((speck - 1.7) * 4, 0, 1) * np.clip((wet - 1.2) * 3, 0, 1)
    glint = cv2.GaussianBlur(glint, (0, 0), 0.1 * _PER_MM)[..., None]
    return texture + (255 - texture) * np.minimum(1.6 * glint, 1)


def with_hole(texture: Float32, place: Float64, radius: float) -> Float32:
    """The texture with a dark hole at (2,) `place` on the table, mm."""
    y, x = np.ogrid[:_SIZE, :_SIZE]
    u, v = place * _PER_MM + _SIZE / 2
    distance = np.hypot(x - u, y - v) / _PER_MM - radius
    share = np.clip(0.5 - distance / 0.3, 0, 1)[..., None].astype(np.float32)
    return texture * (1 - 0.85 * share)


def look_at(texture: Float32, rig: StereoRig, view: Viewpoint, blur_px: float) -> list[Float32]:
    """The texture of the table's plane as both cameras see it: two (H, W, 3) BGR images."""
    width, height = rig.image_size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    images = []
    for right in (False, True):
        place = _on_table(rig, view, rig.rectify_pixels(grid, right=right), right)
        uv = (place * _PER_MM + _SIZE / 2).astype(np.float32)
        image = cv2.remap(texture, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        images.append(cv2.GaussianBlur(image, (0, 0), blur_px))
    return images


def _on_table(rig: StereoRig, view: Viewpoint, pixels: Float64, right: bool) -> Float64:
    """(H, W, 2) x and y on the table of (H, W, 2) rectified pixels."""
    projection = rig.right.projection if right else rig.left.projection
    inverse = np.linalg.inv(projection[:, :3])
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    rays = homogeneous @ inverse.T @ view.rotation
    camera = view.to_table(-inverse @ projection[:, 3])
    return camera[:2] - rays[..., :2] * (camera[2] / rays[..., 2:])

"""Paints strands over the table, as one camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from suturetrack.camera import StereoRig
from suturetrack.kernels import tubes
from suturetrack.stage.appearance import STEEL, Look, Surface, shading, vignette
from suturetrack.stage.cameras import Viewpoint, folds_back
from suturetrack.types import Bool, Float32, Float64, Image

# The pixel's own blur: the standard deviation of a box one pixel wide.
_PIXEL_BLUR = 12**-0.5
# Penumbra of a shadow per height over the table, and the largest as a share of the image's width.
_PENUMBRA = 0.12
_LARGEST_PENUMBRA = 1 / 160
# A gripper's shadow lies over threads that are lower than that, mm.
_SHADED_HEIGHT = 6.0
_JAW_RADII, _SHAFT_RADIUS, _SHAFT_LENGTH = (0.55, 1.3), 2.5, 140.0


@dataclass(frozen=True, eq=False)
class Strand:
    """A tube in the table's frame, mm."""

    points: Float64
    """(N, 3) centreline."""
    radius: Float64
    """(N,) or (1,)."""
    surface: Surface
    is_tool: bool = False


def gripper_strands(gripper: Float64) -> list[Strand]:
    """Jaws and shaft of a gripper given by its (3, 3) tips and wrist."""
    first, second, wrist = gripper
    back = wrist - (first + second) / 2
    back /= np.linalg.norm(back)
    share = np.linspace(0, 1, 5)[:, None]
    jaws = [
        Strand(tip + share * (wrist - tip), np.linspace(*_JAW_RADII, 5), STEEL, is_tool=True)
        for tip in (first, second)
    ]
    along = np.r_[0.0, np.linspace(2.0, _SHAFT_LENGTH, 14)]
    radius = np.minimum(_JAW_RADII[1] + 0.6 * along, _SHAFT_RADIUS)
    shaft = Strand(wrist + along[:, None] * back, radius, STEEL, is_tool=True)
    return [*jaws, shaft]


class Painter:
    """Turns strands into the image of one camera of the rig; `fragments` may be shared by both."""

    def __init__(
        self,
        rig: StereoRig,
        right: bool,
        view: Viewpoint,
        look: Look,
        background: Float32,
        focus: float,
        fragments: tubes.Fragments,
    ) -> None:
        self._rig, self._right, self._view, self._look = rig, right, view, look
        self._focus, self._focal = focus, float(rig.left.matrix[0, 0])
        self._background = background
        self._vignette = vignette(rig.image_size, look.vignetting)
        self._fragments = fragments
        width, height = rig.image_size
        self._layer = np.zeros((height, width, 4), np.float32)

    def expose(self, strands: list[Strand], share: float) -> None:
        """Adds what the strands show during a share of the exposure."""
        for number, strand in enumerate(strands):
            if self._look.shadow:
                self._draw_shadow(2 * number, strand)
            self._draw(2 * number + 1, strand)
        tubes.composite(self._fragments, self._layer, share)

    def bake(self) -> None:
        """Makes what was exposed part of the background."""
        clear = 1 - self._layer[..., 3:]
        self._background = self._background * clear + self._layer[..., :3]
        self._layer[:] = 0

    def develop(self, gain: Float32, noise: NDArray[np.int8]) -> Image:
        """The image of what was exposed since the last one: (H, W, 3) uint8 BGR."""
        picture = np.empty(self._background.shape, np.uint8)
        tubes.develop(
            self._background,
            self._layer,
            self._vignette,
            gain,
            noise,
            np.float32(self._look.noise / 16),
            picture,
        )
        return picture

    def hides(self, strand: Strand, points: Float64) -> Bool:
        """(N,) whether the strand covers (N, 3) points of the camera's frame."""
        path = self._path(strand.points, strand.radius)
        if len(path) < 2:
            return np.zeros(len(points), bool)
        pixels = self._rig.project_raw(points)[self._right]
        start, along = path[:-1, :2], np.diff(path[:, :2], axis=0)
        offset = pixels[:, None] - start
        t = np.clip((offset * along).sum(-1) / (along**2).sum(-1).clip(1e-12), 0, 1)
        distance = np.linalg.norm(offset - t[..., None] * along, axis=-1)
        radius, depth = (path[:-1, k] + t * np.diff(path[:, k]) for k in (3, 2))
        return np.asarray(((distance < radius) & (depth < points[:, None, 2])).any(1))

    def _draw(self, number: int, strand: Strand) -> None:
        path = self._path(strand.points, strand.radius)
        if len(path) < 2:
            return
        points = self._view.to_camera(strand.points)[: len(path)]
        surface = strand.surface
        self._splat(
            number,
            path,
            shading(points, self._view.rotation @ self._look.lamp),
            surface,
            opacity=1.0,
        )

    def _draw_shadow(self, number: int, strand: Strand) -> None:
        step = 1 if strand.is_tool else 4
        points, lamp = strand.points[::step], self._look.lamp
        radius = np.broadcast_to(strand.radius, len(strand.points))[::step]
        height = np.maximum(points[:, 2], 0)
        path = self._path(points - lamp * (points[:, 2:] / lamp[2]), radius)
        if len(path) < 2:
            return
        penumbra = _PENUMBRA * height[: len(path)] * self._focal / path[:, 2]
        path[:, 4] = np.minimum(
            np.hypot(path[:, 4], penumbra), _LARGEST_PENUMBRA * self._rig.image_size[0]
        )
        path[:, 2] = path[:, 2] - _SHADED_HEIGHT if strand.is_tool else 1e9
        dark = Surface((0.0, 0.0, 0.0), 1.0, 0.0, 1.0)
        self._splat(number, path, np.zeros((len(path), 4)), dark, opacity=self._look.shadow)

    def _splat(
        self, number: int, path: Float64, light: Float64, surface: Surface, opacity: float
    ) -> None:
        length = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()
        reach = 2 * (path[:, 3] + 2.6 * path[:, 4]).max() + 4
        window = int(reach * len(path) / max(length, 1.0)) + 2
        first = int(self._fragments.used[0])
        tubes.splat(number, path, window, self._fragments)
        gloss = np.array([surface.ambient, surface.highlight, surface.sharpness, opacity])
        tubes.shade(first, path, light, np.array(surface.colour), gloss, self._fragments)

    def _path(self, table_points: Float64, radius: Float64) -> Float64:
        """(n, 5) for `tubes.splat`: up to where the strand comes too near to the camera, or too far aside."""
        points = self._view.to_camera(table_points)
        is_aside = folds_back(self._rig, points)[self._right]
        gone = np.flatnonzero((points[:, 2] < 0.3 * self._focus) | is_aside)
        points = points[: gone[0]] if len(gone) else points
        depth = points[:, 2]
        radius_px = np.broadcast_to(radius, len(table_points))[: len(depth)] * self._focal / depth
        defocus = 10 * self._look.defocus_px * np.abs(1 - self._focus / depth)
        blur = np.sqrt(self._look.blur_px**2 + _PIXEL_BLUR**2 + defocus**2)
        pixels = self._rig.project_raw(points)[self._right]
        return np.ascontiguousarray(np.column_stack([pixels, depth, radius_px, blur]))

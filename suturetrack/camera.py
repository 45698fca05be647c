"""The calibrated stereo camera: rectify images, project points, triangulate pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np

from suturetrack.types import Float32, Float64, Image, InputError, Seed, UInt16

Pixels = TypeVar("Pixels", Image, Float32)

LARGEST_SIDE = 8192
"""Of an image, px."""
_LINE = 256
"""Places that are looked up in one line of an image."""
_LEAST_DISPARITY_PX = 2.0
"""Below it, a pixel more or less is half the depth."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of the rig."""

    matrix: Float64
    """(3, 3) K of the raw image, px."""
    distortion: Float64
    """OpenCV's distortion coefficients of the raw image; zeros for none."""
    rectification: Float64
    """(3, 3) rotation from the camera's own axes to the rectified axes."""
    projection: Float64
    """(3, 4) from the rectified left frame to rectified pixels."""
    fisheye: bool = False
    """Whether `distortion` holds the four coefficients of the equidistant model (`cv2.fisheye`)."""

    def with_pixels(self, change: Float64) -> Camera:
        """The camera whose raw and rectified pixels (u, v, 1) are (3, 3) `change` times those here."""
        return replace(self, matrix=change @ self.matrix, projection=change @ self.projection)


@dataclass(frozen=True, eq=False)
class StereoRig:
    """A stereo pair whose home frame is the rectified left camera; lengths in the calibration's unit."""

    image_size: tuple[int, int]
    """(width, height), px."""
    left: Camera
    right: Camera
    metres_per_unit: float
    """Length of the calibration's unit: 1.0 where it is in metres, 0.001 in millimetres."""

    @classmethod
    def from_calibration(
        cls,
        image_size: tuple[int, int],
        left: tuple[Float64, Float64],
        right: tuple[Float64, Float64],
        rotation: Float64,
        translation: Float64,
        metres_per_unit: float,
        *,
        fisheye: bool = False,
    ) -> StereoRig:
        """The rig for `(K, D)` of both cameras and the pose `right_from_left` (OpenCV's R and T).

        Images that are rectified already (no distortion, no rotation, T along x, one focal length)
        are left alone; others get `cv2.stereoRectify` with `CALIB_ZERO_DISPARITY`, or its
        namesake in `cv2.fisheye` where the distortion is equidistant.

        Raises:
            InputError: the right camera stands left of, above or below the left one, or looks
                elsewhere.
        """
        _check_same_way(rotation)
        if not fisheye and _is_rectified(left, right, rotation, translation):
            rotations = np.eye(3), np.eye(3)
            baseline = -float(translation[0])
            shift = np.array([[0, 0, 0, -left[0][0, 0] * baseline], [0, 0, 0, 0], [0, 0, 0, 0]])
            projections = np.c_[left[0], np.zeros(3)], np.c_[right[0], np.zeros(3)] + shift
        else:
            stereo_rectify = cv2.fisheye.stereoRectify if fisheye else cv2.stereoRectify
            r1, r2, p1, p2, *_ = stereo_rectify(
                *left,
                *right,
                image_size,
                np.ascontiguousarray(rotation),
                np.ascontiguousarray(translation).reshape(3, 1),
                flags=cv2.CALIB_ZERO_DISPARITY,
            )
            rotations, projections = (r1, r2), (p1, p2)
        _check_side_by_side(projections[1], translation)
        cameras = [
            Camera(np.asarray(k, float), np.asarray(d, float), r, p, fisheye)
            for (k, d), r, p in zip((left, right), rotations, projections, strict=True)
        ]
        return cls(image_size, cameras[0], cameras[1], metres_per_unit)

    def for_rectified_images(self) -> StereoRig:
        """The same rig for images that somebody has rectified already, with these projections."""
        left, right = (
            Camera(c.projection[:, :3], np.zeros(5), np.eye(3), c.projection)
            for c in (self.left, self.right)
        )
        return replace(self, left=left, right=right)

    def resized(self, factor: float) -> StereoRig:
        """The same rig for images that are `factor` times as wide and high; frames stay as they are."""
        shift = (factor - 1) / 2  # the centre of the corner pixel moves in the corner pixel
        change = np.array([[factor, 0, shift], [0, factor, shift], [0, 0, 1]])
        width, height = (round(side * factor) for side in self.image_size)
        left, right = self.left.with_pixels(change), self.right.with_pixels(change)
        return replace(self, image_size=(width, height), left=left, right=right)

    @property
    def unit(self) -> str:
        """Name of the calibration's unit: m or mm."""
        return "m" if self.metres_per_unit == 1 else "mm"

    @property
    def mm_per_unit(self) -> float:
        """Length of the calibration's unit, mm."""
        return 1000 * self.metres_per_unit

    @property
    def right_from_left(self) -> tuple[Float64, Float64]:
        """R and T between the cameras' own axes, as OpenCV has them; T in the calibration's unit."""
        rotation = self.right.rectification.T @ self.left.rectification
        return rotation, self.right.rectification.T @ np.array([-self.baseline, 0.0, 0.0])

    @property
    def focal(self) -> float:
        """Focal length along u of the rectified views, px."""
        return float(self.left.projection[0, 0])

    @property
    def baseline(self) -> float:
        """Distance of the cameras, calibration's unit."""
        return float(-self.right.projection[0, 3] / self.right.projection[0, 0])

    @property
    def disparity_at_infinity(self) -> float:
        """u_left - u_right of points at infinity, px."""
        return float(self.left.projection[0, 2] - self.right.projection[0, 2])

    @property
    def depths(self) -> tuple[float, float]:
        """The least depth that both rectified views show, and the greatest that they tell; calibration's
        unit."""
        widest = self.image_size[0] - 1 - self.disparity_at_infinity
        return self.focal * self.baseline / widest, self.focal * self.baseline / _LEAST_DISPARITY_PX

    def reduced(self, scale: int) -> StereoRig:
        """The rig for rectified images of which only every `scale`-th pixel is kept, from the first."""
        shrink = np.diag([1 / scale, 1 / scale, 1.0])
        left, right = self.left.with_pixels(shrink), self.right.with_pixels(shrink)
        width, height = self.image_size
        size = -(-width // scale), -(-height // scale)
        return replace(self, image_size=size, left=left, right=right)

    def with_row_offset(self, rows: float) -> StereoRig:
        """The rig whose right view shows everything `rows` px lower, against the left one, than here.

        Nobody can tell which view is off: each is taken to be off by half of it.
        """
        if not rows:
            return self
        left = self.left.with_pixels(np.array([[1.0, 0, 0], [0, 1, -rows / 2], [0, 0, 1]]))
        right = self.right.with_pixels(np.array([[1.0, 0, 0], [0, 1, rows / 2], [0, 0, 1]]))
        return replace(self, left=left, right=right)

    @cached_property
    def is_rectified(self) -> bool:
        """Whether raw pixels are rectified pixels."""
        return all(
            np.array_equal(c.rectification, np.eye(3))
            and np.array_equal(c.matrix, c.projection[:, :3])
            and not c.distortion.any()
            for c in (self.left, self.right)
        )

    def rectify(
        self, left: Pixels, right: Pixels, out: tuple[Pixels | None, Pixels | None] = (None, None)
    ) -> tuple[Pixels, Pixels]:
        """Both raw images in rectified pixels; the images themselves where nothing is to do.

        Args:
            left: (H, W) or (H, W, 3), uint8 or float32.
            right: as `left`.
            out: buffers like the images, written to where there is something to do.
        """
        if self.is_rectified:
            return left, right
        rectified = [
            cv2.remap(image, *maps, cv2.INTER_LINEAR, buffer, cv2.BORDER_REPLICATE)
            for image, maps, buffer in zip((left, right), self._maps, out, strict=True)
        ]
        return rectified[0], rectified[1]

    def rectified_at(self, image: Image, pixels: UInt16, *, right: bool = False) -> Image:
        """(k, ...) what a raw image, (H, W, ...), shows at (k, 2) whole rectified pixels of its view."""
        u, v = pixels.T
        if self.is_rectified or not len(pixels):
            flat = image.reshape(-1, *image.shape[2:])
            return flat.take(v * np.intp(image.shape[1]) + u, axis=0)
        places, fractions = (table[v, u] for table in self._maps[right])
        # OpenCV takes no line of more than 32,767 places.
        rows = -(-len(pixels) // _LINE)
        table = np.resize(places, (rows, _LINE, 2)), np.resize(fractions, (rows, _LINE))
        found = cv2.remap(image, *table, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        return found.reshape(-1, *image.shape[2:])[: len(pixels)]

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """(..., 3) points in the rectified left frame -> (..., 2) rectified pixels, left and right."""
        return _project(self.left.projection, points), _project(self.right.projection, points)

    def project_raw(self, points: Float64) -> tuple[Float64, Float64]:
        """(..., 3) points in the rectified left frame -> (..., 2) pixels of the raw images."""
        left, right = self.project(points)
        return self.raw_pixels(left), self.raw_pixels(right, right=True)

    def rectify_pixels(self, pixels: Float64, *, right: bool = False) -> Float64:
        """(..., 2) pixels of a raw image -> (..., 2) rectified pixels of the same view."""
        pixels = np.asarray(pixels, float)
        if self.is_rectified or not pixels.size:  # OpenCV has no answer for no points.
            return pixels
        camera = self.right if right else self.left
        flat = np.ascontiguousarray(pixels).reshape(-1, 1, 2)
        undistort = cv2.fisheye.undistortPoints if camera.fisheye else cv2.undistortPoints
        rectified = undistort(
            flat, camera.matrix, camera.distortion, R=camera.rectification, P=camera.projection
        )
        return rectified.reshape(pixels.shape)

    def raw_pixels(self, pixels: Float64, *, right: bool = False) -> Float64:
        """(..., 2) rectified pixels of a view -> (..., 2) pixels of its raw image."""
        if self.is_rectified:
            return np.asarray(pixels, float)
        return _distort(self.right if right else self.left, np.asarray(pixels, float))

    def locate(self, seed: Seed) -> Float64:
        """(2,) rectified left pixel of a seed.

        Raises:
            InputError: it is outside the image, or behind the camera.
        """
        if seed.point is not None:
            point = np.asarray(seed.point, float)
            if not point[2] > 0:
                raise InputError(f"seed {seed.point}: it is behind the camera; z must be positive")
            pixel = self.project(point)[0]
        else:
            pixel = self.rectify_pixels(np.asarray(seed.pixel, float))
        width, height = self.image_size
        if not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
            u, v = seed.pixel or pixel
            once = "" if self.is_rectified else ", once that is rectified"
            raise InputError(
                f"seed ({u:.0f}, {v:.0f}) is outside the {width}x{height} left image{once}"
            )
        return pixel

    def triangulate(self, left: Float64, right: Float64) -> Float64:
        """(..., 2) rectified pixels of both views -> (..., 3) points in the rectified left frame.

        Rows need not agree: v is the mean of both. A disparity that is not positive gives a point
        at infinity (inf).
        """
        p, q = self.left.projection, self.right.projection
        left, right = np.asarray(left, float), np.asarray(right, float)
        disparity = (left[..., 0] - p[0, 2]) - (right[..., 0] - q[0, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(disparity > 0, p[0, 0] * self.baseline / disparity, np.inf)
            x = (left[..., 0] - p[0, 2]) * z / p[0, 0]
            y = ((left[..., 1] - p[1, 2]) + (right[..., 1] - q[1, 2])) / 2 * z / p[1, 1]
        return np.stack([x, y, z], axis=-1)

    def projection_jacobian(self, points: Float64) -> tuple[Float64, Float64]:
        """(..., 3) points -> (..., 2, 3) derivatives of the rectified pixels, left and right."""
        return _jacobian(self.left.projection, points), _jacobian(self.right.projection, points)

    @cached_property
    def _maps(self) -> list[tuple[Image, Image]]:
        return [
            (cv2.fisheye if c.fisheye else cv2).initUndistortRectifyMap(
                c.matrix, c.distortion, c.rectification, c.projection, self.image_size, cv2.CV_16SC2
            )
            for c in (self.left, self.right)
        ]


def _is_rectified(
    left: tuple[Float64, Float64],
    right: tuple[Float64, Float64],
    rotation: Float64,
    translation: Float64,
) -> bool:
    (k1, d1), (k2, d2) = left, right
    return bool(
        not np.any(d1)
        and not np.any(d2)
        and np.allclose(rotation, np.eye(3), atol=1e-9)
        and np.allclose(translation[1:], 0, atol=1e-9 * abs(float(translation[0])))
        and np.allclose(k1[[0, 1, 1], [0, 1, 2]], k2[[0, 1, 1], [0, 1, 2]], rtol=1e-6)
    )


def _check_same_way(rotation: Float64) -> None:
    """Raises InputError where the cameras are turned by more than 90 degrees against each other."""
    cosine = (np.trace(rotation) - 1) / 2
    if cosine < 0:
        degrees = np.degrees(np.arccos(max(cosine, -1.0)))
        raise InputError(
            f"R turns the right camera away from the left one, by {degrees:.0f} degrees; cameras of a "
            "pair look the same way, both upright"
        )


def _check_side_by_side(projection: Float64, translation: Float64) -> None:
    """Raises InputError unless the right view's (3, 4) projection has its camera right of the left one."""
    if abs(projection[1, 3]) > abs(projection[0, 3]):
        raise InputError(
            f"T {np.ravel(translation).tolist()} must run along x, as cameras stand side by side "
            "(x right, y down, z forward)"
        )
    if projection[0, 3] >= 0:
        raise InputError(
            "the right camera stands left of the left one (T[0] > 0); "
            "swap left and right, or give T as right_from_left"
        )


def _project(projection: Float64, points: Float64) -> Float64:
    homogeneous = np.asarray(points, float) @ projection[:, :3].T + projection[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[..., :2] / homogeneous[..., 2:]


def _jacobian(projection: Float64, points: Float64) -> Float64:
    homogeneous = np.asarray(points, float) @ projection[:, :3].T + projection[:, 3]
    w = homogeneous[..., 2, None, None]
    pixels = homogeneous[..., :2, None] / w
    return (projection[:2, :3] - pixels * projection[2, :3]) / w


def _distort(camera: Camera, pixels: Float64) -> Float64:
    if not pixels.size:
        return pixels
    p = camera.projection
    rays = np.concatenate(
        [(pixels - p[:2, 2]) / p[[0, 1], [0, 1]], np.ones_like(pixels[..., :1])], -1
    )
    flat = (rays @ camera.rectification).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    raw, _ = project(flat, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return raw.reshape(pixels.shape)

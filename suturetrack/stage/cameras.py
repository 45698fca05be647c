"""The rigs of the bench top, and where they stand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from suturetrack.camera import StereoRig
from suturetrack.types import Bool, Float64, InputError


@dataclass(frozen=True)
class RigModel:
    """A stereo camera of the bench top; lengths in mm."""

    focal_px: float
    """Focal length of images that are 640 px wide; it grows with the width."""
    baseline: float
    distances: tuple[float, float]
    """Nearest and farthest distance of the camera from the thread."""


RIGS = {
    "bench": RigModel(focal_px=800.0, baseline=40.0, distances=(195.0, 200.0)),
    "endoscope": RigModel(focal_px=880.0, baseline=5.5, distances=(60.0, 120.0)),
}
_LARGEST_TILT = np.radians(18.0)
# Rolls that are tried, from the wished one to both sides, until the scene fits into the images.
_ROLLS = np.radians(np.r_[0.0, np.repeat(np.arange(10.0, 181.0, 10.0), 2)])


def make_rig(name: str, size: tuple[int, int], distortion: float = 0.0) -> StereoRig:
    """The rig with that name, for images of `size` (width, height), in mm.

    `distortion` is the coefficient k1 of both lenses; without it the images are rectified already.

    Raises:
        InputError: there is no such rig.
    """
    if name not in RIGS:
        raise InputError(f"no rig {name!r}; use one of {', '.join(RIGS)}")
    model, (width, height) = RIGS[name], size
    focal = model.focal_px * width / 640
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    lens, shift = np.array([distortion, 0, 0, 0, 0]), np.array([-model.baseline, 0.0, 0.0])
    return StereoRig.from_calibration(size, (matrix, lens), (matrix, lens), np.eye(3), shift, 1e-3)


def misalign(
    rig: StereoRig, rng: np.random.Generator, error_px: float, half_pixel: bool
) -> StereoRig:
    """What the cameras really are when their calibration says `rig`: off by about `error_px`, and
    with pixels counted from their corners where `half_pixel` is set.
    """
    cameras = []
    for camera in (rig.left, rig.right):
        focal = camera.projection[0, 0]
        turn = Rotation.from_rotvec(rng.normal(0, error_px / focal / np.sqrt(2), 3))
        matrix = camera.matrix * (1 + rng.normal(0, error_px / focal) * np.diag([1, 1, 0]))
        matrix[:2, 2] += 0.5 * half_pixel
        rectification = camera.rectification @ turn.as_matrix().T
        cameras.append(replace(camera, matrix=matrix, rectification=rectification))
    return replace(rig, left=cameras[0], right=cameras[1])


def folds_back(rig: StereoRig, points: Float64) -> tuple[Bool, Bool]:
    """(N,) whether (N, 3) points of the rectified left frame lie so far aside that the formula of a barrel
    lens brings them back into the picture, left and right: r (1 + k1 r^2) falls from r = (-3 k1)^-1/2 on."""
    folded = []
    for camera, pixels in zip((rig.left, rig.right), rig.project(points), strict=True):
        axis, focal = camera.projection[:2, 2], camera.projection[0, 0]
        square = (((pixels - axis) / focal) ** 2).sum(-1)
        folded.append(1 + 3 * camera.distortion[0] * square < 0)
    return folded[0], folded[1]


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The pose of the table (x and y in its plane, z up, mm) in the rectified left frame."""

    rotation: Float64
    """(3, 3) left_from_table."""
    translation: Float64
    """(3,) the table's origin in the left frame."""

    def to_camera(self, points: Float64) -> Float64:
        """(..., 3) points of the table -> rectified left frame."""
        return points @ self.rotation.T + self.translation

    def to_table(self, points: Float64) -> Float64:
        """(..., 3) points of the rectified left frame -> table."""
        return (points - self.translation) @ self.rotation


def choose_viewpoint(
    rng: np.random.Generator,
    rig: StereoRig,
    distances: tuple[float, float],
    points: Float64,
    margin: float,
) -> Viewpoint:
    """A random view of (N, 3) points of the table that keeps them `margin` inside both images.

    `margin` is a share of the image's height. Where no view holds them all, the one that holds most
    is taken.
    """
    tilt, axis = _LARGEST_TILT * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    roll, near = rng.uniform(0, 2 * np.pi), rng.uniform()
    centre = (points.max(0) + points.min(0)) / 2
    signs = np.where(np.arange(len(_ROLLS)) % 2, 1, -1)
    best: tuple[float, Viewpoint] | None = None
    for share in (1.0, 0.5, 0.0):
        for distance in np.linspace(distances[0] + near * np.ptp(distances), distances[1], 3):
            for step in signs * _ROLLS:
                view = _look_at(centre, rig, float(distance), (axis, share * tilt, roll + step))
                held = float(_inside(rig, view.to_camera(points), margin).mean())
                if best is None or held > best[0]:
                    best = held, view
                if held == 1.0:
                    return view
    assert best is not None
    return best[1]


def push_out(
    view: Viewpoint, rig: StereoRig, rest: Float64, leaver: Float64, margin: float
) -> Viewpoint:
    """The view moved sideways until `leaver` is `margin` outside the images, `rest` staying inside.

    `leaver` is a (2, 3) step of a point on the table, `rest` (N, 3); `margin` as above.
    """
    step = (view.rotation @ (leaver[1] - leaver[0]))[:2]
    step, last = np.r_[step / np.linalg.norm(step), 0.0], view
    for shift in np.arange(0.0, 200.0, 0.5):
        moved = Viewpoint(view.rotation, view.translation + shift * step)
        if not _inside(rig, moved.to_camera(rest), margin).all():
            break
        last = moved
        if not _inside(rig, moved.to_camera(leaver[1:]), -margin).all():
            break
    return last


def _look_at(
    centre: Float64, rig: StereoRig, distance: float, angles: tuple[float, float, float]
) -> Viewpoint:
    axis, tilt, roll = angles
    down = np.diag([1.0, -1.0, -1.0])
    turn = Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    rotation = turn.as_matrix() @ Rotation.from_euler("z", roll).as_matrix() @ down
    return Viewpoint(rotation, np.array([rig.baseline / 2, 0.0, distance]) - rotation @ centre)


def _inside(rig: StereoRig, points: Float64, margin: float) -> Bool:
    """(N,) whether (N, 3) points are that share of the height inside both images."""
    size = np.array(rig.image_size)
    border = margin * size[1]
    inside = [(view > border) & (view < size - 1 - border) for view in rig.project(points)]
    return np.asarray((inside[0] & inside[1]).all(axis=1))

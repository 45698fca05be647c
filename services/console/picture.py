"""What the page shows of one moment, as numbers and JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import cv2
import msgspec
import numpy as np

from services.client import Seen
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.grasping import GraspPoint, grasp
from suturetrack.types import Float64, Image, InputError, StereoFrame, ThreadState

_JPEG_QUALITY = 75
_SAMPLES = 160
_AXIS_PX = 46.0


def pack(header: dict[str, Any], images: tuple[bytes, ...] = ()) -> bytes:
    """One binary message: length of the header (4 bytes, little endian), the header as JSON with the
    sizes of the images, and the images."""
    text = msgspec.json.encode({**header, "images": [len(image) for image in images]})
    return b"".join((len(text).to_bytes(4, "little"), text, *images))


def jpegs(frame: StereoFrame) -> tuple[bytes, bytes]:
    """Both raw images."""
    return _jpeg(frame.left), _jpeg(frame.right)


@dataclass(frozen=True, eq=False)
class Judged:
    """A state, and why it was stale at the moment that is shown; empty when it was live."""

    state: ThreadState
    stale: str

    @classmethod
    def of(cls, seen: Seen) -> Self:
        """What was seen, judged now."""
        return cls(seen.state, seen.reason)


def thread(judged: Judged, rig: StereoRig) -> dict[str, Any]:
    """One thread: figures, and the curve in pixels of both raw images."""
    state = judged.state
    known = state.curve is not None
    sigma = state.sigma[np.isfinite(state.sigma)]
    return {
        "id": state.thread,
        "status": str(state.status),
        "stale": judged.stale,
        "frame": state.stamp.frame,
        "length_mm": 1000 * state.length if known else None,
        "sigma_mm": 1000 * float(np.median(sigma)) if len(sigma) else None,
        "seen": float(state.seen.mean()) if len(state.seen) else 0.0,
        "control_points": len(state.curve.control_points) if state.curve is not None else 0,
        "image_left": _number(state.energies.image_left),
        "image_right": _number(state.energies.image_right),
        "end": _number(state.energies.end),
        "internal": _number(state.energies.internal),
        "events": list(state.events),
        **_curve(state, rig),
    }


def marker(judged: Judged | None, where: GraspPoint, rig: StereoRig) -> dict[str, Any]:
    """The grasp of a thread in both images: position, end of the x axis, end of the z axis."""
    if judged is None:
        return {"reason": "there is no thread"}
    if judged.stale:
        return {"reason": judged.stale}
    try:
        pose = grasp(judged.state, where)
    except InputError as error:
        return {"reason": str(error)}
    arm = _AXIS_PX * pose.position[2] / rig.focal
    points = pose.position + np.array([np.zeros(3), pose.rotation[:, 0], pose.rotation[:, 2]]) * arm
    left, right = (rounded(pixels) for pixels in rig.project_raw(points / rig.metres_per_unit))
    return {
        "reason": "",
        "position_mm": [round(1000 * x, 2) for x in pose.position.tolist()],
        "sigma_mm": round(1000 * pose.sigma, 3),
        "left": left,
        "right": right,
    }


def rounded(pixels: Float64) -> list[list[float]]:
    """(k, 2) pixels as they are drawn; what is nowhere goes far outside."""
    return np.round(np.nan_to_num(pixels, nan=-1e4, posinf=1e4, neginf=-1e4), 1).tolist()


def _curve(state: ThreadState, rig: StereoRig) -> dict[str, Any]:
    if state.curve is None:
        return {"left": [], "right": [], "visible": []}
    s = np.linspace(0, 1, _SAMPLES)
    points = nurbs.evaluate(scaled(state.curve, 1 / rig.metres_per_unit), s)
    left, right = (rounded(pixels) for pixels in rig.project_raw(points))
    visible = state.seen[np.rint(s * (len(state.seen) - 1)).astype(int)]
    return {"left": left, "right": right, "visible": visible.astype(int).tolist()}


def _jpeg(image: Image) -> bytes:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None

"""The process that lets the tip of a tool seed: poses in, the thread at the tip out, a seed when told."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import yaml

from services import topics
from services.arguments import metres
from services.bus import Bus, NoAnswer
from services.freshness import Freshness
from services.messages import ToolPose, ToolSnap
from services.service import Service, ServiceConfig
from suturetrack.calibration.pair import numbers
from suturetrack.camera import StereoRig
from suturetrack.snapping import snap_point
from suturetrack.types import Float64, InputError, RidgeField, Seed

_PREVIEW_S = 0.1
_SEED_S = 10.0

log = logging.getLogger("suturetrack")


@dataclass(frozen=True)
class TooltipConfig:
    """Seeds the thread at the tip of a tool when its trigger is pulled."""

    hand_eye: Path
    """YAML file with `camera_from_base`: four rows of four numbers that take points from the robot's
    base frame to the left camera's own axes (not rectified; x right, y down, z forward), in metres; and
    `tip`: x y z of the tip in the tool's frame, in metres, 0 0 0 without it."""
    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)
    tool: str = "tool"
    """Name of the tool."""
    thread: str = "0"
    """Name of the thread that it seeds."""
    radius: str = "8mm"
    """How far from the tip the thread may be."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Where the robot stands before the camera, and the tip of its tool."""

    camera_from_base: Float64
    """(4, 4) rigid; to the left camera's own axes, m."""
    tip: Float64
    """(3,) in the tool's frame, m."""

    def tip_in_left(self, pose: ToolPose, rig: StereoRig) -> Float64:
        """(3,) the tip in the rectified left frame, m."""
        in_base = pose.position + pose.rotation @ self.tip
        in_camera = self.camera_from_base[:3, :3] @ in_base + self.camera_from_base[:3, 3]
        return rig.left.rectification @ in_camera


def run(service: Service, config: TooltipConfig) -> None:
    """Follows the tool until stopped; raises InputError for a bad hand-eye file or radius."""
    hand_eye = load_hand_eye(config.hand_eye)
    radius = metres(config.radius)
    if not radius > 0:
        raise InputError(f"radius {config.radius}: use more than 0mm")
    tip = _Tip(service.bus, service.calibrated_rig(), hand_eye, config, radius)
    service.ready()
    while not service.bus.stop.is_set:
        tip.step()


def load_hand_eye(path: Path) -> HandEye:
    """Reads the hand-eye file; raises InputError."""
    where = f"hand-eye {path}"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{where}: {error.strerror}") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        mark = getattr(error, "problem_mark", None)
        raise InputError(
            f"{where}: no YAML{f' in line {mark.line + 1}' if mark else ''}"
        ) from error
    if not isinstance(content, dict) or "camera_from_base" not in content:
        raise InputError(f"{where}: camera_from_base is missing, four rows of four numbers")
    unknown = [str(name) for name in content if name not in ("camera_from_base", "tip")]
    if unknown:
        raise InputError(f"{where}: {', '.join(unknown)} is unknown; use camera_from_base and tip")
    matrix = numbers(content["camera_from_base"], (4, 4), "camera_from_base", where)
    tip = numbers(content.get("tip", (0, 0, 0)), (3,), "tip", where)
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{where}: the last row of camera_from_base must be 0 0 0 1")
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: camera_from_base holds no rotation")
    if np.abs([*tip, *matrix[:3, 3]]).max() > 10:
        raise InputError(f"{where}: a length above 10 m; are these millimetres?")
    return HandEye(matrix, tip)


class _Tip:
    """The newest pose and field, and what a trigger would seed now."""

    def __init__(
        self, bus: Bus, rig: StereoRig, hand_eye: HandEye, config: TooltipConfig, radius: float
    ):
        self._bus, self._rig, self._hand_eye = bus, rig, hand_eye
        self._tool, self._thread, self._radius = config.tool, config.thread, radius
        self._poses = bus.every(topics.TOOL)
        self._fields = bus.newest(topics.FIELD, at_leisure=True)
        self._field: RidgeField | None = None
        self._field_ns = 0
        self._held = True
        self._shown = 0.0

    def step(self) -> None:
        """Takes the poses that came; shows the thread at the tip, and seeds on a trigger."""
        pose, pulled = self._poses.get(_PREVIEW_S), None
        newest = None
        while pose is not None:
            if pose.tool == self._tool:
                newest = pose
                pulled = pose if pose.trigger and not self._held else pulled
                self._held = pose.trigger
            pose = self._poses.get(0)
        if pulled is not None:
            self._seed(pulled)
        elif newest is not None and time.monotonic() - self._shown >= _PREVIEW_S:
            snap = self._snap(newest)
            if snap is not None:
                self._bus.publish(topics.SNAP, snap)

    def _seed(self, pose: ToolPose) -> None:
        snap = self._snap(pose)
        if snap is None:
            log.warning("a trigger was pulled, but no fields come")
            return
        if snap.point is not None:
            try:
                seed = Seed(self._thread, point=snap.point)
                reason = self._bus.ask(topics.SEED, seed, _SEED_S).reason
            except NoAnswer as error:
                reason = str(error)
            snap = ToolSnap(snap.stamp, snap.tool, snap.tip, snap.point, f"seeded: {reason}")
        log.info("trigger of %s: %s", snap.tool, snap.reason)
        self._bus.publish(topics.SNAP, snap)

    def _snap(self, pose: ToolPose) -> ToolSnap | None:
        """The thread at the tip; None before any field."""
        self._shown = time.monotonic()
        field = self._fields.get(0)
        if field is not None:
            self._field, self._field_ns = field, self._fields.arrived_ns
        if self._field is None:
            return None
        tip = self._hand_eye.tip_in_left(pose, self._rig)
        stale = Freshness.of(self._field.stamp, self._field_ns).reason
        if stale:
            return ToolSnap(self._field.stamp, pose.tool, tip, None, f"no live field: {stale}")
        unit = self._rig.metres_per_unit
        found = snap_point(self._field, self._rig, tip / unit, self._radius / unit)
        if found is None:
            reason = f"no thread within {1000 * self._radius:g} mm of the tip"
            return ToolSnap(self._field.stamp, pose.tool, tip, None, reason)
        x, y, z = (found * unit).tolist()
        away = 1000 * float(np.linalg.norm(found * unit - tip))
        return ToolSnap(self._field.stamp, pose.tool, tip, (x, y, z), f"{away:.1f} mm away")

"""The process that bridges a rig to ROS 2: curves, grasps and status out, seeds in.

Below `/suturetrack/<rig>/thread_<id>/`, lengths in metres, in the rectified left camera's frame, stamped
with the time of the exposure:

- `curve`, geometry_msgs/PoseArray: evenly spaced along the thread, z along the tangent, x as near as
  can be to the viewing direction; empty when the thread is lost.
- `marker`, visualization_msgs/Marker: a LINE_STRIP, gray where the thread is not seen; for RViz.
- `grasp`, geometry_msgs/PoseStamped: see `suturetrack.grasping`; sent while a gripper may act on it.
- `seed`, geometry_msgs/PointStamped, taken: find the thread here.

And on `/diagnostics`, diagnostic_msgs/DiagnosticArray: the status, STALE when no states come.

No ROS is needed here: see `services.ros2_graph` for what is spoken, and for what could not be tried.
"""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from services import topics
from services.bus import NoAnswer
from services.checks import check_name
from services.freshness import Freshness
from services.ros2_graph import RosConfig, RosNode, new
from services.service import Service, ServiceConfig
from suturetrack import nurbs
from suturetrack.grasping import AWAY_FROM_CAMERA, GraspPoint, grasp
from suturetrack.types import Bool, Float64, InputError, Nurbs, Seed, Stamp, Status, ThreadState

_SILENCE_S = 1.0
_ANSWER_S = 10.0
_LINE_STRIP, _ADD, _DELETE = 4, 0, 2
_LEVELS = {Status.TRACKING: 0, Status.OCCLUDED: 1, Status.LOST: 2}
_STALE = 3
_SEEN, _UNSEEN = (0.1, 0.9, 0.2, 1.0), (0.6, 0.6, 0.6, 1.0)


@dataclass(frozen=True)
class Ros2Config:
    """Shows the threads of a rig to ROS 2 (Jazzy or later, with rmw_zenoh), and takes seeds from it."""

    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)
    ros: RosConfig = field(default_factory=RosConfig)
    """Where the ROS 2 graph is."""
    threads: tuple[str, ...] = ("0",)
    """Names of the threads to show and to seed."""
    frame_id: str = "suturetrack"
    """Name of the rectified left camera's frame."""
    samples: int = 50
    """Poses on a curve."""
    grasp_at: float = 0.5
    """Where to take the thread: part of its length from its start, 0 to 1."""
    width_mm: float = 1.0
    """Width of the marker's line."""


def run(service: Service, config: Ros2Config) -> None:
    """Passes on every state until stopped; raises InputError when there is no ROS 2 graph."""
    _check(config)
    states = service.bus.every(topics.STATE)
    node = RosNode("suturetrack", config.ros)
    try:
        status = node.publisher("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        threads = {name: _Thread(name, node, config) for name in config.threads}
        seeds = _Seeds(service, node, config)
        service.ready()
        while not service.bus.stop.is_set:
            state = states.get(_SILENCE_S)
            if state is None:
                status.publish(_diagnostics(config, None, seeds.said))
            elif state.thread in threads:
                threads[state.thread].publish(state, states.arrived_ns)
                status.publish(_diagnostics(config, state, seeds.said))
                service.finished(state.stamp)
    finally:
        node.close()


class _Thread:
    """What is published of one thread."""

    def __init__(self, name: str, node: RosNode, config: Ros2Config):
        self._config = config
        root = _root(config, name)
        self._curve = node.publisher(f"{root}/curve", "geometry_msgs/msg/PoseArray")
        self._marker = node.publisher(f"{root}/marker", "visualization_msgs/msg/Marker")
        self._grasp = node.publisher(f"{root}/grasp", "geometry_msgs/msg/PoseStamped")

    def publish(self, state: ThreadState, arrived_ns: int) -> None:
        config = self._config
        header = _header(state.stamp, config.frame_id)
        held = state.curve if state.status is not Status.LOST else None
        points, frames = _poses(held, config.samples)
        poses = _ros_poses(points, frames)
        self._curve.publish(new("geometry_msgs/msg/PoseArray", header=header, poses=poses))
        self._marker.publish(_marker(state, points, header, config.width_mm))
        if not Freshness.of(state.stamp, arrived_ns).live:
            return
        try:
            pose = grasp(state, GraspPoint(fraction=config.grasp_at))
        except InputError:
            return
        (ros_pose,) = _ros_poses(pose.position[None], pose.rotation[None])
        self._grasp.publish(new("geometry_msgs/msg/PoseStamped", header=header, pose=ros_pose))


class _Seeds:
    """Hands the seeds of ROS to the tracker, one after another."""

    def __init__(self, service: Service, node: RosNode, config: Ros2Config):
        self._service, self._frame_id = service, config.frame_id
        self._waiting: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self.said = ""
        """What became of the last one."""
        for name in config.threads:
            topic = f"{_root(config, name)}/seed"
            node.subscribe(topic, "geometry_msgs/msg/PointStamped", self._taker(name), self._tell)
        threading.Thread(target=self._loop, name="seeds", daemon=True).start()

    def _taker(self, thread: str) -> Any:
        return lambda message: self._waiting.put((thread, message))

    def _loop(self) -> None:
        while True:
            thread, message = self._waiting.get()
            self._tell(f"seed of thread {thread}: {self._ask(thread, message)}")

    def _ask(self, thread: str, message: Any) -> str:
        frame_id, point = message.header.frame_id, message.point
        if frame_id not in ("", self._frame_id):
            return f"it is in frame {frame_id!r}; transform it to {self._frame_id!r}"
        place = (float(point.x), float(point.y), float(point.z))
        if not np.isfinite(place).all():
            return "its coordinates are not finite"
        try:
            reply = self._service.bus.ask(topics.SEED, Seed(thread, point=place), _ANSWER_S)
        except NoAnswer as error:
            return str(error)
        return reply.reason

    def _tell(self, text: str) -> None:
        self.said = text
        self._service.complain(text)


def _check(config: Ros2Config) -> None:
    for name in config.threads:
        try:
            check_name(name, "thread")
        except ValueError as error:
            raise InputError(str(error)) from error
    if not config.threads:
        raise InputError("threads: name one at least")
    if not 2 <= config.samples <= 10_000:
        raise InputError(f"samples {config.samples}: use 2 to 10000")
    if not 0 <= config.grasp_at <= 1:
        raise InputError(f"grasp-at {config.grasp_at:g}: use a part of the length, 0 to 1")
    if not 0 < config.width_mm < 1000:
        raise InputError(f"width-mm {config.width_mm:g}: use millimetres above 0")


def _root(config: Ros2Config, thread: str) -> str:
    return f"/suturetrack/{config.service.rig}/thread_{thread}".replace("-", "_")


def _header(stamp: Stamp, frame_id: str) -> Any:
    seconds, ns = divmod(stamp.capture_ns, 1_000_000_000)
    time = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=ns)
    return new("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def _poses(curve: Nurbs | None, count: int) -> tuple[Float64, Float64]:
    """(n, 3) points evenly along the curve and (n, 3, 3) frames in columns x y z; n = 0 without one."""
    if curve is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    s = np.linspace(0, 1, 8 * count)
    travelled = nurbs.arc_lengths(curve, s)
    even = np.interp(np.linspace(0, travelled[-1], count), travelled, s)
    z = nurbs.tangents(curve, even)
    x = np.array(AWAY_FROM_CAMERA) - z[:, 2:] * z
    along = np.linalg.norm(x, axis=1) < 1e-3
    x[along] = np.array([1.0, 0, 0]) - z[along, :1] * z[along]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return nurbs.evaluate(curve, even), np.stack([x, np.cross(z, x), z], axis=2)


def _ros_poses(points: Float64, frames: Float64) -> list[Any]:
    if not len(points):
        return []
    return [
        new(
            "geometry_msgs/msg/Pose",
            position=_point(point),
            orientation=new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))),
        )
        for point, q in zip(points, Rotation.from_matrix(frames).as_quat().tolist(), strict=True)
    ]


def _marker(state: ThreadState, points: Float64, header: Any, width_mm: float) -> Any:
    width = width_mm / 1000
    return new(
        "visualization_msgs/msg/Marker",
        header=header,
        ns=f"suturetrack/{state.thread}",
        type=_LINE_STRIP,
        action=_ADD if len(points) else _DELETE,
        pose=new("geometry_msgs/msg/Pose", orientation=new("geometry_msgs/msg/Quaternion", w=1.0)),
        scale=new("geometry_msgs/msg/Vector3", x=width),
        color=_color(_SEEN),
        # What is not renewed disappears from the view.
        lifetime=new("builtin_interfaces/msg/Duration", sec=1),
        points=[_point(point) for point in points],
        colors=[_color(_SEEN if seen else _UNSEEN) for seen in _seen(state, len(points))],
    )


def _seen(state: ThreadState, count: int) -> Bool:
    """(count,) whether the images show the thread there."""
    if not count or not len(state.seen):
        return np.ones(count, bool)
    return state.seen[np.linspace(0, len(state.seen) - 1, count).round().astype(int)]


def _point(point: Float64) -> Any:
    x, y, z = point.tolist()
    return new("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _color(rgba: tuple[float, float, float, float]) -> Any:
    return new("std_msgs/msg/ColorRGBA", **dict(zip("rgba", rgba, strict=True)))


def _diagnostics(config: Ros2Config, state: ThreadState | None, seed: str) -> Any:
    name = f"suturetrack {config.service.rig}"
    header, level, message = new("std_msgs/msg/Header"), _STALE, "no states come"
    values = {"seed": seed}
    if state is not None:
        header = _header(state.stamp, config.frame_id)
        name = f"{name}: thread {state.thread}"
        level, message = _LEVELS[state.status], str(state.status)
        seen = float(state.seen.mean()) if len(state.seen) else 0.0
        values |= {
            "frame": str(state.stamp.frame),
            "length_mm": f"{1000 * state.length:.2f}",
            "seen": f"{seen:.2f}",
            "events": "; ".join(state.events),
        }
    entry = new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=name,
        message=message,
        hardware_id=config.service.rig,
        values=[new("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in values.items()],
    )
    return new("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[entry])

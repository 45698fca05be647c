"""What processes tell one another beyond the library's types; lengths are in metres."""

from __future__ import annotations

from dataclasses import dataclass

from suturetrack.grasping import AWAY_FROM_CAMERA, GraspPoint
from suturetrack.types import Float64, Grasp, Nurbs, Stamp


@dataclass(frozen=True)
class Latency:
    """How long after the source released a frame its result left a process, in ms; 0 before any."""

    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


@dataclass(frozen=True)
class Health:
    """The heartbeat of a process, once a second and when it ends."""

    process: str
    time_ns: int
    """Wall clock of this heartbeat."""
    stamp: Stamp | None
    """Of the last frame that the process finished."""
    rate_hz: float
    """Frames finished per second since the last heartbeat."""
    latency: Latency
    """Of the frames since the last heartbeat."""
    run_rate_hz: float
    """Frames finished per second from the first one to the last one."""
    run_latency: Latency
    """Of every frame so far."""
    frames: int
    """Frames finished so far."""
    dropped: int
    """Frames so far that never reached this process or were passed over for a newer one."""
    refused: int
    """Bad messages so far, of every kind."""
    memory_mb: float
    """Resident memory."""
    warning: str = ""
    """What a person should know, for example that recording stopped; empty when all is well."""
    restarts: int = 0
    """How often the process died before and was started again."""
    ready: bool = True
    """False while it still begins, or waits for what it needs to begin."""
    awaits: str = ""
    """Without what it cannot go on: another process, or its camera; empty when it can."""


@dataclass(frozen=True)
class SeedReply:
    """What became of a seed."""

    thread: str
    accepted: bool
    reason: str
    """What was found, or why there is no thread to find, in words."""
    stamp: Stamp | None = None
    """The frame in which the thread was looked for; None when it was not looked for."""
    curve: Nurbs | None = None
    """The first curve, in metres; None when refused."""
    candidates: tuple[tuple[float, float], ...] = ()
    """When refused: the pixels (u, v) of the raw left image nearest to the seed that look like thread."""


@dataclass(frozen=True)
class Forget:
    """A thread that nobody wants to be followed any more."""

    thread: str


@dataclass(frozen=True)
class Forgotten:
    """A thread was dropped."""

    thread: str
    known: bool
    """Whether there was such a thread."""


@dataclass(frozen=True)
class GraspRequest:
    """Where a gripper would like to take a thread, and from which side."""

    thread: str
    where: GraspPoint
    """In metres."""
    approach: tuple[float, float, float] = AWAY_FROM_CAMERA
    """Direction in which the gripper moves in, rectified left frame; any length."""


@dataclass(frozen=True, eq=False)
class ToolPose:
    """Where a tool is, as its robot knows it; whoever moves the tool publishes it."""

    tool: str
    """Name of the tool."""
    time_ns: int
    """Wall clock of the pose."""
    position: Float64
    """(3,) of the tool's frame, in metres, in the robot's base frame."""
    rotation: Float64
    """(3, 3) columns x, y, z of the tool's frame in the base frame."""
    trigger: bool = False
    """Whether the operator holds the trigger; a thread is seeded when it goes from False to True."""


@dataclass(frozen=True, eq=False)
class ToolSnap:
    """What a trigger at this moment would seed."""

    stamp: Stamp
    """Of the field in which the thread was looked for."""
    tool: str
    tip: Float64
    """(3,) of the tool, in metres, in the rectified left camera."""
    point: tuple[float, float, float] | None
    """The nearest point on a thread, in metres; None without one near enough."""
    reason: str
    """How far it is, why there is none, or what became of a seed, in words."""


@dataclass(frozen=True)
class GraspReply:
    """The pose at which to take a thread, or why it should not be taken."""

    thread: str
    grasp: Grasp | None
    """In metres; None when refused."""
    reason: str = ""
    """Why it was refused, in words."""

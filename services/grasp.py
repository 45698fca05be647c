"""`suturetrack grasp`: asks a running tracker where a gripper should take a thread."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from services.arguments import metres
from services.client import Client, Refused, Seen, connect
from suturetrack.grasping import AWAY_FROM_CAMERA
from suturetrack.types import Grasp, InputError


@dataclass(frozen=True)
class GraspConfig:
    """Asks a running tracker at which pose a gripper should take a thread."""

    from_end: str | None = None
    """Distance along the thread from its end, for example 10mm."""
    from_start: str | None = None
    """Distance along the thread from its start."""
    fraction: float | None = None
    """Part of the length from the start, from 0 to 1."""
    near: tuple[float, float, float] | None = None
    """The place nearest to X Y Z, in metres, in the rectified left camera."""
    approach: tuple[float, float, float] = AWAY_FROM_CAMERA
    """Direction in which the gripper moves in: its x axis comes as near to it as the thread lets it."""
    thread: str = "0"
    """Name of the thread."""
    watch: bool = False
    """Print the pose at every frame, until Ctrl-C."""
    rig: str = "rig"
    """Name of the rig."""
    zenoh: Path | None = None
    """The Zenoh configuration file of the running system, if it has one."""


def run(config: GraspConfig) -> None:
    """Prints one pose, or one a frame.

    Raises:
        InputError: no system runs, the place is wrong, or, unless watching, the grasp is refused.
    """
    places = config.from_end, config.from_start, config.fraction, config.near
    if sum(place is not None for place in places) != 1:
        raise InputError("give exactly one of --from-end, --from-start, --fraction and --near")
    from_start, from_end = (
        None if v is None else metres(v) for v in (config.from_start, config.from_end)
    )

    def ask(client: Client) -> Grasp:
        return client.grasp(
            config.thread,
            from_start=from_start,
            from_end=from_end,
            fraction=config.fraction,
            near=config.near,
            approach=config.approach,
        )

    with connect(config.rig, config.zenoh, waits=False) as client:
        if not config.watch:
            print(_line(ask(client)))
            return
        client.calibration()  # nobody there is said at once
        for seen in _newest(client, config.thread):
            try:
                line = _line(ask(client))
            except Refused as refusal:
                line = f"frame {seen.state.stamp.frame}  refused: {refusal}"
            _show(line)


def _newest(client: Client, thread: str) -> Iterator[Seen]:
    """The states of a thread, without those that came while the last one was shown."""
    for seen in client.states(thread):
        newest = client.latest(thread)
        if newest is None or newest.state.stamp <= seen.state.stamp:
            yield seen


def _line(pose: Grasp) -> str:
    x, y, z = 1000 * pose.position
    quaternion = " ".join(f"{q:+.4f}" for q in Rotation.from_matrix(pose.rotation).as_quat())
    age_ms = (time.time_ns() - pose.stamp.released_ns) / 1e6
    return (
        f"frame {pose.stamp.frame}  position {x:+.2f} {y:+.2f} {z:+.2f} mm  "
        f"quaternion xyzw {quaternion}  sigma {1000 * pose.sigma:.2f} mm  age {age_ms:.0f} ms"
    )


def _show(line: str) -> None:
    """One line that is kept up to date on a terminal, a line a frame elsewhere."""
    if sys.stdout.isatty():
        print(f"\r\x1b[K{line}", end="", flush=True)
    else:
        print(line, flush=True)

"""The tracked threads from a program of one's own, without a word of Zenoh.

    from services.client import connect

    with connect() as client:
        client.seed(pixel=(454, 118))
        for seen in client.states():
            if not seen.live:
                ...                                      # stop: `seen.reason` tells why
            elif seen.state.status is Status.TRACKING:
                pose = client.grasp(from_end=0.010)

Lengths are in metres, points in the rectified left camera.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np

from services import topics
from services.bus import DEPTH, Bus, NoAnswer
from services.checks import check, check_rig
from services.freshness import Freshness
from services.inbox import Inbox
from services.messages import Forget, GraspRequest, SeedReply, ToolPose
from services.topics import Question, Topic
from services.zenoh_transport import ZenohTransport, load_config, local_config
from suturetrack.camera import StereoRig
from suturetrack.grasping import AWAY_FROM_CAMERA, GraspPoint
from suturetrack.initialization import InitializationError
from suturetrack.snapping import laser_spot, pixel_in_area, point_of_right_pixel
from suturetrack.tracking.tracker import FORGOTTEN
from suturetrack.types import Float64, Grasp, InputError, Seed, ThreadState

Q = TypeVar("Q")
A = TypeVar("A")
T = TypeVar("T")
Pixel = tuple[float, float]
Point = tuple[float, float, float]
Area = tuple[float, float, float, float]

_ARRIVAL_S = 3.0
"""How long whoever answers may take to appear."""
_ANSWER_S = 2.0
_BEAT_S = 1.3
"""How long it is listened for processes that are not ready: each tells of itself once a second."""
_GONE_NS = 3_000_000_000
"""A thread of which nothing has come for so long, nor since the last but one state of another, is followed no
more: the tracker that held it has ended, and another one runs."""

log = logging.getLogger("suturetrack")


class Unavailable(InputError):
    """Nobody is there to answer, and the text says what to start; or the client is closed."""


class Refused(InputError):
    """A seed or a grasp was refused; the text says why."""

    def __init__(self, reason: str, candidates: tuple[Pixel, ...] = ()):
        super().__init__(reason)
        self.reason = reason
        self.candidates = candidates
        """Of a seed on no thread: pixels (u, v) of the same raw image near it that look like thread."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A state as it arrived; how old it is, is judged whenever it is asked."""

    state: ThreadState
    """Lengths in metres."""
    arrived_ns: int
    """By `time.monotonic_ns`."""

    @property
    def freshness(self) -> Freshness:
        """How old the state is now."""
        return Freshness.of(self.state.stamp, self.arrived_ns)

    @property
    def live(self) -> bool:
        """Whether the state is recent enough to act on; what it is worth, its status tells."""
        return self.freshness.live

    @property
    def reason(self) -> str:
        """Why the state is stale, in words; empty while it is live."""
        return self.freshness.reason


def connect(rig: str = "rig", zenoh: Path | str | None = None, *, waits: bool = True) -> Client:
    """A client of a running system; to be used in a `with` statement.

    Args:
        rig: name of the rig.
        zenoh: a Zenoh configuration file that leads to another machine; without it, the system runs
            on this one.
        waits: for a router that is not there yet, without end; else that is an error within seconds.

    Raises:
        InputError: a bad name, a configuration that cannot be used, or no router.
    """
    check_rig(rig)
    config = local_config(rig, "client") if zenoh is None else load_config(Path(zenoh))
    return Client(Bus(ZenohTransport(config, waits=waits), rig, "client"))


class Client:
    """What a consumer and operator of a rig can do."""

    def __init__(self, bus: Bus):
        self.bus = bus
        self._reader = bus.every(topics.STATE)
        self._lock = threading.Lock()
        self._latest: dict[str, Seen] = {}
        self._listeners: dict[Inbox[Seen], str | None] = {}
        self._given_up = 0
        threading.Thread(target=self._listen, name="states", daemon=True).start()

    @property
    def threads(self) -> tuple[str, ...]:
        """Names of the threads of which states arrive, or did when states last arrived of any."""
        with self._lock:
            return tuple(self._latest)

    @property
    def missed(self) -> int:
        """States that were published since the connection and never read: gaps in their numbers, and
        those that a loop over `states` was too slow for."""
        with self._lock:
            return self._reader.dropped + self._given_up + sum(i.given_up for i in self._listeners)

    def latest(self, thread: str = "0") -> Seen | None:
        """The newest state of a thread; None before the first one."""
        with self._lock:
            return self._latest.get(thread)

    def states(self, thread: str | None = None) -> Iterator[Seen]:
        """Every state from now on, as it arrives, of one thread or of all.

        When no live state is left, the last one comes once more, stale, so that a loop hears of the
        silence without a clock of its own. Ends when the client is closed.
        """
        inbox: Inbox[Seen] = Inbox(self.bus.stop, DEPTH)
        with self._lock:
            self._listeners[inbox] = thread
        try:
            last = None
            while not self.bus.stop.is_set:
                left_s = None if last is None else last.freshness.left_ns / 1e9
                seen = inbox.get(left_s)
                if seen is not None:
                    yield seen
                    last = seen if seen.live else None
                elif last is not None and not last.live:
                    yield last
                    last = None
        finally:
            with self._lock:
                del self._listeners[inbox]
                self._given_up += inbox.given_up

    def watch(self, callback: Callable[[Seen], None], thread: str | None = None) -> None:
        """Calls back from a thread of its own for all that `states` gives."""

        def follow() -> None:
            for seen in self.states(thread):
                try:
                    callback(seen)
                except Exception:
                    log.exception("a callback failed on frame %d", seen.state.stamp.frame)

        threading.Thread(target=follow, name="watch", daemon=True).start()

    def seed(
        self,
        pixel: Pixel | None = None,
        *,
        view: Literal["left", "right"] = "left",
        point: Point | None = None,
        area: Area | None = None,
        laser: bool = False,
        thread: str = "0",
        timeout: float = 10.0,
    ) -> SeedReply:
        """Has a thread looked for, and waits for what is found.

        Args:
            pixel: (u, v) in a raw image.
            view: in which image the pixel, the area or the laser's spot is.
            point: (x, y, z) instead of a pixel, m.
            area: (u, v, u, v) of two opposite corners: at the clearest ridge between them.
            laser: at the laser's spot in the newest image.
            thread: name; a thread that has it is held until it is found from here.
            timeout: seconds.

        Raises:
            Refused: there is no thread.
            Unavailable: nobody answers.
            InputError: not exactly one place, a bad name or timeout; nothing in the area; no laser's spot,
                or several.
        """
        if (_plain(timeout, (), "timeout") or 0.0) < 0:
            raise InputError(f"timeout {timeout!r}: use seconds, 0 or more")
        if sum((pixel is not None, point is not None, area is not None, laser)) != 1:
            raise InputError("give exactly one of a pixel, a point, an area and the laser")
        if view not in ("left", "right"):
            raise InputError(f"view {view!r}: use left or right")
        pixel, point = _plain(pixel, (2,), "pixel"), _plain(point, (3,), "point")
        area = _plain(area, (4,), "area")
        if area is not None:
            rig, field = self.calibration(), self._newest(topics.FIELD)
            pixel = pixel_in_area(field, rig, area, right=view == "right")
        elif laser:
            frame = self._newest(topics.FRAME)
            pixel = laser_spot(frame.right if view == "right" else frame.left)
        if view == "right" and pixel is not None:
            point = self._point_of_right(pixel)
            pixel = None
        reply = self._ask(topics.SEED, Seed(thread, pixel, point), timeout)
        if not reply.accepted:
            raise Refused(reply.reason, reply.candidates)
        return reply

    def forget(self, thread: str = "0") -> bool:
        """Has a thread followed no more; whether there was such a thread. Raises Unavailable."""
        return self._ask(topics.FORGET, Forget(thread), _ANSWER_S).known

    def grasp(
        self,
        thread: str = "0",
        *,
        from_start: float | None = None,
        from_end: float | None = None,
        fraction: float | None = None,
        near: Point | None = None,
        approach: Point = AWAY_FROM_CAMERA,
    ) -> Grasp:
        """The gripper's pose at one place of a thread, now; see `suturetrack.grasping.grasp`.

        Args:
            thread: name.
            from_start: arc length from the start of the curve, m.
            from_end: arc length from its end, m.
            fraction: of the length, from the start, in [0, 1].
            near: the place nearest to this point, m.
            approach: direction in which the gripper moves in; any length.

        Raises:
            Refused: there is no such thread, it is lost or unseen there, or the state is stale.
            Unavailable: nobody answers.
            InputError: not exactly one place, or no direction.
        """
        where = GraspPoint(
            _plain(from_start, (), "from_start"),
            _plain(from_end, (), "from_end"),
            _plain(fraction, (), "fraction"),
            _plain(near, (3,), "near"),
        )
        request = GraspRequest(
            thread, where, _plain(approach, (3,), "approach") or AWAY_FROM_CAMERA
        )
        reply = self._ask(topics.GRASP, request, _ANSWER_S)
        if reply.grasp is None:
            raise Refused(reply.reason)
        return reply.grasp

    def move_tool(
        self, position: Float64, rotation: Float64, *, trigger: bool, tool: str = "tool"
    ) -> None:
        """Tells where a tool is, for `suturetrack tooltip`; a trigger that is pulled seeds at its tip.

        Args:
            position: (3,) of the tool's frame in the robot's base frame, m.
            rotation: (3, 3) columns x, y, z of the tool's frame in the base frame.
            trigger: whether it is held.
            tool: name.

        Raises:
            InputError: a bad name, or no pose.
            Unavailable: the client is closed.
        """
        at, turned = (
            np.array(_plain(values, shape, what))
            for values, shape, what in (
                (position, (3,), "position"),
                (rotation, (3, 3), "rotation"),
            )
        )
        pose = ToolPose(tool, time.time_ns(), at, turned, bool(trigger))
        _check(pose)
        self._require_open()
        self.bus.publish(topics.TOOL, pose)

    def calibration(self) -> StereoRig:
        """The cameras, in the calibration's own unit; raises Unavailable."""
        return self._ask(topics.CALIBRATION, None, _ARRIVAL_S)

    def close(self) -> None:
        """Ends every loop and the connection."""
        self.bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _point_of_right(self, pixel: Pixel) -> Point:
        """The point in space, m, that a pixel of the raw right image means."""
        rig = self.calibration()
        field = self._newest(topics.FIELD)
        try:
            at = rig.rectify_pixels(np.asarray(pixel, float), right=True)
            point = point_of_right_pixel(field, rig, at)
        except InitializationError as error:
            near = rig.raw_pixels(error.candidates, right=True)
            raise Refused(error.reason, tuple((float(u), float(v)) for u, v in near)) from error
        x, y, z = (point * rig.metres_per_unit).tolist()
        return x, y, z

    def _newest(self, topic: Topic[T]) -> T:
        """The next message of a topic; raises Unavailable.

        Images and fields are read no longer than that: a controller's link has room for little else.
        """
        self._require_open()
        self.bus.alive()  # begins to look who is there
        with self.bus.newest(topic) as reader:
            message = reader.get(_ARRIVAL_S)
        if message is None:
            raise self._unavailable(f"no {topic.key}s come in which to look")
        return message

    def _ask(self, question: Question[Q, A], content: Q, timeout: float) -> A:
        _check(content)
        self._require_open()
        # The processes of a rig appear a moment after the connection was opened.
        if not self.bus.wait_for_alive(question.server, _ARRIVAL_S):
            raise self._unavailable(f"the {question.server} does not answer")
        try:
            return self.bus.ask(question, content, timeout)
        except NoAnswer as error:
            raise self._unavailable(f"the {question.server} does not answer: {error}") from error

    def _require_open(self) -> None:
        if self.bus.stop.is_set:
            raise Unavailable("this client is closed; connect again")

    def _unavailable(self, what: str) -> Unavailable:
        """The error, with the processes that are not ready, and how to start those that are missing."""
        self._require_open()
        heard = self._beginners()
        self._require_open()  # who closes it meanwhile ends all waiting
        alive, rig = self.bus.alive(), self.bus.rig
        absent = [name for name in topics.PROCESSES if name not in alive]
        said = [what, *(f"the {name} {heard[name]}" for name in absent if name in heard)]
        missing = [name for name in absent if name not in heard]
        if missing:
            by_hand = " and ".join(f"`suturetrack {name} --rig {rig}`" for name in missing)
            start = "`suturetrack run`" if len(missing) == len(topics.PROCESSES) else by_hand
            said += [
                f"no {' and no '.join(missing)} runs on rig {rig!r}",
                f"start one with {start}, or name the rig that runs",
            ]
        return Unavailable("; ".join(said))

    def _beginners(self) -> dict[str, str]:
        """What those who run and are not ready yet wait for, in words, by process."""
        sought = set(topics.PROCESSES) - self.bus.alive()
        heard: dict[str, str] = {}
        deadline = time.monotonic() + _BEAT_S
        with self.bus.every(topics.HEALTH) as reader:
            while sought - heard.keys():
                health = reader.get(max(0.0, deadline - time.monotonic()))
                if health is None:
                    break
                if not health.ready:
                    waits = f"waits for the {health.awaits}"
                    heard[health.process] = waits if health.awaits else "is not ready yet"
        return heard

    def _listen(self) -> None:
        for state in self._reader:
            seen = Seen(state, self._reader.arrived_ns)
            with self._lock:
                before = self._latest.get(state.thread, seen)
                since_ns = min(before.arrived_ns, seen.arrived_ns - _GONE_NS)
                self._latest[state.thread] = seen
                if FORGOTTEN in state.events:
                    del self._latest[state.thread]
                self._latest = {
                    name: other
                    for name, other in self._latest.items()
                    if other.arrived_ns >= since_ns
                }
                for inbox, thread in self._listeners.items():
                    if thread in (None, state.thread):
                        inbox.put(seen)


def _plain(values: Any, shape: tuple[int, ...], what: str) -> Any:
    """Numbers of a shape, NumPy's too, as Python's own; None stays None. Raises InputError."""
    if values is None:
        return None
    try:
        array = np.array(values, float)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = f"{'x'.join(map(str, shape))} finite numbers" if shape else "a finite number"
        raise InputError(f"{what} {values!r}: use {wanted}")
    plain = array.tolist()
    return tuple(plain) if shape else plain


def _check(message: object) -> None:
    try:
        check(message)
    except ValueError as error:
        raise InputError(str(error)) from error

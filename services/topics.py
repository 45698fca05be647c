"""The wiring, as data: which process publishes what, of which type, under which key, and how it is read.

Keys stand below `suturetrack/<rig>/`; a name in braces is a field of the message.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from services.messages import (
    Forget,
    Forgotten,
    GraspReply,
    GraspRequest,
    Health,
    SeedReply,
    ToolPose,
    ToolSnap,
)
from suturetrack.camera import StereoRig
from suturetrack.types import RidgeField, Seed, Stamp, StereoFrame, ThreadState, Truth

PROCESSES = ("source", "segmenter", "tracker")
"""The processes that every rig needs, in the order of the dataflow."""

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


@dataclass(frozen=True)
class Topic(Generic[T]):
    """A stream of messages."""

    key: str
    kind: type[T]
    publisher: str
    """Name of the process; "*" for every one."""
    keep: Literal["newest", "every"]
    """What a reader gets in real time: the newest message, or every one in order."""
    purpose: str
    keeper: str = ""
    """Name of the process that remembers the last message of every key, for those who come late, and
    for the publisher when it has died and was started again; nobody does without a name."""


@dataclass(frozen=True)
class Question(Generic[Q, A]):
    """Something that one process answers when asked."""

    key: str
    kind: type[Q]
    answer: type[A]
    server: str
    """Name of the process that answers."""
    purpose: str


FRAME = Topic("frame", StereoFrame, "source", "newest", "both raw images")
FIELD = Topic("field", RidgeField, "segmenter", "newest", "both rectified ridge fields")
STATE = Topic(
    "thread/{thread}/state", ThreadState, "tracker", "every", "the curve and its worth", "source"
)
TRUTH = Topic("thread/{thread}/truth", Truth, "source", "every", "where a synthetic thread is")
SEEDING = Topic(
    "thread/{thread}/seeding",
    Seed,
    "tracker",
    "every",
    "a seed that was accepted",
    "source",
)
DROPPED = Topic(
    "thread/{thread}/dropped",
    Forget,
    "tracker",
    "every",
    "the thread was dropped: what was learned at its seed is void",
)
STEP = Topic("step", Stamp, "tracker", "every", "the tracker is done with this frame", "segmenter")
HEALTH = Topic("health/{process}", Health, "*", "every", "heartbeat, once a second")
TOOL = Topic("tool/{tool}/pose", ToolPose, "client", "every", "where a tool is, and its trigger")
SNAP = Topic("tool/{tool}/snap", ToolSnap, "tooltip", "every", "the thread at the tip of a tool")
TOPICS: tuple[Topic[Any], ...] = (
    FRAME,
    FIELD,
    STATE,
    TRUTH,
    SEEDING,
    DROPPED,
    STEP,
    TOOL,
    SNAP,
    HEALTH,
)

CALIBRATION: Question[None, StereoRig] = Question(
    "calibration", type(None), StereoRig, "source", "the rig behind the frames"
)
SEED: Question[Seed, SeedReply] = Question(
    "thread/{thread}/seed", Seed, SeedReply, "tracker", "find the thread from here"
)
GRASP: Question[GraspRequest, GraspReply] = Question(
    "thread/{thread}/grasp", GraspRequest, GraspReply, "tracker", "where to take the thread"
)
FORGET: Question[Forget, Forgotten] = Question(
    "thread/{thread}/forget", Forget, Forgotten, "tracker", "follow this thread no more"
)
QUESTIONS: tuple[Question[Any, Any], ...] = (CALIBRATION, SEED, GRASP, FORGET)


def root(rig: str) -> str:
    """What the keys of a rig begin with."""
    return f"suturetrack/{rig}"


def alive(process: str) -> str:
    """The liveliness key of a process; "*" for every one."""
    return f"alive/{process}"


def key_of(topic: Topic[T] | Question[T, Any], message: T) -> str:
    """The key below the rig under which a message goes."""
    return re.sub(r"{(\w+)}", lambda field: str(getattr(message, field[1])), topic.key)


def pattern_of(topic: Topic[Any] | Question[Any, Any]) -> str:
    """The key expression below the rig that matches every message of a topic."""
    return re.sub(r"{\w+}", "*", topic.key)

"""The wiring, as data: which process publishes what, of which type, under which key, and how it is read.

Keys stand below `suturetrack/<rig>/`; a field of the message in braces is filled in from the message.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from services.messages import Health, SeedReply
from suturetrack.camera import StereoRig
from suturetrack.types import RidgeField, Seed, Stamp, StereoFrame, ThreadState, Truth

ROOT = "suturetrack"

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


@dataclass(frozen=True)
class Topic(Generic[T]):
    """A stream of messages."""

    key: str
    type: type[T]
    publisher: str
    """Name of the process; "*" for every one."""
    keep: Literal["newest", "every"]
    """What a reader gets in real time: the newest message, or every one in order."""
    purpose: str

    def key_of(self, message: T) -> str:
        """The key below the rig under which a message goes."""
        return self.key.format_map(_Fields(message))

    @property
    def pattern(self) -> str:
        """The key expression below the rig that matches all messages of the topic."""
        return self.key.format_map(_ANY)


@dataclass(frozen=True)
class Question(Generic[Q, A]):
    """Something that one process answers when asked."""

    key: str
    question: type[Q] | None
    """None when the key says it all."""
    answer: type[A]
    server: str
    """Name of the process that answers."""
    purpose: str

    key_of = Topic.key_of
    pattern = Topic.pattern


FRAME = Topic("frame", StereoFrame, "source", "newest", "both raw images")
FIELD = Topic("field", RidgeField, "segmenter", "newest", "both rectified ridge fields")
STATE = Topic("thread/{thread}/state", ThreadState, "tracker", "every", "the curve and its worth")
TRUTH = Topic("thread/{thread}/truth", Truth, "source", "every", "where a synthetic thread is")
SEEDING = Topic(
    "thread/{thread}/seeding", Seed, "tracker", "every", "a seed from which the tracker now starts"
)
STEP = Topic("step", Stamp, "tracker", "every", "the tracker is done with this frame")
HEALTH = Topic("health/{process}", Health, "*", "every", "heartbeat, once a second")
TOPICS: tuple[Topic[Any], ...] = (FRAME, FIELD, STATE, TRUTH, SEEDING, STEP, HEALTH)

CALIBRATION = Question("calibration", None, StereoRig, "source", "the rig that frames come from")
SEED = Question("thread/{thread}/seed", Seed, SeedReply, "tracker", "find the thread from here")
QUESTIONS: tuple[Question[Any, Any], ...] = (CALIBRATION, SEED)

ALIVE = "alive/{process}"


class _Fields(dict[str, Any]):
    def __init__(self, message: object):
        super().__init__()
        self._message = message

    def __missing__(self, name: str) -> str:
        return str(getattr(self._message, name))


class _Any(dict[str, str]):
    def __missing__(self, name: str) -> str:
        return "*"


_ANY = _Any()

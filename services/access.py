"""Who may do what on a rig: the roles, and Zenoh's access rules made from them.

Everything that is not named here is denied, on the router and on each process that connects to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from services import topics
from services.topics import QUESTIONS, TOPICS, Question, Topic

ROUTER = "router"
Flow = Literal["ingress", "egress"]
Rule = dict[str, Any]


@dataclass(frozen=True)
class Role:
    """What a certificate allows; what a role publishes, answers and keeps is in `services.topics`."""

    name: str
    purpose: str
    reads: tuple[Topic[Any], ...] = ()
    asks: tuple[Question[Any, Any], ...] = ()
    recalls: tuple[Topic[Any], ...] = ()
    """Topics whose last message it may ask of their keeper."""
    processes: tuple[str, ...] = ()
    """Names under which it may report its health and be seen alive."""

    @property
    def publishes(self) -> tuple[Topic[Any], ...]:
        """Topics of its own; health aside, which every process publishes."""
        return tuple(t for t in TOPICS if t.publisher in (self.name, *self.processes))

    @property
    def keeps(self) -> tuple[Topic[Any], ...]:
        """Topics whose last message it remembers."""
        return tuple(t for t in TOPICS if t.keeper == self.name)

    @property
    def answers(self) -> tuple[Question[Any, Any], ...]:
        """Questions that it answers."""
        return tuple(q for q in QUESTIONS if q.server == self.name)


_WATCHED = (
    topics.FRAME,
    topics.FIELD,
    topics.STATE,
    topics.TRUTH,
    topics.SEEDING,
    topics.SNAP,
    topics.HEALTH,
)
_RECALLED = (topics.STATE, topics.SEEDING)

ROLES = {
    role.name: role
    for role in (
        Role(
            "source",
            "releases frames",
            reads=(topics.STEP,),
            recalls=(topics.STEP,),
            processes=("source",),
        ),
        Role(
            "segmenter",
            "turns frames into fields",
            reads=(topics.FRAME, topics.SEEDING, topics.DROPPED, topics.STATE),
            asks=(topics.CALIBRATION,),
            recalls=(topics.STATE,),
            processes=("segmenter",),
        ),
        Role(
            "tracker",
            "holds the threads",
            reads=(topics.FIELD,),
            asks=(topics.CALIBRATION,),
            recalls=_RECALLED,
            processes=("tracker",),
        ),
        Role(
            "operator",
            "watches, seeds, and asks for grasps",
            reads=(*_WATCHED, topics.TOOL),
            asks=QUESTIONS,
            recalls=_RECALLED,
            processes=("run", "client", "console", "tooltip"),
        ),
        Role("viewer", "watches", reads=_WATCHED, asks=(topics.CALIBRATION,), recalls=_RECALLED),
        Role(
            "bridge",
            "passes states, seeds and grasps on to another system",
            reads=(topics.STATE, topics.HEALTH),
            asks=QUESTIONS,
            recalls=_RECALLED,
            processes=("ros2",),
        ),
    )
}


def router_rules(rigs: Iterable[str]) -> dict[str, Any]:
    """Zenoh's `access_control` for a router between the roles of some rigs."""
    rules: list[Rule] = []
    policies = []
    subjects = []
    for rig in rigs:
        for role in ROLES.values():
            name = common_name(rig, role.name)
            own = _rules(name, rig, role, said="ingress", heard="egress")
            rules += own
            subjects.append({"id": name, "cert_common_names": [name]})
            policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return _denying(rules, subjects, policies)


def process_rules(rig: str, role: Role) -> dict[str, Any]:
    """Zenoh's `access_control` for a process of a role, which hears of its router alone."""
    rules = _rules(common_name(rig, role.name), rig, role, said="egress", heard="ingress")
    subjects = [{"id": ROUTER, "cert_common_names": [ROUTER]}]
    policies = [{"rules": [rule["id"] for rule in rules], "subjects": [ROUTER]}]
    return _denying(rules, subjects, policies)


def common_name(rig: str, role: str) -> str:
    """The name in the certificate of a role."""
    return f"{rig}-{role}"


def _rules(name: str, rig: str, role: Role, *, said: Flow, heard: Flow) -> list[Rule]:
    """What a role says and what it hears, as flows of the one who applies the rules."""
    published = _keys(role.publishes)
    own = [f"health/{p}" for p in role.processes] + published
    # Who reads health subscribes to that of all processes at once, so each has to allow that.
    read_by_others = _keys([topics.HEALTH] if role.processes else []) + published
    read = _keys(role.reads) + _keys(role.keeps)
    served = _keys(role.answers) + _keys(role.keeps)
    asked = _keys(role.asks) + _keys(role.recalls)
    here = [topics.alive(p) for p in role.processes]
    everyone = [topics.alive("*")]
    parts: list[tuple[str, Flow, list[str], list[str]]] = [
        ("says", said, ["put", "delete"], own),
        ("hears-who-reads", heard, ["declare_subscriber"], read_by_others),
        ("reads", said, ["declare_subscriber"], read),
        ("hears", heard, ["put", "delete"], read),
        ("serves", said, ["declare_queryable", "reply"], served),
        ("is-asked", heard, ["query"], served),
        ("asks", said, ["query"], asked),
        ("is-answered", heard, ["declare_queryable", "reply"], asked),
        ("lives", said, ["liveliness_token"], here),
        ("is-watched", heard, ["declare_liveliness_subscriber", "liveliness_query"], here),
        ("watches", said, ["declare_liveliness_subscriber", "liveliness_query"], everyone),
        ("sees", heard, ["liveliness_token"], everyone),
    ]
    return [
        {
            "id": f"{name}-{part}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": [f"{topics.root(rig)}/{key}" for key in keys],
        }
        for part, flow, messages, keys in parts
        if keys
    ]


def _keys(wiring: Iterable[Topic[Any] | Question[Any, Any]]) -> list[str]:
    return [topics.pattern_of(one) for one in wiring]


def _denying(
    rules: list[Rule], subjects: list[dict[str, Any]], policies: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }

"""Writes docs/topics.md and docs/configuration.md from the code, so that they are never out of date.

python tools/write_reference.py
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import itertools
import textwrap
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import UnionType
from typing import Any

import tyro

from services import access, topics, wire
from services.arguments import FLAT
from services.cli import VERBS
from services.topics import Question, Topic

DOCS = Path(__file__).parents[1] / "docs"

_TOPICS = """# Topics and schemas

Written by `tools/write_reference.py` from `services/topics.py`, `services/access.py` and the types that
travel.

All keys stand below `suturetrack/<rig>/`. Each message has an encoding that names its schema and
version, and an attachment: a MessagePack map with the fields of `Header` below. Frames and fields
travel as their raw arrays, the left view first, shapes and dtype in the header; everything else is
MessagePack, a map by field name, arrays as nested lists. **Lengths on the wire are in metres**, times
are integer nanoseconds, points are in the rectified left camera (x right, y down, z forward), pixels
are `(u, v)` with the centre of the top-left pixel at (0, 0). A message of another version, shape or
range is refused, counted and logged.

Each process also holds a liveliness token `alive/<process>`. A token is a hint: a hung process keeps
it. What tells live from stale is the stamp.
"""
_ROLES = """What a process may do whose certificate names a role; every role with processes publishes their
health, too. See [Strangers](deployment.md#strangers).
"""
_CONFIGURATION = """# Configuration

Written by `tools/write_reference.py` from the dataclasses that are the command line; the same texts
are in `suturetrack VERB --help`. Every run writes what it ran with to its folder as TOML.
"""


def topics_page() -> str:
    """docs/topics.md."""
    streams = _table(
        ("key", "message", "from", "read", "kept by", "what"),
        (
            (f"`{t.key}`", _message(t.kind), _everyone(t), t.keep, t.keeper or "-", t.purpose)
            for t in topics.TOPICS
        ),
    )
    questions = _table(
        ("key", "question", "answer", "answered by", "what"),
        (
            (f"`{q.key}`", _message(q.kind), _message(q.answer), q.server, q.purpose)
            for q in topics.QUESTIONS
        ),
    )
    roles = _table(
        ("role", "publishes", "reads", "asks", "answers", "asks for the last"),
        (
            (
                role.name,
                *map(_keys, (role.publishes, role.reads, role.asks, role.answers, role.recalls)),
            )
            for role in access.ROLES.values()
        ),
    )
    parts = [_TOPICS, "## Streams\n", streams, "\n## Questions\n", questions]
    parts += ["\n## Roles\n", _ROLES, roles, "\n## Messages\n"]
    return "\n".join(parts + [_message_section(kind) for kind in (wire.Header, *_kinds())])


def configuration_page() -> str:
    """docs/configuration.md."""
    parts = [_CONFIGURATION]
    for name, verb in VERBS.items():
        config = getattr(importlib.import_module(verb.module), verb.config)
        rows = list(_options(config, ""))
        parts.append(f"## suturetrack {name}\n\n{_first_line(config)}\n")
        parts.append(_table(("option", "default", "meaning"), rows) + "\n")
    return "\n".join(parts)


def _kinds() -> list[type[Any]]:
    """Every type that travels, and those that are parts of them, in the order of first use."""
    wanted: list[Any] = [t.kind for t in topics.TOPICS]
    for question in topics.QUESTIONS:
        wanted += [question.kind, question.answer]
    kinds: list[type[Any]] = []
    while wanted:
        kind = wanted.pop(0)
        if dataclasses.is_dataclass(kind) and isinstance(kind, type) and kind not in kinds:
            kinds.append(kind)
            wanted += [part for hint in _hints(kind).values() for part in _parts(hint)]
    return kinds


def _message(kind: type[Any]) -> str:
    if kind is type(None):
        return "nothing"
    return f"[{kind.__name__}](#{kind.__name__.lower()}) `{wire.encoding_of(kind)}`"


def _keys(wiring: Iterable[Topic[Any] | Question[Any, Any]]) -> str:
    return ", ".join(f"`{one.key}`" for one in wiring)


def _everyone(topic: Topic[Any] | Question[Any, Any]) -> str:
    return "every process" if topic.publisher == "*" else topic.publisher


def _message_section(kind: type[Any]) -> str:
    docs, types = _field_docs(kind), _field_types(kind)
    rows = [(f"`{name}`", f"`{types[name]}`", docs.get(name, "")) for name in types]
    about = _first_line(kind)
    return f"### {kind.__name__}\n\n{about}\n\n{_table(('field', 'type', 'meaning'), rows)}\n"


def _options(config: type[Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    hints, docs = _hints(config), _field_docs(config)
    for field in dataclasses.fields(config):
        nested = [p for p in _parts(hints[field.name]) if dataclasses.is_dataclass(p)]
        if nested and len(nested) == 1:
            inner = prefix if field.name in FLAT else f"{prefix}{field.name.replace('_', '-')}."
            yield from _options(nested[0], inner)
        elif nested:
            for part in nested:
                yield (f"**{part.__name__}**", "", _first_line(part))
                yield from _options(part, prefix)
        else:
            yield f"`{_option(config, field.name, prefix)}`", _default(field), docs[field.name]


def _option(config: type[Any], field: str, prefix: str) -> str:
    hint = typing.get_type_hints(config, include_extras=True)[field]
    marks = getattr(hint, "__metadata__", ())
    if tyro.conf.Positional in marks:
        return field.upper()
    names = [mark.name for mark in marks if getattr(mark, "name", None)]
    return f"--{prefix}{names[0] if names else field.replace('_', '-')}"


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return f"`{field.default}`"
    if field.default_factory is not dataclasses.MISSING:
        return f"`{field.default_factory()}`"
    return "needed"


def _hints(kind: type[Any]) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _parts(hint: Any) -> list[Any]:
    """The types that a hint is made of: itself, or the members of a union, a list, a tuple."""
    inner = typing.get_args(hint)
    if isinstance(hint, UnionType) or inner:
        return [part for one in inner for part in _parts(one)]
    return [hint]


def _field_docs(kind: type[Any]) -> dict[str, str]:
    """The string below each field, on one line."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = _body(base)
        for statement, after in itertools.pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                match after:
                    case ast.Expr(ast.Constant(str(text))):
                        docs[statement.target.id] = " ".join(text.split())
    return docs


def _field_types(kind: type[Any]) -> dict[str, str]:
    return {
        s.target.id: ast.unparse(s.annotation)
        for s in _body(kind)
        if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)
    }


def _body(kind: type[Any]) -> list[ast.stmt]:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    except (OSError, TypeError):
        return []
    match tree.body[0]:
        case ast.ClassDef(body=body):
            return body
    return []


def _first_line(kind: type[Any]) -> str:
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(c.replace("|", "\\|") for c in line) + " |" for line in lines
    )


PAGES = {"topics.md": topics_page, "configuration.md": configuration_page}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (DOCS / name).write_text(page())

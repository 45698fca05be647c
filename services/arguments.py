"""Configurations as command lines and as files."""

from __future__ import annotations

import dataclasses
import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tyro

from suturetrack.types import InputError

FLAT = ("service", "input")
"""Fields whose own fields are options without a prefix."""

T = TypeVar("T")
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def parse(kind: type[T], prog: str, arguments: Sequence[str]) -> T:
    """The configuration that options ask for; what is wrong with them is said in one line on stderr.

    Raises:
        SystemExit: with status 0 for --help, 2 for wrong options.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(kind, prog=prog, args=arguments)
    except SystemExit as ended:
        if ended.code:
            fault = _in_one_line(said.getvalue()).replace(f"from {prog}: ", "") or said.getvalue()
            print(f"{prog}: {fault}; see `{prog} --help`", file=sys.stderr)
        raise


def arguments_of(config: Any, prefix: str = "") -> list[str]:
    """The options that make a process's parser return `config`; what is default is left out."""
    options: list[str] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in FLAT:
            options += arguments_of(value, prefix)
        elif dataclasses.is_dataclass(value):
            options += arguments_of(value, f"{prefix}{field.name}.")
        elif value != field.default:
            options += _option(prefix, field.name, value)
    return options


def metres(length: str) -> float:
    """A length with its unit, such as `10mm`, in metres; raises InputError."""
    found = re.fullmatch(r"([-+]?[0-9]*\.?[0-9]+(?:e-?[0-9]+)?) *(mm|cm|m)", length.strip())
    if found is None:
        raise InputError(f"length {length!r}: use a number with its unit, such as 10mm or 0.01m")
    return float(found[1]) * _METRES[found[2]]


def write_config(config: Any, path: Path) -> None:
    """Writes every parameter, defaults too, as TOML; raises OSError."""
    plain = msgspec.to_builtins(config, enc_hook=str)
    path.write_bytes(msgspec.toml.encode(_without_none(plain)))


def _in_one_line(box: str) -> str:
    """What the parser says in a box: a title, sections, and options over their indented explanations."""
    plain = re.sub(r"\x1b\[[\d;]*m", "", box).replace("{None}|", "")
    lines = [line[2:].rstrip(" │") for line in plain.splitlines()[1:-1]]
    sections = [list(s) for is_text, s in groupby(lines, lambda s: s.strip(" ─-") != "") if is_text]
    faults = [s for s in sections if not s[0].startswith(("For full help", "Got errors"))]
    return "; ".join(_section_in_one_line(s) for s in faults)


def _section_in_one_line(lines: list[str]) -> str:
    if lines[0].startswith("Argument helptext"):
        return f"use {lines[1].strip()}"
    head, items = "", list[str]()
    for indent, part in groupby(lines, lambda line: len(line) - len(line.lstrip())):
        text = " ".join(line.strip() for line in part)
        if indent < 4:
            head += text + " "
        elif indent < 8:
            items.append(text)
        elif items and not items[-1].startswith("-"):
            items[-1] += f" ({text.removesuffix('(required)').strip(' .')})"
    return (head[:1].lower() + head[1:] + ", ".join(items)).strip(" .")


def _option(prefix: str, name: str, value: Any) -> list[str]:
    name = name.replace("_", "-")
    if isinstance(value, bool):
        return [f"--{prefix}{name}" if value else f"--{prefix}no-{name}"]
    return [f"--{prefix.replace('_', '-')}{name}", *_words(value)]


def _words(value: Any) -> Iterator[str]:
    if isinstance(value, tuple | list):
        for part in value:
            yield from _words(part)
    else:
        yield str(value)


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return value

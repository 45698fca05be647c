"""Configurations as command lines and as files."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from suturetrack.types import InputError

FLAT = ("service", "input")
"""Fields whose own fields are options without a prefix."""

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


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

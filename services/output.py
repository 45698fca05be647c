"""Where a verb writes what it was asked for, and what to type next."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from suturetrack.types import InputError


def command(*words: object) -> str:
    """A command of ours as a shell takes it, whatever the names of its files are."""
    return shlex.join(("suturetrack", *map(str, words)))


@contextmanager
def opened(output: Path | None) -> Iterator[TextIO]:
    """The output, for text; standard output when None.

    A file appears under its name only when it is whole, also where the name is a link to it. What is no
    file, such as a pipe or a device, is written to as it is.

    Raises:
        InputError: it cannot be written.
        BrokenPipeError: who read a pipe has seen enough.
    """
    if output is None:
        yield sys.stdout
        return
    try:
        is_new = not output.exists()
        with _whole(output) if is_new or output.is_file() else _straight(output) as file:
            yield file
    except BrokenPipeError:
        raise
    except OSError as error:
        raise InputError(f"cannot write {output}: {error.strerror}") from error


@contextmanager
def _whole(output: Path) -> Iterator[TextIO]:
    target = Path(os.path.realpath(output))
    unfinished = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with _straight(unfinished) as file:
            yield file
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)


def _straight(output: Path) -> TextIO:
    return output.open("w", newline="", encoding="utf-8")

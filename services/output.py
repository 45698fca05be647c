"""Where a verb writes what it was asked for: a file, or the folder of a run; and what to type next."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from services.arguments import write_config
from suturetrack.calibration import save_calibration
from suturetrack.camera import StereoRig
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


def fresh_folder(name: str) -> Path:
    """A run's folder, named after now and what is recorded."""
    return Path("recordings") / f"{time.strftime('%Y%m%d-%H%M%S')}-{name}"


def check_holds_no_run(folder: Path) -> None:
    """Raises InputError for a folder that another run was recorded to."""
    if folder.is_dir() and any(folder.glob("*.rrd")):
        raise InputError(f"run folder {folder} holds a run already; give another --run-dir")


def begin_run(folder: Path, config: Any, rig: StereoRig, calibration: Path | None = None) -> None:
    """Makes a run's folder, with its parameters and its calibration: a copy of the file, if it is one.

    Raises:
        InputError: it holds a run already, or cannot be written to.
    """
    check_holds_no_run(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_config(config, folder / "config.toml")
        if calibration is not None and calibration.is_file():
            shutil.copyfile(calibration, folder / "calibration.yaml")
        else:
            save_calibration(folder / "calibration.yaml", rig)
    except OSError as error:
        raise InputError(f"run folder {folder}: {error.strerror}") from error

"""`suturetrack view`: a run in the Rerun viewer."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import tyro

from services.run_folder import RunFolder
from suturetrack.types import InputError


@dataclass(frozen=True)
class ViewConfig:
    """Opens a run in the Rerun viewer; nothing but this machine can reach it."""

    run_dir: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    web: bool = False
    """Shows the viewer in the browser, for a machine without a display."""


def run(config: ViewConfig) -> None:
    """Runs the viewer until it is closed.

    Raises:
        InputError: nothing to show, or no display to show it on.
    """
    folder = RunFolder(config.run_dir)
    for problem in folder.problems:
        print(f"view: {problem}", file=sys.stderr)
    has_display = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)
    if not config.web and not has_display:
        raise InputError("there is no display; --web shows the run in a browser")
    status = subprocess.run(command(folder, config.web), check=False).returncode
    if status:
        raise InputError(f"the Rerun viewer ended with status {status}")


def command(folder: RunFolder, web: bool) -> list[str]:
    """The viewer's own command line, the file with the layout of all threads first."""
    files = sorted(folder.files, key=lambda file: not file.name.startswith("tracker"))
    options = ["--bind", "127.0.0.1", *(["--web-viewer"] if web else [])]
    return [str(viewer()), *options, *map(str, files)]


def viewer() -> Path:
    """The viewer itself; `rerun` on the path only starts it, and would leave it behind."""
    spec = find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise InputError("the Rerun viewer is missing; it comes with rerun-sdk")
    return Path(spec.origin).with_name("rerun.exe" if os.name == "nt" else "rerun")

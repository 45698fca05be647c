"""`suturetrack view`: a run in the Rerun viewer."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import uuid
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import rerun as rr
import tyro

from services import topics
from services.bus import Bus, NoAnswer
from services.live import LiveView
from services.run_file import APPLICATION
from services.run_folder import RunFolder, rerun_program
from services.service import ServiceConfig
from services.service import run as run_service
from suturetrack.types import InputError

_PAUSE_S = 0.1
"""Between two questions for a rig, which nobody answers at once while none runs."""


@dataclass(frozen=True)
class ViewConfig:
    """Opens a run in the Rerun viewer, or what is running now; only this machine can reach it."""

    run_dir: Annotated[Path | None, tyro.conf.Positional] = None
    """The run's folder; without it, the live view of a running system."""
    web: bool = False
    """Shows the viewer in the browser, for a machine without a display."""
    rig: str = "rig"
    """Name of the rig to look at live."""
    zenoh: Path | None = None
    """The Zenoh configuration file of the live system, if it has one."""


def run(config: ViewConfig) -> None:
    """Runs the viewer until it is closed.

    Raises:
        InputError: nothing to show, or no display to show it on.
    """
    if not config.web:
        check_display("--web shows the run in a browser")
    if config.run_dir is None:
        service = ServiceConfig(rig=config.rig, zenoh=config.zenoh)
        run_service("view", service, lambda running: _follow(running.bus, config.web))
        return
    folder = RunFolder(config.run_dir)
    for problem in folder.problems:
        print(f"view: {problem}", file=sys.stderr)
    status = subprocess.run(
        command(config.web, *files(folder)), env=_surroundings(), check=False
    ).returncode
    if status:
        raise InputError(f"the Rerun viewer ended with status {status}")


def check_display(instead: str) -> None:
    """Raises InputError, with what to do instead, where there is no display to show a window on."""
    displays = (os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform == "linux" and not any(displays):
        raise InputError(f"there is no display; {instead}")


def _follow(bus: Bus, web: bool) -> None:
    """Shows what is published until the viewer is closed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    window = subprocess.Popen(
        command(web, "--port", str(port), "--hide-welcome-screen"), env=_surroundings()
    )
    try:
        rig = None
        while rig is None and window.poll() is None and not bus.stop.wait(_PAUSE_S):
            with suppress(NoAnswer):
                rig = bus.ask(topics.CALIBRATION, None, timeout=1.0)
        if rig is None:
            return
        stream = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        stream.set_sinks(rr.GrpcSink(f"rerun+http://127.0.0.1:{port}/proxy"))
        live = LiveView.on(bus, rig, stream)
        while window.poll() is None and not bus.stop.is_set:
            live.step()
    finally:
        window.terminate()
        window.wait()


def files(folder: RunFolder) -> list[str]:
    """The recordings, the one with the layout of all threads first."""
    return [str(f) for f in sorted(folder.files, key=lambda f: not f.name.startswith("tracker"))]


def command(web: bool, *arguments: str) -> list[str]:
    """The viewer's own command line."""
    options = ["--bind", "127.0.0.1", *(["--web-viewer"] if web else [])]
    return [str(rerun_program()), *options, *arguments]


def _surroundings() -> dict[str, str]:
    """The viewer's environment: what it says, such as where its page is, is for the user."""
    return {**os.environ, "RUST_LOG": "info"}

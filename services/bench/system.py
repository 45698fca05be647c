"""A whole running system with a consumer beside it, for benchmarks and tests that break parts of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Self

import cv2
import psutil

from services.client import Seen, connect
from services.topics import PROCESSES
from suturetrack.calibration import save_calibration
from suturetrack.stage import open_scene
from suturetrack.types import InputError, Status

START_S = 180.0
"""A first start compiles the kernels."""
_POLL_S = 0.0005


class System:
    """`suturetrack run` on a rig of its own, and a client of it.

    Args:
        rig: name of the rig; no other may run under it.
        options: of `suturetrack run`.
        folder: where logs and recordings go.
    """

    def __init__(self, rig: str, options: list[str], folder: Path):
        self.run_dir, self._log = folder / "run", folder / "run.log"
        command = [sys.executable, "-m", "services.cli", "run", "--rig", rig, *options]
        with self._log.open("w") as log:
            self._process = _start([*command, "--run-dir", str(self.run_dir)], log)
        self.client = connect(rig)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def launcher(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def said(self) -> str:
        """What the launcher has printed."""
        return self._log.read_text()

    def stop(self) -> int:
        """Ends the run as Ctrl-C does; the exit status."""
        self.client.close()
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        return self._process.wait(30)

    def processes(self) -> dict[str, psutil.Process]:
        """The processes of the dataflow that run now, by name."""
        return named(psutil.Process(self.launcher))

    def pid(self, process: str) -> int | None:
        """Process id of one of them; None while it is dead."""
        found = self.processes().get(process)
        return None if found is None else found.pid

    def until(self, condition: Callable[[], object], seconds: float = START_S) -> float:
        """Waits for a condition; the seconds it took. Raises InputError when it never comes true."""
        began = time.monotonic()
        while not condition():
            if self._process.poll() is not None:
                raise InputError(f"the run ended: {self.said.strip()[-500:]}")
            if time.monotonic() - began > seconds:
                raise InputError(f"waited in vain for {seconds:g} s: {self.said.strip()[-500:]}")
            time.sleep(_POLL_S)
        return time.monotonic() - began

    def until_tracking(self) -> float:
        """Waits for a live state of a thread that is tracked; the seconds it took."""
        return self.until(lambda: is_tracking(self.client.latest()))


def film(folder: Path, frames: int, fps: float, scenario: str = "figure8-175") -> list[str]:
    """Films the bench top into a folder of pairs; the options of a run that shows them without end."""
    scene = open_scene(scenario)
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for i in range(frames):
        for side, image in zip(("left", "right"), scene.render(i), strict=True):
            cv2.imwrite(str(folder / side / f"{i:03}.png"), image)
    save_calibration(folder / "calibration.yaml", scene.rig)
    u, v = scene.seed_pixel(0)
    options = ["--source", str(folder), "--calibration", str(folder / "calibration.yaml")]
    return [*options, "--loop", str(frames), "--fps", f"{fps:g}", "--seed", str(u), str(v)]


def is_tracking(seen: Seen | None) -> bool:
    """Whether a consumer may act on what it sees."""
    return seen is not None and seen.live and seen.state.status is Status.TRACKING


def named(parent: psutil.Process) -> dict[str, psutil.Process]:
    """The processes of the dataflow among the children of a process, by name."""
    found = {}
    for child in parent.children():
        with suppress(psutil.NoSuchProcess):
            if child.name() in PROCESSES and child.status() != psutil.STATUS_ZOMBIE:
                found[child.name()] = child
    return found


def _start(command: list[str], log: IO[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)


def private_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for one system, with a path short enough for sockets."""
    return tempfile.TemporaryDirectory(prefix="suturetrack-")


def rig_name(what: str) -> str:
    """A name that no other benchmark uses now."""
    return f"bench-{what}-{os.getpid()}"

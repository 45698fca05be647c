"""`suturetrack bench faults`: what a consumer sees when a process dies, stops, hangs or falls silent."""

from __future__ import annotations

import ctypes
import json
import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
from rich.console import Console
from rich.progress import Progress

from services.bench import report
from services.bench.system import System, film, private_folder, rig_name
from services.topics import PROCESSES
from suturetrack.types import InputError

Kind = Literal["killed", "stopped", "hung", "silent"]

_SEIZE, _INTERRUPT, _DETACH, _WALL = 0x4206, 0x4207, 17, 0x40000000
_MOST_S = 2.0
"""How long a view may stay live before the injection counts as never noticed."""
_PROMISED = 3
"""Frame periods until a view has to be stale; said here anew, so that it is not measured by itself."""
_FRAMES = 20
"""Of the film that is shown there and back."""


@dataclass(frozen=True)
class FaultsBench:
    """How soon a consumer's view is stale after a fault, and how soon it is live again."""

    repeats: int = 3
    """Injections of each kind into each process."""
    kinds: tuple[Kind, ...] = ("killed", "stopped", "hung", "silent")
    """killed: SIGKILL; stopped: SIGSTOP; hung: the thread of the loop stands still, heartbeats go on;
    silent: the loop goes on, but nothing leaves the process."""
    processes: tuple[str, ...] = PROCESSES
    """Into which processes."""
    fps: float = 30.0
    """Frames a second."""
    seed: int = 0
    """Of the moments of the injections."""
    results: Path | None = None
    """File to which every injection is added as it is done; those that it holds are not done again."""


@dataclass(frozen=True)
class Row:
    """All injections of one kind into one process."""

    fault: str
    process: str
    injections: int
    stale_p50_ms: float
    """From the fault until the consumer's view was stale."""
    stale_p99_ms: float
    stale_max_ms: float
    limit_ms: float
    missed: int
    """Injections after which the view was still live later than the limit."""
    back_p50_s: float
    """From the end of the fault (for a death: from the launcher's new start) to live tracking."""
    back_p99_s: float
    back_max_s: float


@dataclass
class Measured:
    """What the injections of one kind into one process gave."""

    stale_ms: list[float] = field(default_factory=list)
    missed: int = 0
    back_s: list[float] = field(default_factory=list)

    def add(self, other: Measured) -> None:
        """Takes in further injections."""
        self.stale_ms += other.stale_ms
        self.missed += other.missed
        self.back_s += other.back_s


def run(config: FaultsBench, console: Console) -> list[Row]:
    """Prints a row for each kind of fault and process."""
    cases = [(kind, process) for kind in config.kinds for process in config.processes]
    results = {case: Measured() for case in cases}
    for kind, process, measured in _read(config.results):
        if (kind, process) in results:
            results[kind, process].add(measured)
    chance = random.Random(config.seed + sum(len(m.stale_ms) for m in results.values()))
    todo = [case for case in cases for _ in range(config.repeats - len(results[case].stale_ms))]
    chance.shuffle(todo)
    if todo:
        for case, measured in _injections(config, console, todo, chance):
            results[case].add(measured)
            _write(config.results, *case, measured)
    table = [_row(*case, measured, config.fps) for case, measured in results.items()]
    report.print_rows(console, "Faults, as a consumer sees them", table)
    return table


def _injections(
    config: FaultsBench, console: Console, cases: list[tuple[Kind, str]], chance: random.Random
) -> Iterator[tuple[tuple[Kind, str], Measured]]:
    """Injects one fault after the other into one system."""
    with private_folder() as folder, Progress(console=console, transient=True) as progress:
        options = film(Path(folder) / "film", _FRAMES, config.fps)
        options += ["--restarts", "1000000"]
        with System(rig_name("faults"), options, Path(folder)) as system:
            system.until_tracking()
            for kind, process in progress.track(cases, description="Faults"):
                measured = Measured()
                inject(system, kind, process, measured, config.fps, chance)
                yield (kind, process), measured


def _read(path: Path | None) -> Iterator[tuple[Kind, str, Measured]]:
    if path is None or not path.exists():
        return
    for line in path.read_text().splitlines():
        fields = json.loads(line)
        yield fields.pop("kind"), fields.pop("process"), Measured(**fields)


def _write(path: Path | None, kind: Kind, process: str, measured: Measured) -> None:
    if path is not None:
        with path.open("a") as file:
            file.write(json.dumps({"kind": kind, "process": process, **asdict(measured)}) + "\n")


def inject(
    system: System,
    kind: Kind,
    process: str,
    measured: Measured,
    fps: float,
    chance: random.Random,
) -> None:
    """One fault at a random moment, until the consumer has a live view of a tracked thread again."""
    _idle(system, chance.uniform(0.2, 0.5))
    pid = system.pid(process)
    assert pid is not None
    with _faulty(kind, pid):
        _watch_it_go_stale(system, measured, _PROMISED / fps)
    if kind == "killed":
        system.until(lambda: system.pid(process) not in (None, pid))
    measured.back_s.append(system.until_tracking())


def _idle(system: System, seconds: float) -> None:
    """Lets the system run; a view that goes stale meanwhile, for want of time, is waited for."""
    until = time.monotonic() + seconds
    system.until(lambda: time.monotonic() > until)
    system.until_tracking()


def _watch_it_go_stale(system: System, measured: Measured, limit_s: float) -> None:
    """Asks for the view again and again from the fault on."""
    began = time.monotonic()
    late = False
    while True:
        asked = time.monotonic() - began
        seen = system.client.latest()
        if seen is None or not seen.live:
            measured.stale_ms.append(1e3 * asked)
            measured.missed += late
            return
        # What counts is an answer, to a question asked too late, that the view is live.
        late |= asked > limit_s
        if asked > _MOST_S:
            measured.stale_ms.append(np.inf)
            measured.missed += 1
            return


@contextmanager
def _faulty(kind: Kind, pid: int) -> Iterator[None]:
    """A process with a fault, which ends with the context where it is not dead."""
    if kind == "killed":
        os.kill(pid, signal.SIGKILL)
        yield
    elif kind == "stopped":
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)
    else:
        with _halted(pid, [t for t in _tasks(pid) if (t == pid) == (kind == "hung")]):
            yield


def _tasks(pid: int) -> list[int]:
    """The thread of a process's loop, and those of Zenoh; Python's other threads bear its name."""
    name = psutil.Process(pid).name()
    tasks = [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    named = {task: Path(f"/proc/{pid}/task/{task}/comm").read_text().strip() for task in tasks}
    return [task for task in tasks if task == pid or named[task] not in (name, "python")]


@contextmanager
def _halted(pid: int, tasks: list[int]) -> Iterator[None]:
    """Some threads of a process stand still, by the means of debuggers."""
    ptrace = ctypes.CDLL(None, use_errno=True).ptrace
    ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    seized = []
    try:
        for task in tasks:
            if ptrace(_SEIZE, task, None, None):
                raise InputError(f"cannot halt threads of {pid}: {os.strerror(ctypes.get_errno())}")
            seized.append(task)
        for task in seized:
            ptrace(_INTERRUPT, task, None, None)
        for task in seized:
            os.waitpid(task, _WALL)
        yield
    finally:
        for task in seized:
            ptrace(_DETACH, task, None, None)


def _row(kind: str, process: str, measured: Measured, fps: float) -> Row:
    stale, back = np.array(measured.stale_ms), np.array(measured.back_s)
    return Row(
        fault=kind,
        process=process,
        injections=len(stale),
        stale_p50_ms=float(np.percentile(stale, 50)),
        stale_p99_ms=float(np.percentile(stale, 99)),
        stale_max_ms=float(stale.max()),
        limit_ms=1e3 * _PROMISED / fps,
        missed=measured.missed,
        back_p50_s=float(np.percentile(back, 50)),
        back_p99_s=float(np.percentile(back, 99)),
        back_max_s=float(back.max()),
    )

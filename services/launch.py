"""Starts the processes of a run, shows how they do, stops them in order, and sums up."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.live import Live
from rich.text import Text

from services.arguments import arguments_of
from services.bus import Bus
from services.checks import check_rig
from services.fleet import Fleet, Launch
from services.monitor import Monitor
from services.output import begin_run, command, fresh_folder
from services.service import ServiceConfig, SharedConfig
from services.sources import InputConfig, open_input
from services.zenoh_transport import (
    ZenohTransport,
    load_config,
    local_config,
    remove_sockets,
    socket_directory,
    sweep_shared_memory,
)
from suturetrack.camera import StereoRig
from suturetrack.initialization import InitializationConfig
from suturetrack.segmentation import SegmentationConfig
from suturetrack.tracking import TrackingConfig
from suturetrack.types import InputError, Seed

_GLANCE_S = 0.2
_LINE_S = 5.0
"""Between two lines where there is no terminal to keep one line up to date."""
_WIDTH = 110
_LAST_WORDS_S = 0.3


@dataclass(frozen=True)
class RunConfig:
    """Tracks the seeded threads of a source: starts source, segmenter and tracker and records them."""

    input: Annotated[InputConfig, tyro.conf.arg(name="")]
    service: Annotated[SharedConfig, tyro.conf.arg(name="")] = field(default_factory=SharedConfig)
    seed: tuple[tuple[float, float], ...] = ()
    """U V of a pixel on the thread in the raw left image of the first frame; another pair for every
    further thread. The bench top knows its own."""
    view: bool = False
    """Show the run in the Rerun viewer while it goes on."""
    restarts: int = 5
    """How often within a minute a process that died is started again before the run is given up; 0 is
    never, as in lock-step, which has to be the same from beginning to end."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)


@dataclass(frozen=True)
class DemoConfig:
    """Tracks a thread on the synthetic bench top for 20 s, and records it."""

    service: Annotated[SharedConfig, tyro.conf.arg(name="")] = field(default_factory=SharedConfig)
    scenario: str = "figure8-175"
    """What happens on the bench top."""
    view: bool = False
    """Show the run in the Rerun viewer while it goes on."""


def run(config: RunConfig | DemoConfig) -> None:
    """Runs until the source has ended, a process fails, or SIGINT or SIGTERM.

    Raises:
        InputError: something given is at fault, or a process failed.
    """
    if isinstance(config, DemoConfig):
        demo = InputConfig(f"stage:{config.scenario}", fps=30.0, frames=600)
        config = RunConfig(demo, config.service, view=config.view)
    if config.view:
        from services.view import check_display  # late, as few need what the viewer does

        check_display(
            "leave --view out, and watch with `suturetrack console` or `suturetrack view --web`; "
            "all is recorded"
        )
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _WIDTH
    with ExitStack() as stack:
        rig_name = stack.enter_context(_reserved(config.service))
        config, rig = _resolve(config, rig_name)
        assert config.service.run_dir is not None
        begin_run(config.service.run_dir, config, rig, config.input.calibration)
        console.print(_rig_line(rig))
        console.print(f"Recording to {config.service.run_dir}", markup=False, soft_wrap=True)
        if not config.seed:
            console.print("No --seed U V: nothing is tracked until a seed is sent.")
        monitor = _watch(config, console, stack)
    for table in monitor.tables():
        console.print(table)
    for warning in monitor.warnings():
        console.print(warning, markup=False, soft_wrap=True)
    opens = command("view", config.service.run_dir)
    console.print(f"Open it with: {opens}", markup=False, soft_wrap=True)


def _rig_line(rig: StereoRig) -> str:
    width, height = rig.image_size
    baseline_mm = rig.baseline * rig.mm_per_unit
    return f"Rig: {width}x{height} px, baseline {baseline_mm:.2f} mm, calibrated in {rig.unit}"


def _resolve(config: RunConfig, rig_name: str) -> tuple[RunConfig, StereoRig]:
    """Everything that is left open filled in, and all that is given checked; raises InputError."""
    footage, rig = open_input(config.input)
    footage.close()
    if config.service.lockstep and footage.live:
        raise InputError("--lockstep needs recorded input; a camera does not wait")
    if config.service.zenoh is not None:
        load_config(config.service.zenoh)
    seeds = config.seed or footage.seeds
    for pixel in seeds:
        rig.locate(Seed(pixel=pixel))
    name = Path(config.input.source.split(",")[0].rpartition(":")[2]).stem or "run"
    run_dir = config.service.run_dir or fresh_folder(name)
    shared = replace(config.service, rig=rig_name, run_dir=run_dir.absolute())
    service = ServiceConfig(**vars(shared), parent=os.getpid())
    return replace(config, seed=seeds, service=service), rig


@contextmanager
def _reserved(service: SharedConfig) -> Iterator[str]:
    """The name of the rig, for this run alone; the default name gives way to a run that has it."""
    check_rig(service.rig)
    if service.zenoh is not None:
        yield service.rig
        return
    names = [service.rig]
    if service.rig == ServiceConfig.rig:
        names.append(f"{service.rig}-{os.getpid()}")
    for name in names:
        with (socket_directory(name) / "run.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            try:
                yield name
            finally:
                remove_sockets(name)
            return
    raise InputError(f"rig {service.rig!r} runs already; stop that run, or give another --rig")


def _watch(config: RunConfig, console: Console, stack: ExitStack) -> Monitor:
    """Starts the processes and stays until they have ended; raises InputError when one fails."""
    service = config.service
    if service.zenoh is None:
        stack.callback(sweep_shared_memory)
        zenoh = local_config(service.rig, "run")
    else:
        zenoh = load_config(service.zenoh)
    bus = Bus(ZenohTransport(zenoh), service.rig, "run")
    stack.callback(bus.close)
    # From here on: who waits for a router is interrupted at once.
    stop = list[int]()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    monitor = Monitor(bus)
    budget = 0 if service.lockstep else config.restarts
    say = partial(console.print, markup=False, soft_wrap=True)
    fleet = Fleet(_launches(config), say, budget, monitor.pulse)
    if config.view:
        stack.callback(_show(service).terminate)
    try:
        with closing(_glances(monitor, console)) as glances:
            for _ in glances:
                if stop or not fleet.tend():
                    break
    finally:
        fleet.stop()
        time.sleep(_LAST_WORDS_S)
        monitor.listen()
    complaint = fleet.complaint()
    if complaint is not None and not stop:
        raise InputError(complaint)
    return monitor


def _glances(monitor: Monitor, console: Console) -> Generator[None]:
    """Keeps the live line up to date, for as long as it is asked for another glance."""
    if console.is_terminal:
        with Live(console=console, refresh_per_second=4, transient=True) as live:
            while True:
                monitor.listen()
                live.update(Text(monitor.line()))
                yield
                time.sleep(_GLANCE_S)
    spoken = time.monotonic()
    while True:
        monitor.listen()
        if time.monotonic() - spoken >= _LINE_S:
            spoken = time.monotonic()
            console.print(monitor.line(), soft_wrap=True)
        yield
        time.sleep(_GLANCE_S)


def _show(service: SharedConfig) -> subprocess.Popen[bytes]:
    """The viewer, in a process that nobody waits for."""
    options = arguments_of(SharedConfig(rig=service.rig, zenoh=service.zenoh))
    return subprocess.Popen([sys.executable, "-m", "services.cli", "view", *options])


def _launches(config: RunConfig) -> list[Launch]:
    """The processes of a run, in the order in which they are stopped."""
    shared = arguments_of(config.service)
    seed = ["--seed", *(str(x) for pixel in config.seed for x in pixel)] if config.seed else []
    segmentation = arguments_of(config.segmentation, "segmentation.")
    tracking = arguments_of(config.tracking, "tracking.")
    initialization = arguments_of(config.initialization, "initialization.")
    return [
        Launch("source", (*shared, *arguments_of(config.input))),
        Launch("segmenter", (*shared, *seed, *segmentation)),
        Launch("tracker", (*shared, *seed, *tracking, *initialization)),
    ]

"""`suturetrack replay`: what was recorded goes through today's code once more, into a new run."""

from __future__ import annotations

import difflib
import threading
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import msgspec
import tyro
from rich.progress import track

from services import segmenter, topics, tracker
from services.arguments import write_config
from services.bus import Bus, Reader
from services.memory_transport import Hub
from services.run_folder import RunFolder
from services.segmenter import SegmenterConfig
from services.service import Service, ServiceConfig, Stopped
from services.tracker import TrackerConfig
from suturetrack.calibration import save_calibration
from suturetrack.initialization import InitializationConfig
from suturetrack.segmentation import SegmentationConfig
from suturetrack.tracking import TrackingConfig
from suturetrack.types import InputError, RidgeField, Stamp, StereoFrame, Truth

_STEP_S = 60.0
_READY_S = 120.0


@dataclass(frozen=True)
class ReplayConfig:
    """Plays a run again, lock-step, with the parameters it had or with others.

    A run that was recorded with `--recording full`, played with the same version and parameters,
    gives the same states to the bit; `compare` tells what a change did.
    """

    run: tyro.conf.Positional[Path]
    """The folder of the recorded run."""
    run_dir: Path | None = None
    """The new run's folder; beside the old one without it."""
    from_: Annotated[Literal["segmenter", "tracker"], tyro.conf.arg(name="from")] = "segmenter"
    """The first process that works anew: segmenter (on recorded frames), or tracker (on recorded
    fields, which only full recordings have)."""
    set: tuple[str, ...] = ()
    """KEY=VALUE of parameters to change, such as tracking.iterations=5."""
    recording: Literal["light", "full"] = "light"
    """Level of the new recording."""


@dataclass(frozen=True)
class Parameters:
    """Those of a run that its result depends on."""

    seed: tuple[tuple[float, float], ...] = ()
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)


def run(config: ReplayConfig) -> None:
    """Replays the run.

    Raises:
        InputError: the run cannot be read or lacks what is needed, or a parameter is wrong.
    """
    folder = RunFolder(config.run)
    parameters = changed(_recorded_parameters(config.run), config.set)
    new = config.run_dir or _beside(config.run)
    if new.is_dir() and any(new.glob("*.rrd")):
        raise InputError(f"run folder {new} holds a run already; give another --run-dir")
    level = next(iter(folder.about().values()))["level"]
    if config.from_ == "tracker" and level != "full":
        raise InputError(f"{config.run}: recorded {level}; --from tracker needs full")
    if level != "full":
        print(
            f"{config.run} was recorded {level}: its frames are JPEG, results may differ a little"
        )
    new.mkdir(parents=True, exist_ok=True)
    write_config(parameters, new / "config.toml")
    save_calibration(new / "calibration.yaml", folder.rig())
    service = ServiceConfig(run_dir=new, recording=config.recording, lockstep=True)
    _replay(folder, parameters, service, config.from_)
    print(f"Replayed to {new}; compare: suturetrack compare {config.run} {new}")


def changed(parameters: Parameters, changes: Iterable[str]) -> Parameters:
    """The parameters after `key.key=value` changes; raises InputError for what there is not."""
    plain = msgspec.to_builtins(parameters, enc_hook=str)
    for change in changes:
        key, equals, value = change.partition("=")
        if not equals:
            raise InputError(f"--set {change}: use KEY=VALUE")
        *path, name = key.strip().split(".")
        _assign(plain, parameters, path, name, _parsed(value), key)
    return _converted(plain, "--set")


def _assign(
    plain: dict[str, Any], like: Any, path: list[str], name: str, value: Any, key: str
) -> None:
    for step in path:
        like, plain = getattr(like, step, None), plain.get(step, {})
    known = [f.name for f in fields(like)] if is_dataclass(like) else []
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"
        raise InputError(f"--set {key}: no such parameter{hint if known else ''}")
    plain[name] = value


def _parsed(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return None if value.strip().lower() == "none" else value.strip()


def _recorded_parameters(run_dir: Path) -> Parameters:
    try:
        plain = tomllib.loads((run_dir / "config.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{run_dir}: config.toml is missing or damaged ({error})") from error
    return _converted(plain, str(run_dir / "config.toml"))


def _converted(plain: dict[str, Any], where: str) -> Parameters:
    try:
        return msgspec.convert(plain, Parameters)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: {error}") from error


def _beside(run_dir: Path) -> Path:
    name = f"{run_dir.resolve().name}-replay-{time.strftime('%Y%m%d-%H%M%S')}"
    return run_dir.resolve().parent / name


def _replay(folder: RunFolder, parameters: Parameters, config: ServiceConfig, first: str) -> None:
    seed, hub = parameters.seed, Hub()
    track_config = TrackerConfig(config, seed, parameters.tracking, parameters.initialization)
    bodies = {"tracker": lambda service: tracker.run(service, track_config)}
    if first == "segmenter":
        segment_config = SegmenterConfig(config, seed, parameters.segmentation)
        bodies["segmenter"] = lambda service: segmenter.run(service, segment_config)
    name = {"segmenter": "source", "tracker": "segmenter"}[first]
    feeder = Service(name, config, Bus(hub.connect(), config.rig, name))
    with feeder, _Threads(hub, config, bodies) as threads:
        _feed(feeder, threads, folder, parameters)


def _feed(service: Service, threads: _Threads, folder: RunFolder, parameters: Parameters) -> None:
    """Publishes what the process of this name published when the run was recorded."""
    bus, rig = service.bus, folder.rig()
    steps = bus.every(topics.STEP)
    bus.answer(topics.CALIBRATION, lambda _: rig)
    recorder = service.record(rig, parameters)
    service.ready()
    for process in threads.names:
        threads.wait_until(partial(bus.wait_for_alive, process, 0.1), _READY_S)
    truths = _by_frame(folder.truths())
    is_source = service.name == "source"
    recorded: Iterable[StereoFrame | RidgeField] = folder.frames() if is_source else folder.fields()
    for old in track(recorded, "Replaying", transient=True):
        message = replace(old, stamp=replace(old.stamp, released_ns=time.time_ns()))
        for truth in truths[message.stamp.frame]:
            recorder.truth(replace(truth, stamp=message.stamp))
        if isinstance(message, StereoFrame):
            bus.publish(topics.FRAME, message)
            recorder.frame(message, service.finished(message.stamp))
        else:
            bus.publish(topics.FIELD, message)
            recorder.field(message, service.finished(message.stamp))
        threads.wait_until(partial(_is_done, steps, message.stamp.frame), _STEP_S)


class _Threads:
    """The processes that work anew, as threads around one hub."""

    def __init__(
        self, hub: Hub, config: ServiceConfig, bodies: dict[str, Callable[[Service], None]]
    ) -> None:
        self._services = {
            name: Service(name, config, Bus(hub.connect(), config.rig, name)) for name in bodies
        }
        self._threads = [
            threading.Thread(target=self._run, args=(name, body), name=name, daemon=True)
            for name, body in bodies.items()
        ]
        self._errors: list[BaseException] = []

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for service in self._services.values():
            service.bus.stop.set()
        for thread in self._threads:
            thread.join()

    @property
    def names(self) -> list[str]:
        """Of the processes."""
        return list(self._services)

    def wait_until(self, condition: Callable[[], bool], seconds: float) -> None:
        """Waits; raises what a process raised, or InputError when it takes too long."""
        deadline = time.monotonic() + seconds
        while not condition():
            if self._errors:
                raise self._errors[0]
            if time.monotonic() > deadline:
                raise InputError(f"replay: a step took longer than {seconds:g} s")

    def _run(self, name: str, body: Callable[[Service], None]) -> None:
        service = self._services[name]
        try:
            with service:
                body(service)
        except Stopped:
            pass
        except BaseException as error:
            self._errors.append(error)


def _is_done(steps: Reader[Stamp], frame: int) -> bool:
    step = steps.get(0.1)
    return step is not None and step.frame >= frame


def _by_frame(truths: list[Truth]) -> dict[int, list[Truth]]:
    found = defaultdict[int, list[Truth]](list)
    for truth in truths:
        found[truth.stamp.frame].append(truth)
    return found

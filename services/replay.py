"""`suturetrack replay`: what was recorded goes through today's code once more, into a new run."""

from __future__ import annotations

import difflib
import sys
import threading
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import msgspec
import tyro
from rich.progress import track

from services import segmenter, topics, tracker
from services.bus import Bus, NoAnswer
from services.memory_transport import Hub
from services.messages import Forget
from services.output import begin_run, command
from services.recording import Recorder
from services.run_folder import RunFolder
from services.segmenter import SegmenterConfig
from services.service import Service, ServiceConfig, Stopped
from services.tracker import TrackerConfig
from services.writer import Request
from suturetrack.initialization import InitializationConfig
from suturetrack.segmentation import SegmentationConfig
from suturetrack.tracking import TrackingConfig
from suturetrack.types import InputError, RidgeField, Stamp, StereoFrame, ThreadState, Truth

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
        InputError: the run cannot be read or lacks what is needed, a parameter is wrong, the new run
            cannot be written, or a process failed, as for a seed on no thread.
    """
    folder = RunFolder(config.run)
    for problem in folder.problems:
        print(f"replay: {problem}", file=sys.stderr)
    parameters = changed(_recorded_parameters(config.run), config.set)
    new = config.run_dir or _beside(config.run)
    level = next((about["level"] for about in folder.about().values()), None)
    if level is None:
        raise InputError(f"{config.run}: no recording tells at which level it was made")
    if config.from_ == "tracker" and level != "full":
        raise InputError(f"{config.run}: recorded {level}; --from tracker needs full")
    _check_material(folder, config)
    begin_run(new, parameters, folder.rig())
    if level != "full":
        print(
            f"{config.run} was recorded {level}: its frames are JPEG, results may differ a little"
        )
    service = ServiceConfig(run_dir=new, recording=config.recording, lockstep=True)
    _replay(folder, parameters, service, config.from_)
    print(f"Replayed to {new}; compare: {command('compare', config.run, new)}")


def _check_material(folder: RunFolder, config: ReplayConfig) -> None:
    from_segmenter = config.from_ == "segmenter"
    material = folder.frames() if from_segmenter else folder.fields()
    if next(iter(material), None) is None:
        what, whose = ("frames", "source") if from_segmenter else ("fields", "segmenter")
        raise InputError(
            f"{config.run}: no {what} that could be replayed; the recording of the {whose} is "
            "missing or empty"
        )


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
        raise InputError(f"{where}: {error.__cause__ or error}") from error


def _beside(run_dir: Path) -> Path:
    name = f"{run_dir.resolve().name}-replay-{time.strftime('%Y%m%d-%H%M%S')}"
    return run_dir.resolve().parent / name


def _replay(folder: RunFolder, parameters: Parameters, config: ServiceConfig, first: str) -> None:
    """Plays what the processes before `first` published to those that work anew, one by one."""
    seed, rig = parameters.seed, folder.rig()
    track_config = TrackerConfig(config, seed, parameters.tracking, parameters.initialization)
    segment_config = SegmenterConfig(config, seed, parameters.segmentation)
    tracking = _Worker(_TRACKER, folder, config, lambda service: tracker.run(service, track_config))
    segmenting = _Worker(
        _SEGMENTER, folder, config, lambda service: segmenter.run(service, segment_config)
    )
    workers = {"segmenter": (segmenting, tracking), "tracker": (tracking,)}[first]
    recorded: Iterator[Any] = folder.frames() if first == "segmenter" else folder.fields()
    played = {"segmenter": "source", "tracker": "segmenter"}[first]
    with (
        ExitStack() as stack,
        Recorder(config.run_dir, played, config.recording, rig, parameters) as recorder,
    ):
        for worker in workers:
            stack.enter_context(worker)
        truths = _by_frame(folder.truths())
        for message in track(recorded, "Replaying", transient=True):
            stamp = replace(message.stamp, released_ns=time.time_ns())
            result: Any = replace(message, stamp=stamp)
            _record(recorder, result, [replace(t, stamp=stamp) for t in truths[stamp.frame]])
            for worker in workers:
                result = result and worker.step(result)
            for state in tracking.states():
                segmenting.publish(topics.STATE, state)
    left_out = sum(worker.left_out for worker in workers)
    if left_out:
        print(f"{left_out} frames were passed over, as they were in {folder.path}")


def _record(recorder: Recorder, message: StereoFrame | RidgeField, truths: list[Truth]) -> None:
    if isinstance(message, StereoFrame):
        recorder.frame(message)
    else:
        recorder.field(message)
    for truth in truths:
        recorder.truth(truth)


@dataclass(frozen=True)
class _Part:
    """A process of the dataflow, from outside."""

    name: str
    neighbour: str
    """The process without which it does not start."""
    takes: topics.Topic[Any]
    gives: topics.Topic[Any]


_SEGMENTER = _Part("segmenter", "tracker", topics.FRAME, topics.FIELD)
_TRACKER = _Part("tracker", "segmenter", topics.FIELD, topics.STEP)


class _Worker:
    """A process that works anew, as a thread around a hub of its own; the others are played to it.

    It is given the frames that it worked on when the run was recorded, and each request at the
    frame at which it took effect then.
    """

    def __init__(
        self,
        part: _Part,
        folder: RunFolder,
        config: ServiceConfig,
        body: Callable[[Service], None],
    ) -> None:
        hub = Hub()
        self.left_out = 0
        self._part, self._body = part, body
        self._handled, self._requests = folder.handled(part.name), folder.requests(part.name)
        self._bus = Bus(hub.connect(), config.rig, part.neighbour)
        rig = folder.rig()
        self._bus.answer(topics.CALIBRATION, lambda _: rig)
        self._results = self._bus.every(part.gives)
        self._states = self._bus.every(topics.STATE)
        self._service = Service(part.name, config, Bus(hub.connect(), config.rig, part.name))
        self._thread = threading.Thread(target=self._run, name=part.name, daemon=True)
        self._error: BaseException | None = None

    def __enter__(self) -> Self:
        self._bus.declare_alive()
        self._thread.start()
        self._wait_for(lambda: self._bus.wait_for_alive(self._part.name, 0.1), _READY_S)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._service.bus.stop.set()
        self._thread.join()
        self._bus.close()
        if kind is None and self._error is not None:
            raise self._error

    def step(self, message: Any) -> Any:
        """What the process makes of a message; None for a frame that it never worked on."""
        frame = message.stamp.frame
        if self._handled and frame not in self._handled:
            self.left_out += 1
            return None
        while self._requests and self._requests[0][0] <= frame:
            self._give(self._requests.pop(0)[1])
        self.publish(self._part.takes, message)
        return self._wait_for(lambda: self._result(frame), _STEP_S)

    def states(self) -> Iterator[ThreadState]:
        """The states that have come since."""
        return iter(lambda: self._states.get(0), None)

    def publish(self, topic: topics.Topic[Any], message: Any) -> None:
        """Lets the process hear something, if it is there."""
        self._bus.publish(topic, message)

    def _give(self, request: Request) -> None:
        # A question has arrived when this returns; what comes of it is in the new recording.
        with suppress(NoAnswer):
            if self._part is _SEGMENTER:
                self.publish(
                    topics.DROPPED if isinstance(request, Forget) else topics.SEEDING, request
                )
            elif isinstance(request, Forget):
                self._bus.ask(topics.FORGET, request, timeout=0)
            else:
                self._bus.ask(topics.SEED, request, timeout=0)

    def _result(self, frame: int) -> Any:
        result = self._results.get(0.1)
        stamp = result if isinstance(result, Stamp) or result is None else result.stamp
        return result if stamp is not None and stamp.frame >= frame else None

    def _wait_for(self, answer: Callable[[], Any], seconds: float) -> Any:
        """Waits; raises what the process raised, or InputError when it takes too long."""
        deadline = time.monotonic() + seconds
        while not (result := answer()):
            if self._error is not None:
                raise self._error
            if time.monotonic() > deadline:
                raise InputError(f"replay: the {self._part.name} took longer than {seconds:g} s")
        return result

    def _run(self) -> None:
        try:
            with self._service:
                self._body(self._service)
        except Stopped:
            pass
        except BaseException as error:
            self._error = error


def _by_frame(truths: list[Truth]) -> dict[int, list[Truth]]:
    found = defaultdict[int, list[Truth]](list)
    for truth in truths:
        found[truth.stamp.frame].append(truth)
    return found

"""What every process shares: parameters, signals, health, recording, closing, exit status."""

from __future__ import annotations

import _thread
import fcntl
import gc
import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Literal, Self

import psutil

from services import topics, wire
from services.bus import Bus, NoAnswer
from services.checks import check_rig
from services.messages import Health
from services.meter import Meter
from services.watchdog import Watchdog
from services.zenoh_transport import ZenohTransport, load_config, local_config
from suturetrack import kernels
from suturetrack.camera import StereoRig
from suturetrack.types import InputError, Stamp

if TYPE_CHECKING:
    from services.recording import Recorder

HEARTBEAT_S = 1.0
_GRACE_S = 1.2
"""From the wish to stop until a step that takes too long is interrupted."""
_COMPLAINT_INTERVAL_S = 1.0
_NOTICE_S = 2.0
"""After this time a process that waits says so in its log."""
_CALIBRATION_S = 0.2
"""How long a source may take to tell its calibration once more."""
_SHARING = 8
"""Who died so often sends without shared memory: its readers keep that of everyone who died, up to 40 MB
each at 640x480, until they end themselves (eclipse-zenoh/zenoh, issue 2787)."""

log = logging.getLogger("suturetrack")


class Stopped(Exception):
    """The process was asked to stop while it waited for something that it needs."""


@dataclass(frozen=True)
class SharedConfig:
    """What all processes of a rig are told."""

    rig: str = "rig"
    """Name of the rig; keeps several apart."""
    zenoh: Path | None = None
    """A Zenoh configuration file; without it, processes of this user on this machine find one another
    and nobody else does."""
    run_dir: Path | None = None
    """Folder to record into. Without it a run makes one in `recordings`, and a process that is started by
    itself records nothing."""
    recording: Literal["light", "full"] = "light"
    """light: JPEG images, states and energies; full: lossless images and the fields as numbers too."""
    lockstep: bool = False
    """Every frame, in order, the next one only when the tracker is done with this one."""


@dataclass(frozen=True)
class ServiceConfig(SharedConfig):
    """What one process of a rig is told."""

    parent: int | None = None
    """Process id of the launcher: end when it has gone."""
    resume: int = 0
    """How many processes of this name died before this one: from 1 on, it takes up the threads or the
    count of frames where the last one left them."""


class Service:
    """One running process, as its body sees it."""

    def __init__(self, name: str, config: ServiceConfig, bus: Bus):
        self.name = name
        self.config = config
        self.bus = bus
        self.meter = Meter()
        self.recorder: Recorder | None = None
        self.warning = ""
        """What is wrong at present, for the health; empty when nothing is."""
        self.awaits = ""
        """Without what it cannot go on at present, for the health; empty when it can."""
        self._ready = False
        self._rig: StereoRig | None = None
        self.fault = ""
        """Why it cannot go on at all, in words; empty when it can."""
        self._unrecorded: deque[Health] = deque(maxlen=8)
        self._complaints: deque[str] = deque(maxlen=8)
        """Those from before the recording."""
        self._last_complaint = float("-inf")
        self._heartbeat = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        bus.complain = self.complain

    def calibrated_rig(self) -> StereoRig:
        """The rig as the source tells it, as soon as there is a source; raises Stopped.

        A source that comes back with another calibration ends the process.
        """
        with self.waiting("source"):
            rig = self.bus.ask_until_answered(topics.CALIBRATION, None)
        if rig is None:
            raise Stopped
        self._rig = rig
        return rig

    @contextmanager
    def waiting(self, process: str) -> Iterator[None]:
        """Says which process this one waits for, so that nobody takes it for hung."""
        self.awaits = process
        notice = threading.Timer(_NOTICE_S, log.info, ("waits for the %s", process))
        notice.daemon = True
        notice.start()
        try:
            yield
        finally:
            notice.cancel()
        self.awaits = ""

    def record(self, rig: StereoRig, config: object) -> Recorder:
        """Opens the recording; it is closed with the service."""
        from services.recording import Recorder  # late, for those that record nothing

        run_dir, level = self.config.run_dir, self.config.recording
        patient = self.config.lockstep
        self.recorder = Recorder(run_dir, self.name, level, rig, config, patient=patient)
        while self._complaints:
            self.recorder.log(self._complaints.popleft(), "WARN")
        return self.recorder

    def ready(self) -> None:
        """Tells everyone that the process is ready."""
        self._ready = True
        self.bus.declare_alive()
        log.info("ready")

    def finished(self, stamp: Stamp) -> int:
        """Counts a frame whose result has just been published; the time now, ns."""
        now_ns = time.time_ns()
        self.meter.count(stamp, now_ns)
        self._record_health()
        return now_ns

    def complain(self, text: str) -> None:
        """Logs and records a warning, at most one a second; those in between are counted in the health."""
        now = time.monotonic()
        if now - self._last_complaint >= _COMPLAINT_INTERVAL_S:
            self._last_complaint = now
            if self.recorder is None:
                self._complaints.append(text)
            else:
                self.recorder.log(text, "WARN")
            log.warning("%s", text)

    def health(self) -> Health:
        """The heartbeat as of now; begins a new window of its figures."""
        window, whole = self.meter.window(), self.meter.whole()
        waits = self.awaits and f"waits for the {self.awaits}"
        return Health(
            process=self.name,
            time_ns=time.time_ns(),
            stamp=self.meter.last,
            rate_hz=window.rate_hz,
            latency=window.latency,
            run_rate_hz=whole.rate_hz,
            run_latency=whole.latency,
            frames=whole.frames,
            dropped=self.bus.dropped + self.meter.skipped,
            refused=self.bus.refused,
            memory_mb=psutil.Process().memory_info().rss / 1e6,
            warning=self.warning or waits or (self.recorder and self.recorder.problem) or "",
            restarts=self.config.resume,
            ready=self._ready,
            awaits=self.awaits,
        )

    def __enter__(self) -> Self:
        self._heartbeat.start()
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self.bus.stop.set()
        self._heartbeat.join()
        last = self.health()
        self.bus.publish(topics.HEALTH, last)
        self._unrecorded.append(last)
        self._record_health()
        if self.recorder is not None:
            if error is not None and not isinstance(error, Stopped):
                self.recorder.log(f"{type(error).__name__}: {error}", "ERROR")
            self.recorder.close()
        self.bus.close()

    def _record_health(self) -> None:
        while self.recorder is not None and self._unrecorded:
            self.recorder.health(self._unrecorded.popleft())

    def _beat(self) -> None:
        watchdog = Watchdog()
        while not self.bus.stop.wait(HEARTBEAT_S):
            health = self.health()
            watchdog.feed(health, work_waits=self.bus.newest_waits)
            self.bus.publish(topics.HEALTH, health)
            if health.ready:
                self._unrecorded.append(health)
            if self._rig is not None and self._is_calibrated_anew(self._rig):
                self.fault = "the source has another calibration now; start this process again"
                self.bus.stop.set()

    def _is_calibrated_anew(self, rig: StereoRig) -> bool:
        """Whether the source, which may be another one by now, tells of other cameras than these."""
        try:
            now = self.bus.ask(topics.CALIBRATION, None, _CALIBRATION_S)
        except NoAnswer:
            return False
        return wire.encode(now) != wire.encode(rig)


@contextmanager
def compiling() -> Iterator[None]:
    """Has one process of this machine at a time compile kernels, or load them.

    Processes that fill numba's cache side by side each do all the work, and some have died of it.
    """
    folder = os.open(Path(kernels.__file__).parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def run(name: str, config: ServiceConfig, body: Callable[[Service], None]) -> None:
    """Runs a process until its body ends, or until SIGINT or SIGTERM.

    Raises:
        InputError: something that the user gave is at fault.
    """
    check_rig(config.rig)
    with suppress(OSError):
        # What `ps` and `top` show.
        Path("/proc/self/comm").write_text(name)
    zenoh = local_config(config.rig, name) if config.zenoh is None else load_config(config.zenoh)
    shares = config.resume < _SHARING
    bus = Bus(ZenohTransport(zenoh, patient=config.lockstep, shares=shares), config.rig, name)
    try:
        with Service(name, config, bus) as service, _stopped_by_signals(bus):
            if config.parent is not None:
                _stop_with(config.parent, bus)
            # To look through all that is loaded by now, and stays, would take a tenth of a second each time.
            gc.collect()
            gc.freeze()
            body(service)
    except Stopped:
        log.info("stopped")
    if service.fault:
        raise InputError(service.fault)


def _stop_with(parent: int, bus: Bus) -> None:
    """Stops the process when its parent has gone without a word."""

    def watch() -> None:
        while os.getppid() == parent:
            if bus.stop.wait(HEARTBEAT_S / 2):
                return
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def _stopped_by_signals(bus: Bus) -> Iterator[None]:
    """SIGINT and SIGTERM end the loops; a step that goes on for too long is interrupted."""
    ended, overdue = threading.Event(), threading.Event()

    def stop() -> None:
        bus.stop.set()
        if not ended.wait(_GRACE_S):
            overdue.set()
            _thread.interrupt_main()

    def handler(number: int, frame: FrameType | None) -> None:
        del number, frame
        if overdue.is_set():
            raise KeyboardInterrupt
        # The interrupted loop may hold the lock that `stop` needs.
        threading.Thread(target=stop, daemon=True).start()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
    try:
        yield
    finally:
        ended.set()

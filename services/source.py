"""The process that releases stereo frames: paced by their own rate, or lock-step."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from services import topics
from services.bus import Reader
from services.service import Service, ServiceConfig
from services.sources import Footage, InputConfig, open_input
from services.sources.exposure import ExposureWatch
from services.sources.footage import Exposure, Stalled
from services.sources.interlace import CombWatch
from services.wire import scaled
from suturetrack.tracking.tracker import FORGOTTEN
from suturetrack.types import InputError, Stamp, Status, StereoFrame, ThreadState

_LONGEST_STEP_S = 60.0
"""Lock-step: how long the others may take for one frame."""
_BUFFERED = 4
"""How many frames may be late before some are skipped, as in the buffer of a camera's driver."""
_KEEPER_S = 2.0
"""After a death: how long to wait for the process that knows where to go on."""
_ROUNDED_S = 0.5
"""By how much a video may end before the time that its container tells, which is also that of its sound."""
_LAST_STEP_S = 2.0
"""In real time: how long the last frame may take to go through."""


@dataclass(frozen=True)
class SourceConfig:
    """Releases stereo frames from a recording, a camera or the synthetic bench top."""

    input: Annotated[InputConfig, tyro.conf.arg(name="")]
    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)


def run(service: Service, config: SourceConfig) -> None:
    """Releases all frames, and ends when the last one went through.

    Raises:
        InputError: the source or the calibration is at fault, or a frame took forever in lock-step.
    """
    footage, rig = open_input(config.input)
    if config.service.lockstep and footage.live:
        raise InputError("--lockstep needs recorded input; a camera does not wait")
    bus = service.bus
    steps = bus.newest(topics.STEP)
    bus.answer(topics.CALIBRATION, lambda _: rig)
    recorder = service.record(rig, config)
    wanted, there = config.input.frames, footage.frame_count
    if wanted is not None and there is not None and there < wanted:
        service.complain(
            f"{config.input.source} ends after {there} frames, before --frames {wanted}"
        )
    first = footage.read(0)
    if first is not None:
        bus.make_room(StereoFrame(Stamp(0, 0, 0), first.left, first.right))
    bus.keep(topics.STATE, _is_worth_more)
    bus.keep(topics.SEEDING)
    service.ready()
    if not footage.live:
        with service.waiting("segmenter"):
            if not bus.wait_for_alive("segmenter"):
                return
    watch = _Watch(service)
    period_ns = 0 if config.service.lockstep else round(1e9 / footage.fps)
    pace = _Pace(service, footage, config.input.frames, _left_off(service))
    for index, exposure in pace:
        stamp = Stamp(index, exposure.capture_ns, _released_ns(footage, exposure), period_ns)
        frame = StereoFrame(stamp, exposure.left, exposure.right)
        watch.look(exposure)
        truths = [dataclasses.replace(truth, stamp=stamp) for truth in exposure.truths]
        for truth in truths:
            bus.publish(topics.TRUTH, scaled(truth, rig.metres_per_unit))
        bus.publish(topics.FRAME, frame)
        published_ns = service.finished(stamp)
        recorder.frame(frame, published_ns)
        for truth in truths:
            recorder.truth(truth)
        if config.service.lockstep and not _wait_for(steps, index, _LONGEST_STEP_S):
            if bus.stop.is_set:
                break
            raise InputError(
                f"lock-step: the tracker was not done with frame {index} after "
                f"{_LONGEST_STEP_S:g} s; does every process run with --lockstep?"
            )
    if pace.last is not None:
        _wait_for(steps, pace.last, _LAST_STEP_S)
    footage.close()


class _Watch:
    """Says what is wrong with the images; what lasts is in the health, too."""

    def __init__(self, service: Service):
        self._service = service
        self._combs, self._exposures = CombWatch(), ExposureWatch()
        self._fault = ""

    def look(self, exposure: Exposure) -> None:
        """To be called with every exposure."""
        service, before = self._service, self._fault
        self._fault = self._exposures.fault(exposure.left, exposure.right)
        service.warning = self._fault
        if self._fault and not before:
            service.complain(self._fault)
        if self._combs.sees(exposure.left):
            service.complain("the video seems interlaced: de-interlace it, thin threads comb")
        if exposure.skipped:
            service.meter.skipped += exposure.skipped
            service.complain(f"{exposure.skipped} images left out: no partner within --slop-ms")


class _Pace:
    """Gives every frame when it is due, catches up when late, and skips frames when too late.

    In lock-step nothing is skipped and nothing waits for its time.
    """

    def __init__(
        self, service: Service, footage: Footage, frames: int | None, left_off: Stamp | None
    ):
        self._service, self._footage = service, footage
        self._frames = frames
        self._end = min(frames or math.inf, footage.frame_count or math.inf)
        self._patient = service.config.lockstep or footage.live
        self._index, self._began = _beginning(left_off, footage)
        self.last: int | None = None
        """Number of the last frame given."""

    def __iter__(self) -> _Pace:
        return self

    def __next__(self) -> tuple[int, Exposure]:
        if not self._patient:
            self._skip()
        index = self._index
        if self._service.bus.stop.is_set or (self._frames is not None and index >= self._frames):
            raise StopIteration
        exposure = self._read(index)
        due_in = self._began + index / self._footage.fps - time.monotonic()
        stopped = not self._patient and due_in > 0 and self._service.bus.stop.wait(due_in)
        if exposure is None:
            self._tell_early_end(index)
        if exposure is None or stopped:
            raise StopIteration
        self.last, self._index = index, index + 1
        return index, exposure

    def _read(self, index: int) -> Exposure | None:
        """The frame with that number, whenever a stalled camera gives it; None at the end."""
        while not self._service.bus.stop.is_set:
            try:
                exposure = self._footage.read(index)
            except Stalled as stall:
                self._service.awaits, self._service.warning = "camera", str(stall)
                self._service.complain(str(stall))
            else:
                self._service.awaits = ""
                return exposure
        return None

    def _tell_early_end(self, index: int) -> None:
        """Says where the input ended long before it should, as a file does that was cut off."""
        promised, fps = self._footage.frame_count or 0, self._footage.fps
        if index < promised - _ROUNDED_S * fps:
            self._service.complain(
                f"the input ended before frame {index} of the {promised} that it promises; "
                "the file is cut short"
            )

    def _skip(self) -> None:
        due = int(min((time.monotonic() - self._began) * self._footage.fps, self._end))
        if due > self._index + _BUFFERED:
            self._service.meter.skipped += due - self._index
            self._index = due


def _is_worth_more(state: ThreadState, kept: ThreadState) -> bool:
    """Whether it tells a tracker that is started again where the thread is, or is not any more: dropped,
    or looked for anew."""
    return state.status is not Status.LOST or FORGOTTEN in (*state.events, *kept.events)


def _left_off(service: Service) -> Stamp | None:
    """The last frame that went through before the source died, where there is one to go on from."""
    if not service.config.resume or not service.bus.wait_for_alive(topics.STEP.keeper, _KEEPER_S):
        return None
    return max(service.bus.last(topics.STEP), default=None)


def _beginning(left_off: Stamp | None, footage: Footage) -> tuple[int, float]:
    """The first frame's number, and when frame 0 was due by `time.monotonic`.

    Recorded input goes on as if it had never stopped; a camera counts on.
    """
    now = time.monotonic()
    if left_off is None:
        return 0, now
    if footage.live:
        return left_off.frame + 1, now
    began = now - (time.time_ns() - left_off.released_ns) / 1e9 - left_off.frame / footage.fps
    return max(left_off.frame + 1, math.ceil((now - began) * footage.fps)), began


def _released_ns(footage: Footage, exposure: Exposure) -> int:
    return exposure.capture_ns if footage.live else time.time_ns()


def _wait_for(steps: Reader[Stamp], frame: int, seconds: float) -> bool:
    """Whether the tracker is done with a frame in time."""
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        step = steps.get(left)
        if step is None:
            return False
        if step.frame >= frame:
            return True
    return False

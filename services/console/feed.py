"""Gathers what the page shows, at the page's own pace, and asks what its operator wants to know."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal

import numpy as np

from services import topics
from services.bus import Bus, NoAnswer
from services.client import Client, Refused
from services.console import picture
from services.console.recording import Recording
from services.messages import Health
from services.output import command
from suturetrack.camera import StereoRig
from suturetrack.grasping import GraspPoint
from suturetrack.initialization import InitializationConfig
from suturetrack.snapping import Snap, snap_area, snap_pixel
from suturetrack.types import InputError, RidgeField

_PERIOD_S = 1 / 15
_PATIENCE_S = 0.1
"""How long a frame waits for its states."""
_PULSE_S = 0.25
"""Between two messages while no frames come."""
_FIELD_AGE_S = 0.5
View = Literal["left", "right"]
_CONFIG = InitializationConfig()


class Feed:
    """One moment after another, for all open pages together.

    Nothing is read while nobody looks, and only the newest is: the loop never waits for a page.
    """

    def __init__(self, bus: Bus, recording: Recording):
        self.bus = bus
        self.recording = recording
        self.client = Client(bus)
        self.grasp: tuple[str, GraspPoint] | None = None
        """Whose pose is shown, and where; the same on every page."""
        self.deliver: Callable[[bytes], None] = lambda _: None
        """Takes each moment, packed, from the feed's own thread."""
        self.watched = threading.Event()
        """Set while somebody looks."""
        self.rig: StereoRig | None = None
        self._frames = bus.newest(topics.FRAME, at_leisure=True)
        self._fields = bus.newest(topics.FIELD, at_leisure=True)
        self._healths = bus.every(topics.HEALTH)
        self._health: dict[str, Health] = {}
        self._field: RidgeField | None = None
        self._field_lock = threading.Lock()
        self._thread = threading.Thread(target=self._work, name="feed", daemon=True)

    def start(self) -> None:
        """Begins to deliver."""
        self._thread.start()

    def snap(self, view: View, u: float, v: float) -> dict[str, Any]:
        """Where a click on the raw image of a view would land; raises InputError."""
        rig, field = self._sight()
        right = view == "right"
        pixel = rig.rectify_pixels(np.array([u, v]), right=right)
        found, candidates = snap_pixel(field.right if right else field.left, pixel, _CONFIG)
        shown = {"candidates": picture.rounded(rig.raw_pixels(candidates, right=right))}
        return {**shown, **self._snapped(found, right=right)}

    def snap_box(self, view: View, corners: list[list[float]]) -> dict[str, Any]:
        """The clearest ridge within a box of the raw image of a view; raises InputError."""
        rig, field = self._sight()
        right = view == "right"
        box = rig.rectify_pixels(np.array(corners, float), right=right)
        found = snap_area(field.right if right else field.left, box, _CONFIG)
        return {"candidates": [], **self._snapped(found, right=right)}

    def seed(self, thread: str, view: View, u: float, v: float) -> dict[str, Any]:
        """Seeds, waits for what is found, and tells it in words."""
        try:
            found = self.client.seed((u, v), view=view, thread=thread)
        except Refused as refusal:
            return {"accepted": False, "text": str(refusal), "candidates": refusal.candidates}
        except InputError as error:
            return {"accepted": False, "text": str(error), "candidates": []}
        return {"accepted": True, "text": found.reason, "candidates": []}

    def forget(self, thread: str) -> dict[str, Any]:
        """Drops a thread; raises InputError."""
        known = self.client.forget(thread)
        text = f"Thread {thread} is followed no more." if known else f"There is no thread {thread}."
        return {"accepted": known, "text": text}

    def record(self, *, on: bool) -> dict[str, Any]:
        """Starts or completes a recording; raises InputError."""
        if on:
            return {"text": f"Recording to {self.recording.start()}."}
        return {"text": f"Recorded. Open it with: {command('view', self.recording.stop())}"}

    def _sight(self) -> tuple[StereoRig, RidgeField]:
        with self._field_lock:
            self._field = self._fields.get(0) or self._field
            field = self._field or self._fields.get(_FIELD_AGE_S)
            self._field = field
        if self.rig is None or field is None:
            raise InputError("no images come; is the system running?")
        return self.rig, field

    def _snapped(self, found: Snap | None, *, right: bool) -> dict[str, Any]:
        if found is None or self.rig is None:
            return {"pixel": None, "segment": []}
        pixels = self.rig.raw_pixels(np.vstack([found.pixel, found.segment]), right=right)
        first, *segment = picture.rounded(pixels)
        return {"pixel": first, "segment": segment[::2]}

    def _work(self) -> None:
        while not self.bus.stop.is_set:
            if not self.watched.wait(_PULSE_S):
                continue
            began = time.monotonic()
            frame = self._frames.get(_PULSE_S)
            header: dict[str, Any] = {"rig": self.bus.rig, "frame": None}
            images: tuple[bytes, ...] = ()
            if frame is not None and self.rig is not None:
                images = picture.jpegs(frame)
                height, width = frame.left.shape[:2]
                header |= {"frame": frame.stamp.frame, "size": [width, height]}
                self._wait_for_states(frame.stamp.frame)
            self.deliver(picture.pack(header | self._moment(), images))
            if frame is None or self.rig is None:
                # A source that is started again may have another calibration.
                with suppress(NoAnswer):
                    self.rig = self.bus.ask(topics.CALIBRATION, None, timeout=1.0)
            self.bus.stop.wait(max(0.0, began + _PERIOD_S - time.monotonic()))

    def _wait_for_states(self, frame: int) -> None:
        """The curves belong on the image that they were found in."""
        deadline = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline:
            newest = [self.client.latest(name) for name in self.client.threads]
            if all(s is None or s.state.stamp.frame >= frame or not s.live for s in newest):
                return
            self.bus.stop.wait(0.004)

    def _moment(self) -> dict[str, Any]:
        while (health := self._healths.get(0)) is not None:
            self._health[health.process] = health
        tracker = self._health.get("tracker")
        rig = self.rig
        if rig is None:
            return {"waiting": True, "threads": [], "grasp": None}
        seen = {name: self.client.latest(name) for name in self.client.threads}
        judged = {name: picture.Judged.of(s) for name, s in seen.items() if s is not None}
        mark = None
        if self.grasp is not None:
            name, where = self.grasp
            mark = picture.marker(judged.get(name), where, rig)
        warnings = [f"{h.process}: {h.warning}" for h in self._health.values() if h.warning]
        return {
            "waiting": False,
            "threads": [picture.thread(one, rig) for one in judged.values()],
            "grasp": mark,
            "recording": str(self.recording.folder or ""),
            "missed": self.client.missed,
            "rate_hz": tracker.rate_hz if tracker is not None else None,
            "latency_ms": tracker.latency.p50_ms if tracker is not None else None,
            "warnings": [*filter(None, [self.recording.problem]), *warnings],
        }

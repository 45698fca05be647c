"""The files of one process's recording: parts, flushing, and what can go wrong with a disk.

Rerun may wait for a broken disk without end, so only `Recorder`'s own thread calls what is here.
"""

from __future__ import annotations

import logging
import platform
import time
import uuid
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import rerun as rr

from services import drawing
from services.drawing import Entry, Level
from services.writer import Writer
from suturetrack.camera import StereoRig
from suturetrack.types import InputError

APPLICATION = "suturetrack"
RECORDING_VERSION = 2
"""Grows when an older reader could misread a recording."""

_log = logging.getLogger(__name__)
_LONGEST_FLUSH_SECONDS = 4.0


class RunFile(Writer):
    """Writes `<run_dir>/<process>.rrd`.

    A recording that cannot go on (full disk, removed folder) is closed with a loud message and a
    `problem`. Long runs roll over into parts `<process>.1.rrd`, ...; so does a process that was
    started again.
    """

    problem: str | None = None
    """Why nothing is recorded any more."""

    def __init__(
        self,
        run_dir: Path,
        process: str,
        level: Level,
        rig: StereoRig,
        config: object,
        flush_seconds: float,
        part_bytes: int,
    ) -> None:
        """Opens the file and writes what does not change: cameras, versions and parameters.

        Args:
            run_dir: made when missing.
            process: name of the process.
            level: "light" (JPEG) or "full" (lossless images and fields).
            rig: the calibrated cameras.
            config: the process's parameters, a dataclass.
            flush_seconds: what a killed process loses at most.
            part_bytes: size at which the next part begins.

        Raises:
            InputError: the file cannot be made.
        """
        # One name for all processes of the run makes their files one recording.
        run = uuid.uuid5(uuid.NAMESPACE_URL, str(run_dir.resolve()))
        stream = rr.RecordingStream(APPLICATION, recording_id=str(run))
        super().__init__(stream, process, level, rig)
        self._config, self._run_dir = config, run_dir
        self._flush_seconds, self._part_bytes = flush_seconds, part_bytes
        self._flushed = time.monotonic()
        try:
            run_dir.mkdir(parents=True, exist_ok=True)
            self._open_part(stream)
        except (OSError, RuntimeError) as error:
            raise InputError(f"recording: cannot write to {run_dir}: {error}") from error

    def close(self) -> None:
        """Completes the file; nothing is recorded afterwards."""
        if self.stream is not None:
            if self.problem is None:
                self.columns.send()
            self.stream.disconnect()
        self.stream = None

    def pass_on(self) -> None:
        """When it is time: sends to the disk what is waiting, begins a new part, looks for trouble."""
        if self.stream is None or time.monotonic() - self._flushed < self._flush_seconds:
            return
        self._flushed = time.monotonic()
        trouble = self._care_for(self.stream)
        if trouble:
            self.problem = f"recording stopped: {trouble} ({self._path})"
            _log.error("%s; everything else goes on", self.problem)
            self.close()

    def _care_for(self, stream: rr.RecordingStream) -> str | None:
        """What is wrong with the file, if anything."""
        try:
            self.columns.send()
            stream.flush(timeout_sec=_LONGEST_FLUSH_SECONDS)
            if self._path.stat().st_size >= self._part_bytes:
                self._open_part(stream)
        except FileNotFoundError:
            return "the file or its folder was removed"
        except (OSError, RuntimeError):
            return "the disk is full or too slow"
        return None

    def _open_part(self, stream: rr.RecordingStream) -> None:
        """Directs the stream to the next free file; every part explains itself."""
        name, number = self._run_dir / f"{self.process}.rrd", 0
        while name.exists():
            number += 1
            name = self._run_dir / f"{self.process}.{number}.rrd"
        self._path = name
        # The index that a footer is would grow in memory, by 20 MB a minute of a thread.
        sink = rr.FileSink(str(name), write_footer=False)
        stream.set_sinks(sink, default_blueprint=self.layout())
        stream.send_recording_name(self._run_dir.name)
        self.describe()
        self.write_static(self._about())

    def _about(self) -> list[Entry]:
        about: dict[str, Any] = {
            "recording_version": RECORDING_VERSION,
            "level": self.level,
            "started_ns": time.time_ns(),
            "machine": f"{platform.node()}, {platform.machine()}, {platform.system()}",
            "python": platform.python_version(),
            **{p: version(p) for p in ("suturetrack", "numpy", "opencv-python-headless")},
        }
        settings = {} if self._config is None else msgspec.to_builtins(self._config, enc_hook=str)
        text = msgspec.yaml.encode(settings).decode()
        return [
            (f"/run/{self.process}", drawing.values("About", about)),
            (f"/run/{self.process}/parameters", rr.TextDocument(text)),
        ]

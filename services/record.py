"""The process that records a running system from outside: started and stopped as one likes."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from services.live import LiveView
from services.output import check_holds_no_run, command, fresh_folder
from services.recording import Recorder
from services.service import Service, ServiceConfig
from services.topics import PROCESSES
from suturetrack.calibration import save_calibration
from suturetrack.types import InputError


@dataclass(frozen=True)
class RecordConfig:
    """Records what the processes of a rig publish, until Ctrl-C, into a new folder of recordings/."""

    service: Annotated[ServiceConfig, tyro.conf.arg(name="")] = field(default_factory=ServiceConfig)


def run(service: Service, config: RecordConfig) -> None:
    """Records until stopped; raises InputError when the folder cannot be used, or not any more."""
    folder = config.service.run_dir or fresh_folder("live")
    check_holds_no_run(folder)
    rig = service.calibrated_rig()
    with ExitStack() as stack:
        level = config.service.recording
        recorders = [
            stack.enter_context(Recorder(folder, name, level, rig, config, patient=False))
            for name in PROCESSES
        ]
        save_calibration(folder / "calibration.yaml", rig)
        view = LiveView(service.bus, rig, recorders)
        service.ready()
        while not service.bus.stop.is_set:
            view.step()
            service.warning = next((r.problem for r in recorders if r.problem), "")
            if any(recorder.fault for recorder in recorders):
                raise InputError(service.warning)
    print(f"Open it with: {command('view', folder)}")

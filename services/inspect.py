"""`suturetrack inspect`: what a run was like, in tables or as one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from services.output import opened
from services.page import page
from services.report import show
from services.run_folder import RunFolder
from services.summary import summarize
from services.tables import report_console


@dataclass(frozen=True)
class InspectConfig:
    """Tells rates, latencies, drops, losses, lengths, energies and errors of a run."""

    run_dir: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    html: Path | None = None
    """Also writes a page that needs no other file: the tables, plots, and pictures of the
    initialisation, the worst frame and the losses."""


def run(config: InspectConfig) -> None:
    """Prints the tables.

    Raises:
        InputError: the folder holds no readable recording, or the page cannot be written.
    """
    folder = RunFolder(config.run_dir)
    summary = summarize(folder)
    show(summary, report_console())
    if config.html is not None:
        with opened(config.html) as file:
            file.write(page(folder, summary))

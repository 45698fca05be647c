"""`suturetrack seed`: tells a running tracker where a thread is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from services.client import Refused, connect
from suturetrack.types import InputError


@dataclass(frozen=True)
class SeedConfig:
    """Tells a running tracker where a thread is, and waits for what it finds."""

    pixel: Annotated[tuple[float, float] | None, tyro.conf.Positional] = None
    """U V of a pixel on the thread in a raw image."""
    view: Literal["left", "right"] = "left"
    """In which image the pixel, the area or the laser's spot is."""
    point: tuple[float, float, float] | None = None
    """X Y Z of a point on the thread instead, in metres, in the rectified left camera."""
    area: tuple[float, float, float, float] | None = None
    """U V U V of two opposite corners of a box instead: the clearest thread between them."""
    laser: bool = False
    """Instead, the bright spot of a laser in the image."""
    thread: str = "0"
    """Name of the thread; one that has the name already is held until it is found from here."""
    rig: str = "rig"
    """Name of the rig."""
    zenoh: Path | None = None
    """The Zenoh configuration file of the running system, if it has one."""


def run(config: SeedConfig) -> None:
    """Seeds once.

    Raises:
        InputError: not exactly one place, no system runs, or there is no thread at that place.
    """
    with connect(config.rig, config.zenoh, waits=False) as client:
        try:
            found = client.seed(
                config.pixel,
                view=config.view,
                point=config.point,
                area=config.area,
                laser=config.laser,
                thread=config.thread,
            )
        except Refused as refusal:
            raise InputError(str(refusal)) from refusal
    print(f"thread {config.thread}: {found.reason}")

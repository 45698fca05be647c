"""`suturetrack scenes`: pictures of the synthetic bench top."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2

from suturetrack.stage import SCENARIOS, Picture, contact_sheet
from suturetrack.types import InputError


@dataclass(frozen=True)
class ScenesConfig:
    """Writes one picture with a row a scenario, at four moments each, and lists the scenarios."""

    output: Path = Path("scenes.png")
    """The picture to write, .png or .jpg."""
    scenarios: tuple[str, ...] = tuple(SCENARIOS)
    """Scenarios to show."""
    rig: str = "bench"
    """Which rig looks: bench or endoscope."""
    seed: int = 0
    """Which variant of each scene."""
    picture: Picture = field(default_factory=Picture)
    """How the scenes are filmed."""


def run(config: ScenesConfig) -> None:
    """Writes the picture; raises InputError for unknown scenarios and rigs, and unwritable files."""
    sheet = contact_sheet(config.scenarios, config.rig, config.seed, config.picture)
    try:
        written = cv2.imwrite(str(config.output), sheet)
    except cv2.error as error:
        raise InputError(f"{config.output}: the name must end in .png or .jpg") from error
    if not written:
        raise InputError(f"{config.output}: cannot be written")
    for name in config.scenarios:
        print(f"{name:<14} {SCENARIOS[name].about}")
    print(f"Pictures in {config.output}")

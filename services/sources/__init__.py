"""What frames can come from: the bench top, folders of image pairs, videos, cameras."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from services.sources.camera import CameraFootage, is_device
from services.sources.folder import FolderFootage
from services.sources.footage import Footage
from services.sources.loop import LoopFootage
from services.sources.stage import StageFootage
from services.sources.video import VideoFootage
from suturetrack.calibration import load_calibration
from suturetrack.camera import StereoRig
from suturetrack.stage import Picture
from suturetrack.types import InputError

STAGE = "stage:"


@dataclass(frozen=True)
class InputConfig:
    """Where the frames come from."""

    source: str
    """A folder with left/*.png and right/*.png; a side-by-side video; two videos or devices as
    LEFT,RIGHT; a device number or path; stage:NAME for the synthetic bench top."""
    calibration: Path | None = None
    """Calibration of the rig; the bench top knows its own."""
    unit: Literal["m", "mm"] | None = None
    """Unit of the calibration; guessed from the baseline without it."""
    fps: float = 30.0
    """Frames a second of folders and of the bench top; videos know theirs."""
    frames: int | None = None
    """Stop after so many frames."""
    loop: int | None = None
    """Show the first so many frames there and back again from memory, without end; for long tests."""
    scene_seed: int = 0
    """Which variant of the bench top's scene."""
    scene_rig: str = "bench"
    """Which rig looks at the bench top: bench or endoscope."""
    picture: Picture = field(default_factory=Picture)
    """How the bench top is filmed."""


def open_input(config: InputConfig) -> tuple[Footage, StereoRig]:
    """Opens the source and the rig that belongs to it.

    Raises:
        InputError: either is missing, unreadable, or they do not fit each other.
    """
    if not 0 < config.fps <= 1000:
        raise InputError(f"fps {config.fps:g}: use frames per second, above 0 and up to 1000")
    if config.frames is not None and config.frames < 1:
        raise InputError(f"frames {config.frames}: use 1 or more")
    footage, rig = _open(config)
    return (footage if config.loop is None else LoopFootage(footage, config.loop)), rig


def _open(config: InputConfig) -> tuple[Footage, StereoRig]:
    if config.source.startswith(STAGE):
        return _open_stage(config)
    if config.calibration is None:
        raise InputError("--calibration FILE is needed; only stage: sources know their own")
    rig = load_calibration(config.calibration, config.unit)
    footage = _open_footage(config)
    if footage.size != rig.image_size:
        (w, h), (rig_w, rig_h) = footage.size, rig.image_size
        footage.close()
        raise InputError(
            f"source {config.source}: its views are {w}x{h}, but calibration {config.calibration} "
            f"is for {rig_w}x{rig_h}; give the calibration of these images"
        )
    return footage, rig


def _open_stage(config: InputConfig) -> tuple[Footage, StereoRig]:
    name = config.source.removeprefix(STAGE)
    stage = StageFootage(name, config.scene_seed, config.scene_rig, config.fps, config.picture)
    if config.calibration is None:
        return stage, stage.rig
    rig = load_calibration(config.calibration, config.unit)
    if rig.image_size != stage.size:
        raise InputError(f"calibration {config.calibration}: not for {stage.size} px of {name}")
    return stage, rig


def _open_footage(config: InputConfig) -> Footage:
    parts = config.source.split(",")
    if len(parts) > 2:
        raise InputError(f"source {config.source}: at most two files or devices, LEFT,RIGHT")
    if all(is_device(part) for part in parts):
        return CameraFootage(parts)
    if len(parts) == 1 and Path(parts[0]).is_dir():
        return FolderFootage(Path(parts[0]), config.fps)
    return VideoFootage([Path(part) for part in parts])


__all__ = ["Footage", "InputConfig", "open_input"]

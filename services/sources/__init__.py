"""What frames can come from, chosen by what the source's name is.

The bench top, folders of image pairs, videos, cameras, bags, ROS 2 topics: a module for each.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from services.ros2_graph import RosConfig
from services.sources.bag import BagFootage, is_bag
from services.sources.camera import CameraFootage, is_device
from services.sources.folder import FolderFootage
from services.sources.footage import Footage, Stalled
from services.sources.loop import LoopFootage
from services.sources.rig import adapt, check_size, open_rig
from services.sources.ros2 import Ros2Footage
from services.sources.stage import StageFootage
from services.sources.video import VideoFootage
from suturetrack.camera import StereoRig
from suturetrack.stage import Picture
from suturetrack.types import InputError

STAGE = "stage:"
ROS2 = "ros2:"


@dataclass(frozen=True)
class InputConfig:
    """Where the frames come from."""

    source: str
    """A folder with left/*.png and right/*.png; a side-by-side video; two videos or devices as
    LEFT,RIGHT; a device number or path; a ROS bag or MCAP file; ros2:LEFT,RIGHT for two image topics;
    stage:NAME for the synthetic bench top."""
    calibration: Path | None = None
    """Calibration of the rig: an OpenCV file, a Kalibr camchain, a folder with ROS's left.yaml and
    right.yaml, or the two as LEFT,RIGHT. The bench top knows its own, and ROS has camera_info."""
    unit: Literal["m", "mm"] | None = None
    """Unit of the calibration; guessed from the baseline without it."""
    scale: float = 1.0
    """How many times as wide and high the images are as those that were calibrated."""
    rectified: bool = False
    """The images are rectified already, with the projections of this calibration; image_rect topics
    are without saying so."""
    topics: tuple[str, str] | None = None
    """LEFT RIGHT image topics of a bag; found by their names without it."""
    slop_ms: float = 10.0
    """Left and right ROS images are a pair when their stamps lie no further apart."""
    ros: RosConfig = field(default_factory=RosConfig)
    """Where the ROS 2 graph is."""
    fps: float = 30.0
    """Frames a second of folders and of the bench top, and what cameras are asked for; videos and
    the stamps of ROS tell theirs."""
    frames: int | None = None
    """Stop after so many frames."""
    loop: int | None = None
    """Show the first so many frames there and back again from memory, without end; for long tests. 640x480
    takes 1.8 MB a frame."""
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
    if not 0 <= config.slop_ms <= 1000:
        raise InputError(f"slop-ms {config.slop_ms:g}: use milliseconds from 0 to 1000")
    if config.source.startswith(STAGE):
        return _open_stage(config)
    footage = _open_footage(config)
    try:
        return footage, _rig_of(footage, config)
    except InputError:
        footage.close()
        raise


def _rig_of(footage: Footage, config: InputConfig) -> StereoRig:
    ros = footage if isinstance(footage, BagFootage | Ros2Footage) else None
    rectified = config.rectified or (ros is not None and ros.rectified)
    if ros is not None and config.calibration is None:
        rig, name = adapt(ros.rig(config.unit), config.scale, rectified=rectified), "camera_info"
    else:
        rig, name = _given_rig(config, rectified=rectified), f"calibration {config.calibration}"
    check_size(footage.size, rig, f"source {config.source}", name)
    return rig


def _given_rig(config: InputConfig, *, rectified: bool = False) -> StereoRig:
    if config.calibration is None:
        raise InputError("--calibration FILE is needed; only stage: and ROS know their own")
    return open_rig(config.calibration, config.unit, config.scale, rectified=rectified)


def _open_stage(config: InputConfig) -> tuple[Footage, StereoRig]:
    name = config.source.removeprefix(STAGE)
    stage = StageFootage(name, config.scene_seed, config.scene_rig, config.fps, config.picture)
    if config.calibration is None:
        return stage, stage.rig
    rig = _given_rig(config, rectified=config.rectified)
    check_size(stage.size, rig, f"source {config.source}", f"calibration {config.calibration}")
    return stage, rig


def _open_footage(config: InputConfig) -> Footage:
    slop_ns = round(config.slop_ms * 1e6)
    if config.source.startswith(ROS2):
        names = config.source.removeprefix(ROS2).split(",")
        return Ros2Footage(
            names, config.ros, slop_ns, config.fps, wants_rig=config.calibration is None
        )
    if is_bag(Path(config.source)):
        return BagFootage(Path(config.source), config.topics, slop_ns, config.fps)
    size = _given_rig(config).image_size
    parts = config.source.split(",")
    if len(parts) > 2:
        raise InputError(f"source {config.source}: at most two files or devices, LEFT,RIGHT")
    if all(is_device(part) for part in parts):
        return CameraFootage(parts, size, config.fps)
    if len(parts) == 1 and Path(parts[0]).is_dir():
        return FolderFootage(Path(parts[0]), config.fps)
    return VideoFootage([Path(part) for part in parts])


__all__ = ["Footage", "InputConfig", "Stalled", "open_input"]

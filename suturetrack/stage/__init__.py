"""The synthetic bench top: moving threads with exact truth, seen by a stereo camera."""

from suturetrack.stage.appearance import COLOURS, Picture
from suturetrack.stage.background import TEXTURES
from suturetrack.stage.cameras import RIGS
from suturetrack.stage.scenarios import SCENARIOS
from suturetrack.stage.scene import Scene, open_scene
from suturetrack.stage.sheet import contact_sheet

__all__ = [
    "COLOURS",
    "RIGS",
    "SCENARIOS",
    "TEXTURES",
    "Picture",
    "Scene",
    "contact_sheet",
    "open_scene",
]

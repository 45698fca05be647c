"""The synthetic bench top: moving threads with exact truth, seen by a stereo camera."""

from suturetrack.stage.appearance import Picture
from suturetrack.stage.cameras import RIGS
from suturetrack.stage.scenarios import SCENARIOS
from suturetrack.stage.scene import Scene, open_scene

__all__ = ["RIGS", "SCENARIOS", "Picture", "Scene", "open_scene"]

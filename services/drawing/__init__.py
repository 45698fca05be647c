"""What each value looks like in a recording: the entity tree, and the archetypes at each entity.

The functions yield `(entity, archetypes...)` and touch no file. Pictures and overlays are in raw
pixels, points in the calibration's unit, plots in the units that their names carry.
"""

from services.drawing.common import Entry, Level, values
from services.drawing.curves import states, thread_style, truth
from services.drawing.growth import failure, growth
from services.drawing.images import cameras, field, frame, process_style

__all__ = [
    "Entry",
    "Level",
    "cameras",
    "failure",
    "field",
    "frame",
    "growth",
    "process_style",
    "states",
    "thread_style",
    "truth",
    "values",
]

"""What each value looks like in a recording: the entity tree, and the archetypes at each entity.

The functions yield `(entity, archetypes...)` and touch no file. Pictures and overlays are in raw
pixels, points in the calibration's unit, plots in the units that their names carry.
"""

from services.drawing.common import Entry, Level, Row, row, values
from services.drawing.curves import overlay_style, states, thread_style, truth, truth_style
from services.drawing.events import kinds, lane, marks
from services.drawing.growth import cleared, failure, growth, outcome, seed
from services.drawing.images import cameras, field, frame, process_style

__all__ = [
    "Entry",
    "Level",
    "Row",
    "cameras",
    "cleared",
    "failure",
    "field",
    "frame",
    "growth",
    "kinds",
    "lane",
    "marks",
    "outcome",
    "overlay_style",
    "process_style",
    "row",
    "seed",
    "states",
    "thread_style",
    "truth",
    "truth_style",
    "values",
]

"""Section VI and beyond: the curve and a new field give the next curve."""

from suturetrack.tracking.config import TrackingConfig
from suturetrack.tracking.tracker import Tracker, TrackerStep

__all__ = ["Tracker", "TrackerStep", "TrackingConfig"]

"""What a run looks like when it is opened: images, space, plots and log on one screen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

from services.drawing.common import VIEWS, part
from services.topics import PROCESSES
from suturetrack.types import Float64

_IN_DETAIL = ("tangent", "reliability", "velocity")
_EYE = np.array([-0.7, -0.55, -0.75])
"""Where the eye of the view of space is from the thread, in sizes of the thread: beside the cameras,
and so near that the thread fills the view."""


def blueprint(threads: Sequence[str], thread: Float64) -> rrb.Blueprint:
    """The layout for the given threads ("0" when there is none yet).

    `thread` are (n, 3) points around a thread, or where one may be, in the rectified left frame.
    """
    names = [part(thread) for thread in threads] or ["0"]
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Horizontal(
                _scene(names, thread), _plots(names), column_shares=[7, 3], name="Tracking"
            ),
            _curve(names),
            _segmentation(),
            _initialization(names),
            _processes(),
            _parameters(),
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )


def _scene(names: Sequence[str], thread: Float64) -> rrb.Container:
    images = rrb.Horizontal(*(_view(view, "", "/curve", "/truth/**") for view in VIEWS))
    low, high = thread.min(axis=0), thread.max(axis=0)
    middle, size = (low + high) / 2, np.linalg.norm(high - low)
    eye = rrb.EyeControls3D(position=middle + size * _EYE, look_target=middle, eye_up=(0, -1, 0))
    hidden = [f"- /rig/{view}/**" for view in VIEWS]
    hidden += [f"- /rig/thread/{name}/{part}" for name in names for part in _IN_DETAIL]
    shown = [f"+ /rig/{view}/image" for view in VIEWS]
    contents = ["+ /rig/**", *hidden, *shown]
    space = rrb.Spatial3DView(origin="/rig", name="Space", contents=contents, eye_controls=eye)
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    rows = rrb.TextLogRows(filter_by_log_level=["INFO", "WARN", "ERROR", "CRITICAL"])
    log = rrb.TextLogView(origin="/log", name="Log", contents="/log/**", columns=columns, rows=rows)
    return rrb.Vertical(images, rrb.Horizontal(space, log, column_shares=[5, 4]), row_shares=[5, 4])


def _plots(names: Sequence[str]) -> rrb.Container:
    return rrb.Vertical(
        rrb.StateTimelineView(
            origin="/plots", name="Status and events", contents=_each(names, "status", "event")
        ),
        _plot(
            "Energy: left blue, right orange (best -1), ends violet",
            *_each(names, "energy/image", "energy/end", "energy/event/**"),
        ),
        _plot("Length [mm]", *_each(names, "length")),
        _plot(
            "Latency [ms]: source blue, segmenter violet, tracker orange", "/plots/latency_ms/**"
        ),
        row_shares=[3, 5, 5, 4],
    )


def _curve(names: Sequence[str]) -> rrb.Container:
    parts = (*_IN_DETAIL, "control_points")
    contents = [f"/rig/thread/{name}/{part}" for name in names for part in parts]
    return rrb.Horizontal(
        rrb.Spatial3DView(
            origin="/rig", name="Tangents, reliability, motion within 0.1 s", contents=contents
        ),
        rrb.Vertical(
            _plot("Bending (no unit)", *_each(names, "energy/internal")),
            _plot("Control points", *_each(names, "control_points")),
            _plot("Speed [mm/s]: mean turquoise, fastest orange", *_each(names, "speed")),
        ),
        column_shares=[3, 2],
        name="Curve",
    )


def _each(names: Sequence[str], *quantities: str) -> list[str]:
    return [f"/plots/{name}/{quantity}" for name in names for quantity in quantities]


def _initialization(names: Sequence[str]) -> rrb.Container:
    """The last growth over the field in which it happened, and what came of it."""
    views = (_view(view, "/growth/**") for view in VIEWS)
    words = rrb.Vertical(
        *(
            rrb.TextDocumentView(origin=f"/log/initialization/{n}", name=f"Thread {n}")
            for n in names
        )
    )
    return rrb.Horizontal(*views, words, column_shares=[4, 4, 2], name="Initialisation")


def _segmentation() -> rrb.Container:
    views = rrb.Grid(
        *(_view(view, "") for view in VIEWS),
        *(_view(view, "/direction", name=f"{view}, hue is direction") for view in VIEWS),
        grid_columns=2,
    )
    key = rrb.Spatial2DView(origin="/key/direction", name="Key to the directions")
    return rrb.Horizontal(views, key, column_shares=[6, 1], name="Segmentation")


def _parameters() -> rrb.Container:
    return rrb.Horizontal(
        *(rrb.TextDocumentView(origin=f"/run/{p}/parameters", name=p) for p in PROCESSES),
        name="Parameters",
    )


def _processes() -> rrb.Container:
    return rrb.Grid(
        _plot("Rate [1/s]", "/plots/rate_hz/**", legend=True),
        _plot("Latency from the release of the frame [ms]", "/plots/latency_ms/**", legend=True),
        _plot("Frames dropped so far", "/plots/dropped/**", legend=True),
        _plot("Memory [MB]", "/plots/memory_mb/**", legend=True),
        grid_columns=2,
        name="Processes",
    )


def _plot(name: str, *contents: str, legend: bool = False) -> rrb.TimeSeriesView:
    # On a small plot a legend would cover the lines, so that its name tells the colours.
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(origin="/plots", name=name, contents=contents, plot_legend=corner)


def _view(view: str, *layers: str, name: str | None = None) -> rrb.Spatial2DView:
    image = f"/rig/{view}/image"
    contents = [f"{image}{layer}" for layer in layers]
    return rrb.Spatial2DView(origin=image, name=name or view, contents=contents)

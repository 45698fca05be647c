"""What a run looks like when it is opened: images, space, plots and log on one screen."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from services.drawing import part


def blueprint(threads: Sequence[str]) -> rrb.Blueprint:
    """The layout for the given threads ("0" when there is none yet)."""
    names = [part(thread) for thread in threads] or ["0"]
    images = rrb.Horizontal(_image("left"), _image("right"))
    space = rrb.Spatial3DView(origin="/rig", name="Space", contents=["/rig/**"])

    def plot(name: str, *quantities: str) -> rrb.TimeSeriesView:
        contents = [f"/plots/{n}/{q}" for n in names for q in quantities]
        return rrb.TimeSeriesView(origin="/plots", name=name, contents=contents)

    plots = rrb.Vertical(
        rrb.StateTimelineView(
            origin="/plots", name="Status", contents=[f"/plots/{n}/status" for n in names]
        ),
        plot("Image energy (-1 is a perfect match)", "energy/image"),
        plot("End energy", "energy/end"),
        plot("Length [mm]", "length"),
        rrb.TimeSeriesView(origin="/plots", name="Latency [ms]", contents=["/plots/latency_ms/**"]),
    )
    log = rrb.TextLogView(origin="/log", name="Log", contents=["/log/**"])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(images, rrb.Horizontal(space, log), row_shares=[3, 2]),
            plots,
            column_shares=[5, 2],
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )


def _image(view: str) -> rrb.Spatial2DView:
    image = f"/rig/{view}/image"
    return rrb.Spatial2DView(origin=image, name=view, contents=[image, f"{image}/curve"])

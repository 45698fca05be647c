"""The scenarios of the bench top, as a table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ThreadModel:
    """One thread of a scenario."""

    length: float | None
    """Exact length in mm; None where it comes out of a hole."""
    colours: tuple[str, ...] = ("violet", "violet", "black", "blue")
    """Names in `COLOURS`; the seed chooses one."""
    diameter: float = 0.4
    """mm."""


@dataclass(frozen=True)
class Scenario:
    """What happens on the bench top, and how it looks."""

    about: str
    """One line for people."""
    motions: tuple[str, ...]
    """Names of stored motions; the seed chooses one."""
    threads: tuple[ThreadModel, ...]
    backgrounds: tuple[str, ...] = ("marbled", "tissue")
    """Names of textures; the seed chooses one."""
    top_speed: float = float("inf")
    """Fastest that an end may move, mm/s."""
    seconds: float = 20.0
    starts_at_rest: bool = False
    """Whether the motion's beginning is shown; otherwise the seed chooses where to begin."""
    shutter: float = 0.25
    """Share of the frame's time for which light is gathered."""
    gripper_sweeps: bool = False
    """Whether a gripper passes over the middle of the first thread, then over its moving end."""
    clutter: bool = False
    """Whether veins and other threads lie about, run on past an end and cross at shallow angles."""
    end_leaves: bool = False
    """Whether the camera stands so that the moving end leaves the images."""


_MEDIUM = (ThreadModel(175),)

SCENARIOS = {
    **{
        f"figure8-{length}": Scenario(
            f"{length} mm of thread; one end is fixed, the other runs along a figure 8 at 11 mm/s",
            motions=(f"figure8-{length}",),
            threads=(ThreadModel(length, colours=("violet",)),),
            backgrounds=("marbled",),
            top_speed=11.0,
        )
        for length in (107, 175, 200)
    },
    "pull-through": Scenario(
        "one end is pulled along at 9.7 mm/s, the other comes out of a hole in the table",
        motions=("pull-through",),
        threads=(ThreadModel(None),),
        starts_at_rest=True,
    ),
    "knot": Scenario(
        "an overhand loop is tightened until it is a point, then moved",
        motions=("knot",),
        threads=(ThreadModel(90),),
        starts_at_rest=True,
    ),
    "crossings": Scenario(
        "a thread that crosses itself and runs beside itself; still at first, then moved",
        motions=("crossings-a", "crossings-b"),
        threads=(ThreadModel(190),),
        starts_at_rest=True,
    ),
    "occlusion": Scenario(
        "a gripper passes over the middle, then over the moving end, for a second each",
        motions=("figure8-175",),
        threads=_MEDIUM,
        gripper_sweeps=True,
    ),
    "grasped": Scenario(
        "a gripper takes one end, lifts it, carries it at up to 100 mm/s, and lets go",
        motions=("grasped",),
        threads=(ThreadModel(130),),
        starts_at_rest=True,
    ),
    "clutter": Scenario(
        "veins and other threads run on past an end and cross at shallow angles; bright spots",
        motions=("figure8-175",),
        threads=_MEDIUM,
        backgrounds=("tissue",),
        clutter=True,
    ),
    "two-threads": Scenario(
        "two threads of different colours that cross",
        motions=("two-threads",),
        threads=(
            ThreadModel(120, colours=("violet", "black")),
            ThreadModel(120, colours=("blue", "undyed")),
        ),
    ),
    "fast": Scenario(
        "one end is shaken at up to 200 mm/s: motion blur, tens of pixels a frame",
        motions=("fast",),
        threads=(ThreadModel(107),),
        starts_at_rest=True,
        top_speed=200.0,
        shutter=0.5,
    ),
    "leaves-view": Scenario(
        "the moving end leaves the images and comes back",
        motions=("leaves-view",),
        threads=(ThreadModel(140),),
        starts_at_rest=True,
        end_leaves=True,
    ),
}

"""The scenarios of the bench top, as a table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ThreadModel:
    """One thread of a scenario."""

    length: float
    """Length in mm."""
    colours: tuple[str, ...] = ("violet",)
    """Names in `COLOURS`; the seed chooses one."""
    diameter: float = 0.4
    """mm."""


@dataclass(frozen=True)
class Scenario:
    """What happens on the bench top, and how it looks."""

    about: str
    """One line for people."""
    motion: str
    """Name of the stored motion."""
    threads: tuple[ThreadModel, ...]
    backgrounds: tuple[str, ...] = ("marbled",)
    """Names of textures; the seed chooses one."""
    top_speed: float | None = None
    """Fastest that a held end may move, mm/s."""
    seconds: float = 20.0


SCENARIOS = {
    f"figure8-{length}": Scenario(
        f"{length} mm of thread, one end fixed, the other on a stage that runs along a figure 8",
        motion=f"figure8-{length}",
        threads=(ThreadModel(length),),
        top_speed=11.0,
    )
    for length in (107, 175, 200)
}

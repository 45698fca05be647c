"""Simulates the motions of the synthetic bench top with MuJoCo and stores them in the package.

.venv/bin/pip install '.[motions]'
.venv/bin/python tools/simulate_motions.py [NAME ...]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from thread_physics import RATE_HZ, Array, Thread, simulate
from thread_shapes import crossing_pairs, meander, overhand, tangle

FOLDER = Path(__file__).parents[1] / "suturetrack" / "stage" / "motions"
# Length of thread that the tight knot takes up.
KNOT_TAKES = 11.0


@dataclass
class Result:
    """What is stored of a simulation."""

    threads: list[Array]
    tool: Array | None = None
    """(T, 3, 3) tips of the jaws and the wrist of a gripper."""
    rate_hz: int = RATE_HZ


def store(name: str, result: Result) -> None:
    """Writes the motion, rounded to 1/128 mm, which packs well."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{name}.npz"
    tracks = {f"thread{i}": nodes for i, nodes in enumerate(result.threads)}
    if result.tool is not None:
        tracks["tool"] = result.tool
    rounded = {key: (np.round(n * 128) / 128).astype(np.float32) for key, n in tracks.items()}
    np.savez_compressed(path, rate_hz=np.float32(result.rate_hz), **rounded)
    speed = max(
        float(np.linalg.norm(np.diff(n, axis=0), axis=2).max()) * result.rate_hz
        for n in result.threads
    )
    relief = max(float(n[..., 2].max()) for n in result.threads)
    print(f"{name}: {path.stat().st_size / 1024:.0f} KiB, {speed:.1f} mm/s, relief {relief:.1f} mm")


def figure8(centre: Array, size: tuple[float, float], speed: float) -> Callable[[float], Array]:
    """A place that runs along a figure 8 around `centre`, at most `speed` fast, from rest."""
    rate = speed / np.hypot(size[0], 2 * size[1])

    def place(t: float) -> Array:
        phase = rate * (t - 0.5 * np.tanh(t / 0.5))
        return centre + np.array([size[0] * np.sin(phase), size[1] * np.sin(2 * phase), 0.0])

    return place


def fixed(point: Array) -> Callable[[float], Array]:
    """A place that stays."""
    return lambda _: point


def table_one(length: float, seed: int) -> Result:
    """One end fixed, the other on the stage that runs along a figure 8 at 11 mm/s."""
    shape = meander(np.random.default_rng(seed), length, 2.5, (60, 44), 7.0)
    held = {0: fixed(shape[0]), len(shape) - 1: figure8(shape[-1], (9, 4), 10.8)}
    return Result(simulate([Thread(shape, held)], seconds=24, step=1e-3))


def crossings(seed: int) -> Result:
    """A thread that crosses itself, runs beside itself, lies still for 6 s and is then moved."""
    shape = tangle(np.random.default_rng(seed), 190, 2.5, (56, 42))
    moved = figure8(shape[-1], (9, 4), 10.8)
    held = {0: fixed(shape[0]), len(shape) - 1: lambda t: moved(max(t - 6.0, 0.0))}
    return Result(simulate([Thread(shape, held)], seconds=22))


def pull_through() -> Result:
    """One end on the stage at 9.7 mm/s, the other comes out of a hole in the table."""
    outside, inside, link = 60.0, 110.0, 2.5
    s = np.arange(0, inside + outside + link / 2, link)
    kink = 0.35 * np.sin(2 * np.pi * s / 38) + 0.25 * np.sin(2 * np.pi * s / 61)
    links = link * np.c_[np.sin(kink), np.zeros(len(s)), np.cos(kink)]
    rest = np.r_[np.zeros((1, 3)), np.cumsum(links[:-1], axis=0)] - [0, 0, inside]
    turn = np.clip((s - inside + 6.0) / 12.0, 0, 1) * np.pi / 2
    heading = 0.7 * np.sin(2 * np.pi * np.maximum(s - inside, 0) / 45)
    step = np.c_[np.sin(turn) * np.cos(heading), np.sin(turn) * np.sin(heading), np.cos(turn)]
    start = np.r_[np.zeros((1, 3)), np.cumsum(step[:-1] * link, axis=0)]
    start -= start[np.argmax(s >= inside - 4.0)] + [0, 0, 1.0]
    wide, thick, half = 100, 1.0, 0.9
    table = "".join(
        f'<geom type="box" size="{sx} {sy} {thick}" pos="{x} {y} {-thick}"/>'
        for x, y, sx, sy in (
            (wide + half, 0, wide, wide),
            (-wide - half, 0, wide, wide),
            (0, wide + half, half, wide),
            (0, -wide - half, half, wide),
        )
    )
    held = {len(s) - 1: along(winding(start[-1]), 9.7)}
    thread = Thread(rest, held, start, bending_length=25.0)
    return Result(simulate([thread], seconds=21, table=table, friction=0.9))


def winding(origin: Array) -> Array:
    """(n, 3) a way from `origin` that swings to and fro while it leads away."""
    phase = np.linspace(0, 1, 2000)
    swing = 20 * np.sin(2 * np.pi * 2.25 * phase) * np.minimum(phase * 4, 1)
    return origin + np.c_[18 * phase, swing, np.zeros(len(phase))]


def along(way: Array, speed: float) -> Callable[[float], Array]:
    """A place that runs along (n, 3) points with that speed, and stays at the end."""
    travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))]
    return lambda t: np.array([np.interp(speed * t, travelled, column) for column in way.T])


def through(stops: list[tuple[float, Array]]) -> Callable[[float], Array]:
    """A place that rests at every (time, point) and goes from one to the next smoothly."""
    times = np.array([t for t, _ in stops])

    def place(t: float) -> Array:
        i = int(np.clip(np.searchsorted(times, t) - 1, 0, len(stops) - 2))
        u = np.clip((t - times[i]) / (times[i + 1] - times[i]), 0, 1)
        share = u**3 * (10 - 15 * u + 6 * u**2)
        return (1 - share) * stops[i][1] + share * stops[i + 1][1]

    return place


def grasped() -> Result:
    """A gripper takes one end, lifts it, carries it at up to 100 mm/s, and lets go."""
    shape = meander(np.random.default_rng(11), 130, 2.5, (58, 42), 7.0)
    end = shape[-1]
    away = np.array([np.sign(end[0]) * 45, np.sign(end[1]) * 30, 45.0])
    centre = shape.mean(0)
    lifts = np.array([[0, 0, 14.0], [0, 10, 20.0], [0, -12, 14.0]])
    aside = list(np.array([end, (end + centre) / 2, centre]) + lifts)
    stops = [(0.0, end + away), (1.0, end + away), (2.5, end), (3.0, end)]
    time, place = 3.0, end
    down = end * [0.8, 0.8, 0] + [0, 0, 3]
    for target in [*aside, *aside[::-1], aside[2], aside[0], aside[2], down]:
        time += max(1.9 * float(np.linalg.norm(target - place)) / 98.0, 0.3)
        stops.append((time, target))
        time, place = time + 0.5, target
        stops.append((time, target))
    release = time
    stops += [(release + 0.5, place), (release + 2.0, place + away), (30.0, place + away)]
    tool = through(stops)
    held = {len(shape) - 1: lambda t: tool(t) if 2.7 <= t < release else None}
    threads = simulate([Thread(shape, held)], seconds=20.0)
    times = np.arange(len(threads[0])) / RATE_HZ
    opening = np.interp(times, [2.4, 2.7, release, release + 0.3], [4.0, 0.5, 0.5, 4.0])
    tips = np.array([tool(t) for t in times])
    return Result(threads, gripper(tips, opening, away / np.linalg.norm(away)))


def gripper(tips: Array, opening: Array, back: Array) -> Array:
    """(T, 3, 3) tips of the jaws and wrist; `back` is the unit vector from the tips to the wrist."""
    side = np.cross(back, [0, 0, 1.0])
    spread = 0.5 * opening[:, None] * side / np.linalg.norm(side)
    return np.stack([tips - spread, tips + spread, tips + 9.0 * back], axis=1)


def fast() -> Result:
    """One end fixed, the other shaken at up to 200 mm/s, with rests."""
    shape = meander(np.random.default_rng(21), 107, 3.0, (50, 40), 9.0)
    rate = 11.0
    size = 195.0 / (rate * np.hypot(1.0, 0.8))

    def shaken(t: float) -> Array:
        strength = np.sin(np.pi * np.clip((t % 7.0 - 1.5) / 5.0, 0, 1)) ** 2
        x, y = np.sin(rate * t), 0.4 * np.sin(2 * rate * t)
        return shape[-1] + strength * size * np.array([x, y, 0.15 * (1 - np.cos(rate * t))])

    held = {0: fixed(shape[0]), len(shape) - 1: shaken}
    return Result(simulate([Thread(shape, held)], seconds=21, rate_hz=50), rate_hz=50)


def leaves_view() -> Result:
    """The moving end runs 36 mm away along x and comes back, again and again."""
    shape = meander(np.random.default_rng(33), 140, 2.5, (40, 42), 7.0)
    shape = shape * np.array([np.sign(shape[-1, 0]), 1, 1])
    out = np.array([36.0, 4.0, 0.0])
    stops = [(0.0, shape[-1]), (3.0, shape[-1])]
    for begin in (3.0, 9.0, 15.0):
        stops += [(begin + 2.5, shape[-1] + out), (begin + 3.5, shape[-1] + out)]
        stops += [(begin + 5.5, shape[-1]), (begin + 6.0, shape[-1])]
    held = {0: fixed(shape[0]), len(shape) - 1: through(stops)}
    return Result(simulate([Thread(shape, held)], seconds=22))


def two_threads() -> Result:
    """Two threads, one across the other; an end of each is moved."""
    rng = np.random.default_rng(45)
    lower = meander(rng, 120, 2.5, (60, 34), 8.0)
    while True:
        upper = meander(rng, 120, 2.5, (60, 44), 8.0)
        both = np.r_[lower[:, :2], upper[:, :2]]
        pairs = [p for p in crossing_pairs(both) if p[0] < len(lower) - 1 < p[1]]
        ends = np.r_[lower[[0, -1]], upper[[0, -1]]][:, :2]
        clear = min(np.linalg.norm(ends[a] - ends[b]) for a in range(4) for b in range(a))
        if 2 <= len(pairs) <= 4 and clear > 12:
            break
    upper[:, 2] += lower[:, 2].max() + 0.6
    held = [
        {0: fixed(lower[0] * [1, 1, 0.2]), len(lower) - 1: figure8(lower[-1], (8, 4), 9.0)},
        {0: fixed(upper[0]), len(upper) - 1: figure8(upper[-1], (-6, 4), 10.5)},
    ]
    return Result(simulate([Thread(lower, held[0]), Thread(upper, held[1])], seconds=22, step=1e-3))


def knot() -> Result:
    """An overhand loop, tightened until it is a point, then moved."""
    length = 90.0
    start = overhand(1.0, length)
    last = len(start) - 1
    rest = np.outer(np.linspace(0, length, last + 1), [1.0, 0.0, 0.0])
    middle = (start[0] + start[-1]) / 2 * [1, 1, 0] + [0, 0, 2.0]
    reach = np.array([(length - KNOT_TAKES) / 2, 0.0, 0.0])
    first, second = (
        through([(0.0, e), (3.0, e), (11.0, middle + w * reach), (40.0, middle + w * reach)])
        for w, e in ((-1, start[0]), (1, start[-1]))
    )
    slack = np.array([-3.0, 1.5, 0.0])
    back = through([(0.0, 0 * slack), (16.0, 0 * slack), (18.0, slack), (40.0, slack)])
    moved = figure8(np.zeros(3), (9, 4), 10.0)
    held = {
        0: lambda t: first(t) + moved(max(t - 12.0, 0.0)),
        last: lambda t: second(t) + back(t) + moved(max(t - 12.0, 0.0)),
    }
    thread = Thread(rest, held, start, radius=0.24, bending_length=14.0)
    return Result(simulate([thread], seconds=20.5, friction=0.5))


MOTIONS: dict[str, Callable[[], Result]] = {
    "figure8-107": lambda: table_one(107, 3),
    "figure8-175": lambda: table_one(175, 4),
    "figure8-200": lambda: table_one(200, 5),
    "crossings-a": lambda: crossings(1),
    "crossings-b": lambda: crossings(2),
    "pull-through": pull_through,
    "grasped": grasped,
    "fast": fast,
    "leaves-view": leaves_view,
    "two-threads": two_threads,
    "knot": knot,
}

if __name__ == "__main__":
    for motion in sys.argv[1:] or MOTIONS:
        store(motion, MOTIONS[motion]())

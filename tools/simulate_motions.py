"""Simulates the motions of the synthetic bench top with MuJoCo and stores them in the package.

    .venv/bin/pip install mujoco
    .venv/bin/python tools/simulate_motions.py [NAME ...]

A thread is a chain of capsules joined by ball joints: inextensible by construction, with bending
stiffness, a kinked rest shape, gravity, friction and contact with the table and with itself. Lengths
are mm, masses g, times s. Gravity and stiffness are weaker than a real thread's by one factor, which
leaves the shapes as they are and allows larger time steps.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
FOLDER = Path(__file__).parents[1] / "suturetrack" / "stage" / "motions"
RATE_HZ = 30
GRAVITY = 200.0
DENSITY = 1.4e-4
RADIUS = 0.22
SETTLE = 3.0
# Length over which the thread bends under its own weight.
BENDING_LENGTH = 45.0
# Length of thread that the tight knot takes up.
KNOT_TAKES = 11.0
TABLE = '<geom type="plane" size="300 300 1"/>'


@dataclass
class Thread:
    """One thread, and what holds it."""

    shape: Array
    """(N + 1, 3) nodes at rest."""
    held: dict[int, Callable[[float], Array | None]]
    """Nodes that are held, and where to at time t; None lets go."""
    start: Array | None = None
    """(N + 1, 3) nodes at the beginning, where that is not the rest shape."""
    radius: float = RADIUS
    damping: float = 0.05
    bending_length: float = BENDING_LENGTH


def meander(
    rng: np.random.Generator, length: float, link: float, box: tuple[float, float], apart: float
) -> Array:
    """(N + 1, 3) a random winding, kinked shape of exact length, that fits the box, centred on it."""
    count = round(length / link)
    s = (np.arange(count) + 0.5) * length / count
    while True:
        heading = rng.uniform(0, 6) + rng.uniform(1.2, 2.3) * np.sin(
            2 * np.pi * (s / rng.uniform(70, 140) + rng.uniform())
        )
        heading += rng.uniform(0, 0.35) * np.sin(
            2 * np.pi * (s / rng.uniform(20, 40) + rng.uniform())
        )
        rise = rng.uniform(0.2, 0.45) * np.sin(2 * np.pi * (s / rng.uniform(35, 60)))
        step = np.c_[np.cos(heading) * np.cos(rise), np.sin(heading) * np.cos(rise), np.sin(rise)]
        nodes = np.r_[np.zeros((1, 3)), np.cumsum(step * length / count, axis=0)]
        nodes -= (nodes.max(0) + nodes.min(0)) / 2
        extent = np.ptp(nodes, axis=0)
        if extent[0] < box[0] and extent[1] < box[1] and separation(nodes[:, :2]) > apart:
            nodes[:, 2] -= nodes[:, 2].min() - 2 * RADIUS
            return nodes


def separation(nodes: Array, beyond: int = 8) -> float:
    """Smallest distance of nodes that are not neighbours along the thread."""
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    far = np.abs(np.subtract.outer(np.arange(len(nodes)), np.arange(len(nodes)))) > beyond
    return float(distance[far].min())


def _vector(values: Array) -> str:
    return " ".join(f"{v:.6g}" for v in values)


def _chain(name: str, thread: Thread) -> str:
    """The thread as nested bodies."""
    links = np.diff(thread.shape, axis=0)
    length = np.linalg.norm(links, axis=1)
    bending = DENSITY * GRAVITY * thread.bending_length**3
    bodies = []
    for i, link in enumerate(links):
        offset = thread.shape[i] - thread.shape[i - 1] if i else thread.shape[0]
        stiffness = bending / length[i]
        joint = (
            f'<joint type="ball" stiffness="{stiffness}" damping="{thread.damping * stiffness}"/>'
            if i
            else "<freejoint/>"
        )
        bodies.append(
            f'<body name="{name}{i}" pos="{_vector(offset)}">{joint}<geom type="capsule" '
            f'fromto="0 0 0 {_vector(link)}" size="{thread.radius}" mass="{DENSITY * length[i]}"/>'
        )
    bodies.append(f'<site name="{name}end" pos="{_vector(links[-1])}"/>')
    return "".join(bodies) + "</body>" * len(links)


def _holds(name: str, thread: Thread) -> tuple[str, str]:
    """Mocap bodies and the constraints that tie nodes to them."""
    bodies, ties = "", ""
    last = len(thread.shape) - 2
    for node in thread.held:
        bodies += (
            f'<body name="{name}hold{node}" mocap="true" pos="{_vector(thread.shape[node])}"/>'
        )
        anchor = thread.shape[node] - thread.shape[min(node, last)]
        ties += (
            f'<connect name="{name}tie{node}" body1="{name}{min(node, last)}" '
            f'body2="{name}hold{node}" anchor="{_vector(anchor)}" solref="0.002 1" '
            'solimp="0.99 0.999 0.0001"/>'
        )
    return bodies, ties


def _bend_into_start(model: mujoco.MjModel, data: mujoco.MjData, name: str, thread: Thread) -> None:
    """Turns every link by the smallest rotation that lays the chain along its start."""
    rest, start = (np.diff(nodes, axis=0) for nodes in (thread.shape, thread.start))
    before = Rotation.identity()
    for i, (old, new) in enumerate(zip(rest, start, strict=True)):
        axis = np.cross(before.apply(old), new)
        sine, cosine = np.linalg.norm(axis), before.apply(old) @ new
        turn = Rotation.from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, cosine)) * before
        joint = model.jnt_qposadr[model.body_jntadr[model.body(f"{name}{i}").id]]
        if i == 0:
            data.qpos[joint : joint + 3] = thread.start[0]
            joint += 3
        data.qpos[joint : joint + 4] = np.roll((before.inv() * turn).as_quat(), 1)
        before = turn


def simulate(
    threads: list[Thread],
    seconds: float,
    step: float = 5e-4,
    friction: float = 0.3,
    table: str = TABLE,
    rate_hz: int = RATE_HZ,
) -> list[Array]:
    """(T, N + 1, 3) nodes over time for each thread, `rate_hz` a second, after settling."""
    names = [chr(ord("a") + i) for i in range(len(threads))]
    named = list(zip(names, threads, strict=True))
    holds = [_holds(n, t) for n, t in named]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="100M"/><option timestep="{step}" gravity="0 0 -{GRAVITY}" '
        f'integrator="implicitfast"/><default><geom friction="{friction}" solref="0.01 1"/></default>'
        f"<worldbody>{table}{''.join(h[0] for h in holds)}{''.join(_chain(n, t) for n, t in named)}"
        f"</worldbody><equality>{''.join(h[1] for h in holds)}</equality></mujoco>"
    )
    data = mujoco.MjData(model)
    for name, thread in named:
        if thread.start is not None:
            _bend_into_start(model, data, name, thread)
    every = round(1 / rate_hz / step)
    frames: list[list[Array]] = [[] for _ in threads]
    for k in range(round((SETTLE + seconds) / step)):
        time = k * step - SETTLE
        for name, thread in named:
            for node, place in thread.held.items():
                _hold(model, data, f"{name}hold{node}", f"{name}tie{node}", place(max(time, 0.0)))
        mujoco.mj_step(model, data)
        if time >= 0 and k % every == 0:
            for nodes, (name, thread) in zip(frames, named, strict=True):
                nodes.append(_nodes(data, name, thread, time))
    return [np.array(nodes) for nodes in frames]


def _hold(
    model: mujoco.MjModel, data: mujoco.MjData, body: str, tie: str, place: Array | None
) -> None:
    data.eq_active[model.equality(tie).id] = place is not None
    if place is not None:
        data.mocap_pos[model.body(body).mocapid[0]] = place


def _nodes(data: mujoco.MjData, name: str, thread: Thread, time: float) -> Array:
    """(N + 1, 3) nodes; held ones exactly where they are held."""
    links = [data.body(f"{name}{i}").xpos for i in range(len(thread.shape) - 1)]
    nodes = np.array([*links, data.site(f"{name}end").xpos])
    for node, place in thread.held.items():
        held = place(time)
        if held is not None:
            nodes[node] = held
    return nodes


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
    return Result(simulate([Thread(shape, held)], seconds=24))


def crossings(seed: int) -> Result:
    """A thread that crosses itself, runs beside itself, lies still for 6 s and is then moved."""
    shape = tangle(np.random.default_rng(seed), 190, 2.5, (56, 42))
    moved = figure8(shape[-1], (9, 4), 10.8)
    held = {0: fixed(shape[0]), len(shape) - 1: lambda t: moved(max(t - 6.0, 0.0))}
    return Result(simulate([Thread(shape, held)], seconds=22))


def tangle(rng: np.random.Generator, length: float, link: float, box: tuple[float, float]) -> Array:
    """(N + 1, 3) a random shape of exact length with crossings and neighbours, each pass on top."""
    count = round(length / link)
    s = (np.arange(count) + 0.5) * length / count
    far = np.abs(np.subtract.outer(np.arange(count + 1), np.arange(count + 1))) > 8
    while True:
        heading = rng.uniform(0, 6) + rng.uniform(-1, 1) * 2 * np.pi * s / rng.uniform(60, 120)
        for wave in (rng.uniform(70, 140), rng.uniform(35, 60)):
            heading += rng.uniform(0.4, 1.6) * np.sin(2 * np.pi * (s / wave + rng.uniform()))
        step = np.c_[np.cos(heading), np.sin(heading)] * length / count
        flat = np.r_[np.zeros((1, 2)), np.cumsum(step, axis=0)]
        flat -= (flat.max(0) + flat.min(0)) / 2
        extent = np.ptp(flat, axis=0)
        tightest = np.abs(np.diff(heading)).max() / (length / count)
        if extent[0] > box[0] or extent[1] > box[1] or tightest > 1 / 4:
            continue
        distance = np.where(far, np.linalg.norm(flat[:, None] - flat[None], axis=2), np.inf)
        beside = int(((distance > 1.2) & (distance < 3.0)).any(1).sum())
        if 3 <= len(crossing_pairs(flat)) <= 6 and beside > 14:
            return np.c_[flat, 0.3 + 0.022 * np.r_[0, s]]


def crossing_pairs(flat: Array) -> list[tuple[int, int]]:
    """Pairs of links of an (N + 1, 2) polyline that cross."""
    a, d = flat[:-1], np.diff(flat, axis=0)
    offset = a[None] - a[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = d[:, None, 0] * d[None, :, 1] - d[:, None, 1] * d[None, :, 0]
        t = (offset[..., 0] * d[None, :, 1] - offset[..., 1] * d[None, :, 0]) / area
        u = (offset[..., 0] * d[:, None, 1] - offset[..., 1] * d[:, None, 0]) / area
    cross = (t > 0) & (t < 1) & (u > 0) & (u < 1)
    return [(int(i), int(j)) for i, j in np.argwhere(cross) if j > i + 1]


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
    aside = [end + [0, 0, 14], 0.5 * (end + centre) + [0, 10, 20], centre + [0, -12, 14]]
    stops = [(0.0, end + away), (1.0, end + away), (2.5, end), (3.0, end)]
    time, place = 3.0, end
    for target in [
        *aside,
        *aside[::-1],
        aside[2],
        aside[0],
        aside[2],
        end * [0.8, 0.8, 0] + [0, 0, 3],
    ]:
        time += max(1.9 * float(np.linalg.norm(target - place)) / 98.0, 0.3)
        stops.append((time, target))
        time, place = time + 0.5, target
        stops.append((time, target))
    release = time
    stops += [(release + 0.5, place), (release + 2.0, place + away), (30.0, place + away)]
    tool = through(stops)
    held = {len(shape) - 1: lambda t: tool(t) if 2.7 <= t < release else None}
    seconds = 20.0
    threads = simulate([Thread(shape, held)], seconds=seconds)
    times = np.arange(len(threads[0])) / RATE_HZ
    opening = np.interp(times, [2.4, 2.7, release, release + 0.3], [4.0, 0.5, 0.5, 4.0])
    back = away / np.linalg.norm(away)
    side = np.cross(back, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    tips = np.array([tool(t) for t in times])
    spread = 0.5 * opening[:, None] * side
    return Result(threads, np.stack([tips - spread, tips + spread, tips + 9.0 * back], axis=1))


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
    return Result(simulate([Thread(lower, held[0]), Thread(upper, held[1])], seconds=22))


def knot() -> Result:
    """An overhand loop, tightened until it is a point, then moved."""
    link, length = 1.0, 90.0
    t = np.linspace(-2.12, 2.12, 4000)
    height = np.clip(t**5 - 10 * t, -9.6, 9.6)
    loop = np.c_[1.9 * (t**3 - 3 * t), 1.7 * (t**4 - 4 * t**2), 0.19 * height]
    tails = [loop[i] + [way * 60.0, 1.0, 0.0] for i, way in ((0, -1), (-1, 1))]
    curve = np.r_[[tails[0]], loop, [tails[1]]]
    travelled = np.r_[0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))]
    s = travelled[-1] / 2 + np.arange(-length / 2, length / 2 + link / 2, link)
    start = np.stack([np.interp(s, travelled, column) for column in curve.T], axis=1)
    start[:, 2] += 1.0 - start[:, 2].min()
    rest = np.c_[np.arange(len(start)) * link, np.zeros((len(start), 2))]
    middle = (start[0] + start[-1]) / 2 * [1, 1, 0] + [0, 0, 2.0]
    reach = np.array([length - KNOT_TAKES, 0.0, 0.0]) / 2
    pulled = [
        through([(0.0, e), (3.0, e), (11.0, middle + w * reach), (40.0, middle + w * reach)])
        for w, e in ((-1, start[0]), (1, start[-1]))
    ]
    moved = figure8(np.zeros(3), (9, 4), 10.0)
    back = through(
        [
            (0.0, np.zeros(3)),
            (12.0, np.zeros(3)),
            (14.0, np.array([-8.0, 4.0, 0.0])),
            (40.0, np.array([-8.0, 4.0, 0.0])),
        ]
    )
    held = {
        0: pulled[0],
        len(start) - 1: lambda t: pulled[1](t) + back(t) + moved(max(t - 14.0, 0.0)),
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

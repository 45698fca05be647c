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

Array = NDArray[np.float64]
FOLDER = Path(__file__).parents[1] / "suturetrack" / "stage" / "motions"
RATE_HZ = 30
GRAVITY = 200.0
DENSITY = 1.4e-4
RADIUS = 0.22
SETTLE = 3.0
# Length over which the thread bends under its own weight.
BENDING_LENGTH = 45.0


@dataclass
class Thread:
    """One thread at rest."""

    shape: Array
    """(N + 1, 3) nodes of the rest shape, which is also where it starts."""
    held: dict[int, Callable[[float], Array]]
    """Nodes that are held, and where to at time t."""
    radius: float = RADIUS
    damping: float = 0.05


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
    bending = DENSITY * GRAVITY * BENDING_LENGTH**3
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
            f'<connect body1="{name}{min(node, last)}" body2="{name}hold{node}" '
            f'anchor="{_vector(anchor)}" solref="0.002 1" solimp="0.99 0.999 0.0001"/>'
        )
    return bodies, ties


def simulate(
    threads: list[Thread], seconds: float, step: float = 1e-3, friction: float = 0.3
) -> list[Array]:
    """(T, N + 1, 3) nodes over time for each thread, `RATE_HZ` a second, after settling."""
    names = [chr(ord("a") + i) for i in range(len(threads))]
    holds = [_holds(n, t) for n, t in zip(names, threads, strict=True)]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="100M"/><option timestep="{step}" gravity="0 0 -{GRAVITY}" '
        f'integrator="implicitfast"/><default><geom friction="{friction}" solref="0.01 1"/></default>'
        f'<worldbody><geom type="plane" size="300 300 1"/>{"".join(h[0] for h in holds)}'
        f"{''.join(_chain(n, t) for n, t in zip(names, threads, strict=True))}</worldbody>"
        f"<equality>{''.join(h[1] for h in holds)}</equality></mujoco>"
    )
    data = mujoco.MjData(model)
    every = round(1 / RATE_HZ / step)
    frames: list[list[Array]] = [[] for _ in threads]
    for k in range(round((SETTLE + seconds) / step)):
        time = k * step - SETTLE
        for name, thread in zip(names, threads, strict=True):
            for node, place in thread.held.items():
                mocap = model.body(f"{name}hold{node}").mocapid[0]
                data.mocap_pos[mocap] = place(max(time, 0.0))
        mujoco.mj_step(model, data)
        if time >= 0 and k % every == 0:
            for nodes, name, thread in zip(frames, names, threads, strict=True):
                links = [data.body(f"{name}{i}").xpos for i in range(len(thread.shape) - 1)]
                nodes.append(np.array([*links, data.site(f"{name}end").xpos]))
    return [np.array(nodes) for nodes in frames]


def store(name: str, threads: list[Array]) -> None:
    """Writes the motion, rounded to 1/128 mm, which packs well."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{name}.npz"
    rounded = {
        f"thread{i}": (np.round(n * 128) / 128).astype(np.float32) for i, n in enumerate(threads)
    }
    np.savez_compressed(path, rate_hz=np.float32(RATE_HZ), **rounded)
    speed = max(float(np.linalg.norm(np.diff(n, axis=0), axis=2).max()) * RATE_HZ for n in threads)
    relief = max(float(n[..., 2].max()) for n in threads)
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


def table_one(length: float, seed: int) -> list[Array]:
    """One end fixed, the other on the stage that runs along a figure 8 at 11 mm/s."""
    shape = meander(np.random.default_rng(seed), length, 2.5, (60, 44), 7.0)
    last = len(shape) - 1
    held = {0: fixed(shape[0]), last: figure8(shape[-1], (9, 4), 10.8)}
    return simulate([Thread(shape, held)], seconds=24)


MOTIONS: dict[str, Callable[[], list[Array]]] = {
    "figure8-107": lambda: table_one(107, 3),
    "figure8-175": lambda: table_one(175, 4),
    "figure8-200": lambda: table_one(200, 5),
}

if __name__ == "__main__":
    for motion in sys.argv[1:] or MOTIONS:
        store(motion, MOTIONS[motion]())

"""Threads as chains of capsules in MuJoCo.

Ball joints make a chain inextensible by construction; it has bending stiffness, a kinked rest shape,
gravity, friction and contact with the table and with itself. Lengths are mm, masses g, times s.
Gravity and stiffness are weaker than a real thread's by one factor, which leaves the shapes as they
are and allows larger time steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
RATE_HZ = 30
RADIUS = 0.22
GRAVITY = 200.0
DENSITY = 1.4e-4
SETTLE = 3.0
# Length over which the thread bends under its own weight.
BENDING_LENGTH = 45.0
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

"""What moves on the table: the threads and the gripper of a scenario, at any time."""

from __future__ import annotations

import numpy as np

from suturetrack.polylines import polyline_length
from suturetrack.stage.motion import Motion, Warp, load_motion, smoothing_matrix
from suturetrack.stage.scenarios import Scenario
from suturetrack.types import Float64

# How the gripper sweeps: when it stays over which place of the thread, seconds and share of it.
_SWEEPS = ((5.0, 0.5), (12.0, 1.0))
_SWEEP_STAY = 1.0
_SWEEP_WAY = 2.0
_FAR = 150.0
_JAWS = 9.0


class Play:
    """The motion of a scenario, varied by a seed; lengths in mm, in the table's frame, times in s.

    Attributes:
        threads: names of the threads.
    """

    threads: tuple[str, ...]

    def __init__(self, scenario: Scenario, rng: np.random.Generator, samples_per_mm: float) -> None:
        self._scenario = scenario
        self.threads = tuple(str(i) for i in range(len(scenario.threads)))
        self._lengths = {t: m.length for t, m in zip(self.threads, scenario.threads, strict=True)}
        self._motion = load_motion(str(rng.choice(scenario.motions)))
        self._warp = Warp.draw(rng)
        self._rate, self._start = self._timing(rng)
        self._way = _sweep_direction(rng)
        self._smoothing = {}
        for thread in self.threads:
            nodes = self._motion.tracks[f"thread{thread}"]
            samples = int(polyline_length(nodes[0]) * samples_per_mm)
            self._smoothing[thread] = smoothing_matrix(nodes.shape[1], samples)

    def centreline(self, thread: str, time: float) -> Float64:
        """(N, 3) points of the thread from end to end; from the hole on where there is one."""
        nodes = self._nodes(thread, time)
        points = self._smoothing[thread] @ nodes
        length = self._lengths[thread]
        if length is None:
            return _above_table(points)
        return points[0] + (points - points[0]) * (length / polyline_length(points))

    def gripper(self, time: float) -> Float64 | None:
        """(3, 3) tips of both jaws and the wrist, where there is a gripper."""
        if self._scenario.gripper_sweeps:
            return self._sweep(time)
        if "tool" not in self._motion.tracks:
            return None
        points = self._warp(self._motion.at("tool", self._clock(time)))
        shift = self.centreline("0", time)[-1] - self._nodes("0", time)[-1]
        return points + shift

    def everywhere(self, until: float) -> Float64:
        """(N, 3) where the threads come until then, seen every half a second."""
        times = np.arange(0, until + 0.25, 0.5)
        return np.concatenate([self.centreline(n, t)[::8] for n in self.threads for t in times])

    def hole(self) -> Float64:
        """(3,) where a thread comes out of the table."""
        return self._warp(np.zeros(3))

    def _nodes(self, thread: str, time: float) -> Float64:
        return self._warp(self._motion.at(f"thread{thread}", self._clock(time)))

    def _clock(self, time: float) -> float:
        return self._start + self._rate * time

    def _timing(self, rng: np.random.Generator) -> tuple[float, float]:
        """How fast the motion is played, and from which second on."""
        rate, share = rng.uniform(0.88, 1.0), rng.uniform()
        fastest = max(_top_speed(self._motion, f"thread{t}", self._warp) for t in self.threads)
        rate *= min(1.0, self._scenario.top_speed / fastest)
        spare = max(self._motion.duration - rate * self._scenario.seconds, 0.0)
        return rate, 0.0 if self._scenario.starts_at_rest else share * spare

    def _sweep(self, time: float) -> Float64:
        """The gripper that comes from afar, stays a second over its goal, and goes back."""
        begin, place = _SWEEPS[int(time > (_SWEEPS[0][0] + _SWEEPS[1][0] + _SWEEP_STAY) / 2)]
        line = self.centreline("0", time)
        goal = line[int(place * (len(line) - 1))] + [0.0, 0.0, 4.0]
        late = max(begin - time, time - begin - _SWEEP_STAY, 0.0) / _SWEEP_WAY
        share = min(late, 1.0)
        away = -13.0 + _FAR * share**2 * (3 - 2 * share)
        return jaws(goal + away * self._way, self._way, opening=3.0)


def jaws(tip: Float64, back: Float64, opening: float) -> Float64:
    """(3, 3) tips and wrist of a gripper that ends at `tip`; `back` is the unit vector to its wrist."""
    side = np.cross(back, [0.0, 0.0, 1.0])
    side *= opening / 2 / np.linalg.norm(side)
    return np.stack([tip - side, tip + side, tip + _JAWS * back])


def _sweep_direction(rng: np.random.Generator) -> Float64:
    heading, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(15, 30))
    flat = [np.cos(heading) * np.cos(rise), np.sin(heading) * np.cos(rise), np.sin(rise)]
    return np.array(flat)


def _above_table(points: Float64) -> Float64:
    """The (N, 3) polyline from where it last comes up through the table."""
    below = np.flatnonzero(points[:, 2] < 0)
    if not len(below):
        return points
    last = below[-1]
    share = points[last, 2] / (points[last, 2] - points[last + 1, 2])
    entry = points[last] + share * (points[last + 1] - points[last])
    return np.concatenate([entry[None], points[last + 1 :]])


def _top_speed(motion: Motion, name: str, warp: Warp) -> float:
    """Fastest speed of the ends of a track, mm/s."""
    ends = warp(motion.tracks[name][:, [0, -1]])
    return float(np.linalg.norm(np.diff(ends, axis=0), axis=2).max()) * motion.rate_hz

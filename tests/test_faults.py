"""Processes that die, stop, hang and fall silent, over real Zenoh."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from services.bench.faults import FaultsBench, Measured, inject
from services.bench.system import System, film
from services.client import Seen
from services.run_folder import RunFolder
from services.topics import PROCESSES
from suturetrack import nurbs
from suturetrack.types import InputError, Status
from tests.conftest import private_sockets

FPS = 30.0
SOON_S = 15.0
"""On a machine that does other things too; `bench faults` and the long run hold the two seconds."""


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Of a run that shows a film without end."""
    return film(tmp_path_factory.mktemp("film") / "pairs", 20, FPS)


@pytest.fixture(scope="module")
def system(options: list[str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A system that tracks."""
    folder = tmp_path_factory.mktemp("system")
    with private_sockets(), System("faults", [*options, "--restarts", "1000"], folder) as running:
        running.until_tracking()
        yield running


def direction(seen: Seen | None) -> np.ndarray:
    """From the start of a curve to its end."""
    assert seen is not None
    assert seen.state.curve is not None
    start, stop = nurbs.evaluate(seen.state.curve, np.array([0.0, 1.0]))
    return stop - start


def kill(system: System, process: str) -> float:
    """Kills a process and waits until another has its place; the wall clock of the death."""
    pid = system.pid(process)
    assert pid is not None
    died = time.time()
    os.kill(pid, signal.SIGKILL)
    system.until(lambda: system.pid(process) not in (None, pid))
    return died


@pytest.mark.parametrize("kind", FaultsBench.kinds)
def test_a_consumer_is_not_told_live_three_periods_after_a_fault(system: System, kind: str) -> None:
    chance = random.Random(kind)
    for process in PROCESSES:
        measured = Measured()
        inject(system, kind, process, measured, FPS, chance)  # type: ignore[arg-type]
        assert measured.missed == 0, (process, measured)
        assert 0 <= measured.stale_ms[0] < 1000


def nursery(system: System) -> psutil.Process | None:
    found = psutil.Process(system.launcher).children()
    return next((child for child in found if child.name() == "nursery"), None)


def test_a_death_right_after_another_is_made_good_as_soon(system: System) -> None:
    for _ in range(2):
        kill(system, "tracker")
        assert system.until_tracking() < SOON_S


def test_without_the_nursery_a_process_is_started_all_the_same(system: System) -> None:
    pid, dead = system.pid("source"), nursery(system)
    assert pid is not None
    assert dead is not None
    dead.kill()
    os.kill(pid, signal.SIGKILL)
    system.until(lambda: system.pid("source") not in (None, pid))
    system.until_tracking()
    assert nursery(system) not in (None, dead)


def test_a_process_that_hangs_is_ended_and_started_again(system: System) -> None:
    pid = system.pid("segmenter")
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    system.until(lambda: system.pid("segmenter") not in (None, pid))
    system.until_tracking()
    assert "the segmenter hung and was killed: nothing was heard of it for 5 s" in system.said


def test_a_process_that_hangs_before_it_is_ready_is_ended_and_started_again(
    system: System,
) -> None:
    kill(system, "tracker")
    pid = system.pid("tracker")
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    system.until(lambda: system.pid("tracker") not in (None, pid))
    system.until_tracking()
    assert system.said.count("the tracker hung and was killed: nothing was heard of it") == 1


def test_a_nursery_that_hangs_is_replaced_when_it_is_needed(system: System) -> None:
    hung = nursery(system)
    assert hung is not None
    hung.suspend()
    kill(system, "source")
    system.until_tracking()
    assert nursery(system) not in (None, hung)
    assert "what starts the processes hung and was killed" in system.said


def test_deaths_lose_neither_threads_nor_more_than_a_second_of_recordings(system: System) -> None:
    """The last one on this system, which it stops."""
    die_at_random(system, 1, most_s=SOON_S)


@pytest.fixture
def start(options: list[str], tmp_path: Path) -> Iterator[Callable[..., System]]:
    systems = list[System]()

    def begin(*more: str) -> System:
        systems.append(System("faults", [*options, *more], tmp_path))
        return systems[-1]

    with private_sockets():
        yield begin
        for running in systems:
            running.stop()


def test_a_spent_budget_ends_the_run_loudly(start: Callable[..., System]) -> None:
    system = start("--restarts", "1")
    system.until_tracking()
    kill(system, "segmenter")
    system.until_tracking()
    pid = system.pid("segmenter")
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(InputError, match="the run ended"):
        system.until(lambda: False)
    assert system.stop() == 1
    last = system.said.strip().splitlines()[-1]
    assert last.startswith("suturetrack run: the segmenter was killed by signal 9; it was started")
    assert "1 times within a minute" in last


def test_what_is_at_fault_in_the_input_is_not_tried_again(start: Callable[..., System]) -> None:
    system = start("--tracking.patience", "3", "--seed", "5", "5")
    with pytest.raises(InputError, match="the run ended"):
        system.until(lambda: False)
    assert system.stop() == 1
    assert "seed (5.0, 5.0)" in system.said.strip().splitlines()[-1]
    assert "started again" not in system.said


@pytest.mark.long
@pytest.mark.parametrize("process", PROCESSES)
def test_a_hundred_deaths(start: Callable[..., System], process: str) -> None:
    die_at_random(start("--restarts", "1000"), 100, (process,))


def restarts(system: System) -> int:
    return system.said.count("it is started again")


def recordings(system: System, processes: tuple[str, ...]) -> int:
    return sum(len(list(system.run_dir.glob(f"{process}*.rrd"))) for process in processes)


def die_at_random(
    system: System, times: int, processes: tuple[str, ...] = PROCESSES, most_s: float = 2.0
) -> None:
    """Kills processes at random moments, and looks at what is left of the run."""
    chance = random.Random(times)
    seen, deaths, back = dict[int, float](), list[tuple[str, float]](), list[float]()
    system.client.watch(
        lambda s: seen.setdefault(s.state.stamp.frame, s.state.stamp.released_ns / 1e9)
    )
    system.until_tracking()
    before, earlier, files = system.client.latest(), restarts(system), recordings(system, processes)
    assert before is not None
    for _ in range(times):
        for process in processes:
            until = time.monotonic() + chance.uniform(0.3, 1.5)
            system.until(lambda until=until: time.monotonic() > until)
            system.until_tracking()
            others = {n: p.pid for n, p in system.processes().items() if n != process}
            deaths.append((process, kill(system, process)))
            back.append(system.until_tracking())
            after = system.client.latest()
            assert after is not None
            assert after.state.thread == before.state.thread == "0"
            assert direction(after) @ direction(before) > 0
            assert abs(after.state.length / before.state.length - 1) < 0.1
            assert others == {n: p.pid for n, p in system.processes().items() if n != process}
            assert f"the {process} was killed by signal 9; it is started again" in system.said
    assert system.stop() == 0
    assert np.percentile(back, 99) < most_s, np.percentile(back, (50, 99, 100))
    folder = RunFolder(system.run_dir)
    assert not [p for p in folder.problems if "is no recording" in p]
    assert restarts(system) == earlier + len(deaths)
    assert len(folder.files) == recordings(system, PROCESSES)
    assert recordings(system, processes) == files + len(deaths)
    for process in ("tracker", "source"):
        recorded = folder.handled(process)
        ends = [when for name, when in deaths if name == process]
        for frame, released in seen.items():
            if frame not in recorded:
                assert any(0 <= when - released <= 1.3 for when in ends), (process, frame)
    statuses = [s.state.status for s in folder.states()]
    assert statuses.count(Status.TRACKING) > 0.5 * len(statuses)

"""The example scripts, and the verbs of an operator, before a running demo."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from suturetrack.stage import open_scene
from tests.conftest import private_sockets

EXAMPLES = Path(__file__).parents[1] / "examples"
SCENE = "figure8-107"


@pytest.fixture(scope="module")
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts Python with these words, beside a running system that has no seed yet."""
    started: list[subprocess.Popen[str]] = []

    def begin(*words: object) -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        command = [sys.executable, *map(str, words)]
        process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)
        started.append(process)
        return process

    source = ("--source", f"stage:{SCENE}", "--loop", 3, "--fps", 10)
    with private_sockets():
        for verb in (("source", *source), ("segmenter",), ("tracker",)):
            begin("-m", "services.cli", *verb)
        yield begin
        for process in started:
            process.kill()
            process.communicate()


def lines(process: subprocess.Popen[str], pattern: str) -> Iterator[re.Match[str]]:
    """Those of the lines that it prints which fit; at most 400 are read."""
    assert process.stdout is not None
    for _, line in zip(range(400), process.stdout, strict=False):
        found = re.search(pattern, line)
        if found is not None:
            yield found
    raise AssertionError(f"no line with {pattern!r}")


def test_the_examples_and_the_verbs_work_on_a_running_system(
    start: Callable[..., subprocess.Popen[str]],
) -> None:
    u, v = (round(x) for x in open_scene(SCENE).seed_pixel(0))
    # The first call waits until the system is ready.
    for _ in range(30):
        nothing = start(EXAMPLES / "seed_by_pixel.py", 5, 5)
        out, err = nothing.communicate(timeout=60)
        assert nothing.returncode == 1
        if "no tracker runs" not in err:
            break
    assert "refused: no thread within" in out
    assert "looks like thread: " in out

    seed = start(EXAMPLES / "seed_by_pixel.py", u, v)
    out, err = seed.communicate(timeout=60)
    assert seed.returncode == 0, err
    assert re.search(r"found [0-9.]+ mm", out)

    watch = start(EXAMPLES / "watch_states.py")
    frames = lines(watch, r"frame (\d+), tracking, ([0-9.]+) mm, .* 0 missed")
    first, second = next(frames), next(frames)
    assert int(second[1]) > int(first[1])
    assert 30 < float(second[2]) < 130

    follow = start(EXAMPLES / "follow_grasp.py")
    next(lines(follow, r"frame \d+: move to \S+ \S+ \+\d+\.\d+ mm"))

    verb = start("-m", "services.cli", "grasp", "--from-end", "10mm", "--watch")
    next(lines(verb, r"frame \d+  position .* mm  quaternion xyzw .* sigma .* age \d+ ms"))
    for process in (watch, follow, verb):
        process.send_signal(signal.SIGINT)
        assert not process.communicate(timeout=60)[1]

    for process in (watch, follow):
        assert process.returncode == 130

    again = start("-m", "services.cli", "seed", u, v)
    out, err = again.communicate(timeout=60)
    assert again.returncode == 0, err
    assert out.startswith("thread 0: found ")
    other = start("-m", "services.cli", "seed", u, v, "--thread", "needle")
    _, err = other.communicate(timeout=60)
    assert (other.returncode, err) == (1, "suturetrack seed: that is thread 0 already\n")
    unknown = start("-m", "services.cli", "grasp", "--fraction", 0.5, "--thread", "x")
    _, err = unknown.communicate(timeout=60)
    assert unknown.returncode == 1
    assert err.endswith("no thread 'x'; there is 0\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("seed_by_pixel.py",), "usage: seed_by_pixel.py U V [left|right] [RIG]"),
        (("seed_by_pixel.py", "a", 3), "could not convert string to float: 'a'"),
        (("watch_states.py", "rig", 3), "usage: watch_states.py [RIG]"),
        (("follow_grasp.py", "a/b"), "rig 'a/b': use 1 to 64 of A-Z a-z 0-9 _ -"),
    ],
)
def test_an_example_that_is_called_wrongly_says_so_in_one_line(
    words: tuple[object, ...], said: str
) -> None:
    name, *others = map(str, words)
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *others], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (1, f"{said}\n")

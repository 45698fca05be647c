"""The operator's page in a real browser, before a running demo."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.run_folder import RunFolder
from suturetrack.stage import open_scene
from tests.browser import EXECUTABLE, Browser, Tab
from tests.conftest import private_sockets

pytestmark = pytest.mark.skipif(EXECUTABLE is None, reason="there is no Chromium")

SCENE = "figure8-107"
GREEN = """(() => {
  const {width, height} = views.%s, dots = views.%s.getContext("2d").getImageData(0, 0, width, height).data;
  let count = 0;
  for (let i = 0; i < dots.length; i += 4)
    if (Math.abs(dots[i] - 70) + Math.abs(dots[i+1] - 220) + Math.abs(dots[i+2] - 138) < 40) count += 1;
  return count;
})()"""
"""How many pixels of a view have the first thread's colour."""


@dataclass
class System:
    url: str
    directory: Path
    processes: dict[str, subprocess.Popen[str]]


@pytest.fixture(scope="module")
def system() -> Iterator[System]:
    """A source that never ends, segmenter, tracker without a seed, and the console."""
    verbs = {
        "console": ("--port", "0"),
        "source": ("--source", f"stage:{SCENE}", "--loop", "3", "--fps", "5"),
        "segmenter": (),
        "tracker": (),
    }
    with private_sockets() as directory:
        processes = {
            name: subprocess.Popen(
                [sys.executable, "-m", "services.cli", name, *options],
                cwd=directory,
                stdout=subprocess.PIPE,
                text=True,
            )
            for name, options in verbs.items()
        }
        output = processes["console"].stdout
        assert output is not None
        yield System(output.readline().strip(), directory, processes)
        for process in processes.values():
            process.kill()
            process.communicate()


def in_browser(flow: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(flow, 120))


async def page(browser: Browser, system: System) -> Tab:
    tab = await browser.tab()
    await tab.open(system.url, 1000, 700)
    await tab.until("Boolean(state.moment && state.images.left)", seconds=60)
    return tab


async def on_screen(tab: Tab, view: str, u: float, v: float) -> tuple[float, float]:
    """Where a pixel of a raw image lies on the page."""
    left, top, width, height = await tab.evaluate(
        f"(b => [b.left, b.top, b.width, b.height])(views.{view}.getBoundingClientRect())"
    )
    return left + (u + 0.5) / 640 * width, top + (v + 0.5) / 480 * height


def places() -> dict[str, tuple[float, float]]:
    """A pixel on the thread in both images of the first frame."""
    scene = open_scene(SCENE)
    points = scene.truth(0)[0].points
    u, v = scene.seed_pixel(0)
    left, right = scene.rig.project_raw(points)
    nearest = int(np.argmin(np.linalg.norm(left - [u, v], axis=1)))
    return {"left": (u, v), "right": (float(right[nearest][0]), float(right[nearest][1]))}


def off_the_thread_px(pixels: list[list[float]]) -> float:
    """The largest distance of drawn pixels from where the thread is in any frame of the loop."""
    scene = open_scene(SCENE)
    line = np.concatenate([scene.rig.project_raw(scene.truth(i)[0].points)[0] for i in range(3)])
    apart = np.linalg.norm(np.array(pixels)[:, None] - line, axis=2)
    return float(apart.min(axis=1).max())


TRACKED = "known().length === 1 && known()[0].status === 'tracking' && known()[0].left.length > 9"


def test_a_click_seeds_and_the_curve_appears_on_every_page(system: System, tmp_path: Path) -> None:
    async def flow() -> None:
        async with Browser() as browser:
            tab, other = await page(browser, system), await page(browser, system)
            assert await tab.evaluate("known().length") == 0
            await tab.until("$('link').textContent.includes('click on a thread')")

            await tab.click(*await on_screen(tab, "left", 6, 6))
            await tab.until("$('message').className === 'bad'")
            assert "no thread within" in await tab.evaluate("$('message').textContent")
            assert await tab.evaluate("state.trouble[0].pixels.length") > 0
            assert await tab.evaluate(GREEN % ("left", "left")) == 0

            u, v = places()["left"]
            await tab.move(*await on_screen(tab, "left", u + 2, v + 2))
            snapped = await tab.until("state.snap && state.snap.pixel")
            assert np.hypot(snapped[0] - u, snapped[1] - v) < 6
            await tab.click(*await on_screen(tab, "left", u + 2, v + 2))
            for each in (tab, other):
                await each.until(TRACKED)
                for view in ("left", "right"):
                    await each.until(GREEN % (view, view), lambda count: count > 200)
            assert off_the_thread_px(await tab.evaluate("known()[0].left")) < 6
            await tab.until("$('link').textContent", lambda text: text == "live")
            await tab.screenshot(tmp_path / "tracked.png")

            await tab.key("g")
            await other.until("state.moment.grasp && !state.moment.grasp.reason")
            assert await other.evaluate("$('grasp').checked")
            await other.key("r")
            for each in (tab, other):
                await each.until("known().length === 0")
            assert tab.complaints == other.complaints == []

    in_browser(flow())


def test_the_right_image_a_box_and_the_keyboard_seed_too_and_what_follows_is_recorded(
    system: System,
) -> None:
    async def flow() -> None:
        async with Browser() as browser:
            tab, other = await page(browser, system), await page(browser, system)
            await tab.click(*await on_screen(tab, "right", *places()["right"]))
            await tab.until(TRACKED)
            await tab.key("r")
            await tab.until("known().length === 0")

            u, v = places()["left"]
            corner, opposite = (u - 40, v - 40), (u + 40, v + 40)
            await tab.drag(
                await on_screen(tab, "left", *corner), await on_screen(tab, "left", *opposite)
            )
            await tab.until(TRACKED)
            await tab.key("r")
            await tab.until("known().length === 0")

            await tab.move(2, 2)
            await tab.evaluate("views.left.focus()")
            await tab.evaluate(f"state.aim = {{view: 'left', u: {u + 1}, v: {v - 8}}}")
            await tab.key("ArrowDown")
            await tab.key("Enter")
            await tab.until(TRACKED)
            await tab.key("s")
            folder = Path(await tab.until("state.moment.recording"))
            await tab.until("$('record').getAttribute('aria-pressed') === 'true'")
            await other.until("$('record').textContent.startsWith('Recording')")
            written = system.directory / folder
            while len(list(written.glob("*.rrd"))) < 3 or not RunFolder(written).states():
                await asyncio.sleep(0.2)
            await other.key("s")
            await tab.until("!state.moment.recording")
            await other.until("$('message').textContent.startsWith('Recorded')")
            assert not RunFolder(written).problems
            assert RunFolder(written).states()

            await tab.key("n")
            assert await tab.evaluate("state.chosen") == "1"
            await tab.key("1")
            assert await tab.evaluate("state.chosen") == "0"
            assert tab.complaints == []

    in_browser(flow())


def test_a_stopped_source_shows_as_stale_and_a_dead_console_as_lost(system: System) -> None:
    async def flow() -> None:
        async with Browser() as browser:
            tab = await page(browser, system)
            await tab.click(*await on_screen(tab, "left", *places()["left"]))
            await tab.until(TRACKED)
            system.processes["source"].send_signal(signal.SIGSTOP)
            await tab.until("document.body.dataset.link", lambda link: link == "stale")
            await tab.until("known()[0].stale")
            system.processes["source"].send_signal(signal.SIGCONT)
            await tab.until("document.body.dataset.link", lambda link: link == "live")
            system.processes["console"].terminate()
            await tab.until("document.body.dataset.link", lambda link: link == "lost")
            assert system.processes["console"].wait(10) == 0

    in_browser(flow())

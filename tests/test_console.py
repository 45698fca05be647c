"""The operator's page: what it is sent, what it may ask, and who may open it."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer

from services import topics
from services.bus import Bus
from services.console.feed import Feed
from services.console.recording import Recording
from services.console.server import Console, serve
from services.memory_transport import Hub
from services.messages import Forgotten, SeedReply
from services.wire import scaled
from suturetrack import nurbs
from suturetrack.camera import StereoRig
from suturetrack.types import (
    Energies,
    InputError,
    Nurbs,
    RidgeField,
    Seed,
    Stamp,
    Status,
    StereoFrame,
    ThreadState,
)
from tests.conftest import wait_until
from tests.painting import paint, thread

PERIOD_NS = 33_333_333


class Stage:
    """Source and tracker in one, at their own pace, and a feed."""

    def __init__(self, rig: StereoRig, curve: Nurbs):
        hub = Hub()
        self.rig = rig
        self.system, feed = Bus(hub.connect(), "rig", "all"), Bus(hub.connect(), "rig", "console")
        # One bus plays the processes; their names are what others wait for.
        self.names = [Bus(hub.connect(), "rig", name) for name in ("source", "tracker")]
        for bus in self.names:
            bus.declare_alive()
        self.system.answer(topics.CALIBRATION, lambda _: self.rig)
        self.system.answer(topics.SEED, self.find)
        self.system.answer(topics.FORGET, lambda f: Forgotten(f.thread, True))
        self.feed = Feed(feed, Recording("rig", None))
        self.seeds: list[Seed] = []
        self.silent = threading.Event()
        self.ridges: RidgeField | None = None
        self.state = ThreadState(
            Stamp(0, 0, 0, PERIOD_NS),
            "0",
            Status.TRACKING,
            curve,
            nurbs.length(curve),
            Energies(-0.8, -0.7, -0.1, 3.0),
            np.full(64, 0.1),
            np.arange(64) < 48,
        )
        self.thread = threading.Thread(target=self.play, daemon=True)
        self.thread.start()

    def find(self, seed: Seed) -> SeedReply:
        self.seeds.append(seed)
        if seed.pixel is not None and seed.pixel[0] < 10:
            return SeedReply(seed.thread, False, "no ridge there", candidates=((50.0, 60.0),))
        return SeedReply(seed.thread, True, "found 100.0 mm")

    def play(self) -> None:
        number = 0
        while not self.system.stop.wait(PERIOD_NS / 1e9):
            if self.silent.is_set():
                continue
            number += 1
            stamp = Stamp(number, number * PERIOD_NS, time.time_ns(), PERIOD_NS)
            left = np.full((480, 640, 3), number % 256, np.uint8)
            self.system.publish(topics.FRAME, StereoFrame(stamp, left, left))
            if self.ridges is not None:
                self.system.publish(topics.FIELD, replace(self.ridges, stamp=stamp))
            state = scaled(replace(self.state, stamp=stamp), self.rig.metres_per_unit)
            self.system.publish(topics.STATE, state)

    def close(self) -> None:
        for bus in (self.system, self.feed.bus, *self.names):
            bus.close()
        self.thread.join(10)


@pytest.fixture
def stage(rig: StereoRig, curve: Nurbs) -> Iterator[Stage]:
    stage = Stage(rig, curve)
    yield stage
    stage.close()


@asynccontextmanager
async def opened(stage: Stage, token: str = "") -> AsyncIterator[TestClient[Any, Any]]:
    console = Console(stage.feed, token)
    async with TestClient(TestServer(console.app())) as client:
        yield client
        await console.close()


class Page:
    """What a page does, without drawing."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse):
        self.socket = socket
        self.images: list[bytes] = []

    async def moment(self) -> dict[str, Any]:
        """The next moment; answers in between are passed over."""
        while True:
            message = await self.socket.receive(timeout=20)
            if message.type != aiohttp.WSMsgType.BINARY:
                assert message.type == aiohttp.WSMsgType.TEXT, message
                continue
            size = int.from_bytes(message.data[:4], "little")
            header: dict[str, Any] = json.loads(message.data[4 : 4 + size])
            self.images, at = [], 4 + size
            for length in header["images"]:
                self.images.append(message.data[at : at + length])
                at += length
            assert at == len(message.data)
            await self.order("shown")
            return header

    async def moment_with(self, fits: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        for _ in range(200):
            moment = await self.moment()
            if fits(moment):
                return moment
        raise AssertionError(f"it never came: {moment}")

    async def order(self, kind: str, **fields: Any) -> None:
        await self.socket.send_json({"type": kind, **fields})

    async def answer(self, kind: str, **fields: Any) -> dict[str, Any]:
        await self.order(kind, **fields)
        while True:
            message = await self.socket.receive(timeout=20)
            if message.type == aiohttp.WSMsgType.TEXT:
                answer: dict[str, Any] = json.loads(message.data)
                return answer


def test_a_moment_holds_both_images_and_the_curve_on_them(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage) as client, client.ws_connect("/live") as socket:
            page = Page(socket)
            moment = await page.moment_with(lambda m: m["threads"] and len(m["images"]) == 2)
            left, right = (cv2.imdecode(np.frombuffer(i, np.uint8), 1) for i in page.images)
            assert left is not None
            assert right is not None
            assert left.shape == right.shape == (480, 640, 3)
            assert moment["size"] == [640, 480]
            (shown,) = moment["threads"]
            assert abs(float(left.mean()) - moment["frame"] % 256) < 3
            assert shown["frame"] >= moment["frame"]
            assert shown["length_mm"] == pytest.approx(stage.state.length)
            assert (shown["status"], shown["stale"]) == ("tracking", "")
            assert 0.7 < shown["seen"] < 0.8
            assert stage.state.curve is not None
            points = nurbs.evaluate(stage.state.curve, np.linspace(0, 1, len(shown["left"])))
            for view, pixels in zip(("left", "right"), stage.rig.project_raw(points), strict=True):
                np.testing.assert_allclose(shown[view], pixels, atol=0.06)
            assert 0.7 < np.mean(shown["visible"]) < 0.8

    asyncio.run(flow())


def test_two_pages_see_the_same_and_a_slow_one_gets_only_the_newest(stage: Stage) -> None:
    async def flow() -> None:
        async with (
            opened(stage) as client,
            client.ws_connect("/live") as one,
            client.ws_connect("/live") as other,
        ):
            fast, slow = Page(one), Page(other)
            first = await slow.moment_with(lambda m: m["frame"])
            newest = first
            while newest["frame"] is None or newest["frame"] < first["frame"] + 30:
                newest = await fast.moment()
            # One moment had been sent to the slow page; the next one is no older than the fast page's.
            await slow.moment()
            later = await slow.moment_with(lambda m: m["frame"])
            assert later["frame"] >= newest["frame"]

    asyncio.run(flow())


def test_the_grasp_is_marked_on_every_page_and_refused_where_nothing_is_seen(stage: Stage) -> None:
    async def flow() -> None:
        async with (
            opened(stage) as client,
            client.ws_connect("/live") as one,
            client.ws_connect("/live") as other,
        ):
            first, second = Page(one), Page(other)
            await first.order("grasp", thread="0", fraction=0.25)
            for page in (first, second):
                moment = await page.moment_with(lambda m: m["grasp"] and not m["grasp"]["reason"])
                (shown,) = moment["threads"]
                at = np.array(moment["grasp"]["left"][0])
                assert np.linalg.norm(np.array(shown["left"]) - at, axis=1).min() < 3
            await first.order("grasp", thread="0", fraction=0.95)
            await second.moment_with(lambda m: "not seen" in m["grasp"]["reason"])
            await first.order("grasp", thread="7", fraction=0.5)
            await second.moment_with(lambda m: "no thread" in m["grasp"]["reason"])
            await first.order("grasp", thread="0", fraction=None)
            await second.moment_with(lambda m: m["grasp"] is None)

    asyncio.run(flow())


def test_silence_shows_as_stale(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage) as client, client.ws_connect("/live") as socket:
            page = Page(socket)
            await page.order("grasp", thread="0", fraction=0.25)
            await page.moment_with(lambda m: m["threads"] and not m["threads"][0]["stale"])
            stage.silent.set()
            moment = await page.moment_with(lambda m: m["threads"][0]["stale"])
            assert moment["grasp"]["reason"] == moment["threads"][0]["stale"]
            stage.silent.clear()
            await page.moment_with(lambda m: not m["threads"][0]["stale"])

    asyncio.run(flow())


def test_a_click_seeds_and_one_on_nothing_is_told(stage: Stage) -> None:
    line = thread(0.3)
    stage.ridges = paint(stage.rig, [line], 0)
    left, right = (pixels[300] for pixels in stage.rig.project(line))

    async def flow() -> None:
        async with opened(stage) as client, client.ws_connect("/live") as socket:
            page = Page(socket)
            await page.moment_with(lambda m: m["frame"])
            for view, (u, v) in (("left", left), ("right", right)):
                at = {"view": view, "u": u + 2, "v": v - 2}
                snap = await page.answer("snap", **at)
                assert np.hypot(snap["pixel"][0] - u, snap["pixel"][1] - v) < 5
                assert len(snap["segment"]) > 20
                answer = await page.answer("seed", thread=view, **at)
                assert (answer["accepted"], answer["text"]) == (True, "found 100.0 mm")
                assert answer["asked"]["thread"] == view
            by_pixel, by_point = stage.seeds
            assert by_pixel.pixel == (left[0] + 2, left[1] - 2)
            assert by_point.point is not None
            where = stage.rig.project(np.array(by_point.point) / stage.rig.metres_per_unit)[1]
            assert np.linalg.norm(where - right) < 5
            nothing = await page.answer("seed", thread="0", view="left", u=5, v=5)
            assert (nothing["accepted"], nothing["text"]) == (False, "no ridge there")
            assert nothing["candidates"] == [[50, 60]]
            refused = await page.answer("seed", thread="0", view="right", u=620, v=20)
            assert "no thread there" in refused["text"]
            assert refused["candidates"]
            box = [[left[0] - 20, left[1] - 20], [left[0] + 20, left[1] + 20]]
            boxed = await page.answer("snap-box", view="left", corners=box)
            assert np.linalg.norm(np.array(boxed["pixel"]) - left) < 30
            empty = await page.answer("snap-box", view="left", corners=[[0, 0], [20, 20]])
            assert empty["pixel"] is None
            none = await page.answer("record", on=False)
            assert (none["answer"], none["text"]) == ("error", "nothing is recorded")
            gone = await page.answer("forget", thread="0")
            assert gone["accepted"]

    asyncio.run(flow())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"type": "shutdown"}',
        '{"type": "seed", "thread": "a/b", "view": "left", "u": 1, "v": 1}',
        '{"type": "seed", "thread": "a", "view": "top", "u": 1, "v": 1}',
        '{"type": "snap", "view": "left", "u": 1e300, "v": 1}',
        '{"type": "snap", "view": "left", "u": "1", "v": 1}',
        '{"type": "snap-box", "view": "left", "corners": [[1, 2, 3], [1]]}',
        '{"type": "grasp", "thread": "0", "fraction": 2}',
    ],
)
def test_nonsense_is_answered_and_the_page_stays_open(stage: Stage, text: str) -> None:
    async def flow() -> None:
        async with opened(stage) as client, client.ws_connect("/live") as socket:
            await socket.send_str(text)
            while True:
                message = await socket.receive(timeout=20)
                if message.type == aiohttp.WSMsgType.TEXT:
                    assert json.loads(message.data)["answer"] == "error"
                    break
                assert message.type == aiohttp.WSMsgType.BINARY
            await Page(socket).order("shown")
            await Page(socket).moment()

    asyncio.run(flow())


async def status(client: TestClient[Any, Any], path: str, **headers: str) -> int:
    async with client.get(path, headers=headers) as answer:
        return answer.status


def test_no_other_site_gets_in(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage) as client:
            here = f"http://127.0.0.1:{client.port}"
            assert await status(client, "/") == 200
            assert await status(client, "/page.js") == 200
            assert await status(client, "/live", Origin="http://evil.example") == 403
            assert await status(client, "/", Host="evil.example") == 403
            for port in ("99999999", "abc"):
                assert await status(client, "/", Host=f"localhost:{port}") == 400
            async with client.ws_connect("/live", headers={"Origin": here}):
                pass

    asyncio.run(flow())


def test_a_port_that_is_taken_is_said_in_one_line(stage: Stage) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        words = f"^cannot serve on 127.0.0.1:{port}: Address already in use; give another --port"
        with pytest.raises(InputError, match=words):
            serve(stage.feed, "127.0.0.1", port, "")


def test_what_is_printed_opens_also_where_every_address_is_served(
    stage: Stage, capsys: pytest.CaptureFixture[str]
) -> None:
    def said() -> str:
        nonlocal printed
        printed += capsys.readouterr().out
        return printed

    async def opens(url: str) -> bool:
        async with aiohttp.request("GET", url) as answer:
            return answer.status == 200

    printed, arguments = "", (stage.feed, "0.0.0.0", 0, "secret")
    server = threading.Thread(target=serve, args=arguments, daemon=True)
    server.start()
    wait_until(lambda: said().count("\n") == 2, tell=said)
    here, there = printed.split()
    assert here.startswith("http://localhost:")
    assert there == here.replace("localhost", socket.gethostname())
    assert asyncio.run(opens(here))
    stage.feed.bus.stop.set()
    server.join(20)
    assert not server.is_alive()


def test_no_stranger_gets_in(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage, token="secret") as client:
            assert await status(client, "/", Host="rig.lab") == 200
            assert await status(client, "/live") == 403
            assert await status(client, "/live?token=wrong") == 403
            assert await status(client, "/live?token=secret", Origin="http://evil.example") == 403
            async with client.ws_connect("/live?token=secret"):
                pass

    asyncio.run(flow())


def test_only_so_many_pages_may_be_open(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage) as client:
            for _ in range(8):
                await client.ws_connect("/live")
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                await client.ws_connect("/live")

    asyncio.run(flow())


def test_images_are_made_only_while_somebody_looks(stage: Stage) -> None:
    async def flow() -> None:
        async with opened(stage) as client:
            async with client.ws_connect("/live") as socket:
                page = Page(socket)
                await page.moment_with(lambda m: m["frame"])
            while stage.feed.watched.is_set():
                await asyncio.sleep(0.01)
            delivered: list[bytes] = []
            stage.feed.deliver = delivered.append
            await asyncio.sleep(0.3)
            assert len(delivered) <= 1

    asyncio.run(flow())


BEGINS = """
folder = pathlib.Path(sys.argv[sys.argv.index("--run-dir") + 1])
folder.mkdir(parents=True)
(folder / "source.rrd").touch()
"""
SLOW = f"""
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
pathlib.Path("started").touch()
while not pathlib.Path("go").exists():
    time.sleep(0.01)
{BEGINS}
signal.pause()
"""
TALKER = f"""
signal.signal(signal.SIGINT, lambda *_: sys.exit("record: the disk is full"))
sys.stderr.write(1_000_000 * "a warning\\n")
{BEGINS}
signal.pause()
"""
FAILS = 'sys.exit("record: the disk is full")'
Recorder = Callable[[str], Recording]


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """A recording by a child that does what it is told here."""

    def make(text: str) -> Recording:
        program = tmp_path / "program"
        program.write_text(f"#!{sys.executable}\nimport pathlib, signal, sys, time\n{text}")
        program.chmod(0o700)
        monkeypatch.setattr(sys, "executable", str(program))
        monkeypatch.chdir(tmp_path)
        return Recording("rig", None)

    return make


def test_a_recording_is_claimed_and_completed_when_it_has_begun(recorder: Recorder) -> None:
    recording = recorder(SLOW)
    with ThreadPoolExecutor() as workers:
        started = workers.submit(recording.start)
        wait_until(Path("started").exists)
        with pytest.raises(InputError, match="begins or ends already"):
            recording.start()
        assert recording.folder is None
        assert not recording.problem
        stopped = workers.submit(recording.stop)
        Path("go").touch()
        folder = started.result(20)
        assert any(folder.glob("*.rrd"))
        assert stopped.result(20) == folder


def test_a_recording_that_ends_before_it_begins_says_why(recorder: Recorder) -> None:
    recording = recorder(FAILS)
    with pytest.raises(InputError, match="failed: record: the disk is full"):
        recording.start()


def test_a_recording_that_does_not_begin_is_told(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.console.recording._BEGIN_S", 0.1)
    recording = recorder(SLOW)
    with pytest.raises(InputError, match=r"did not begin; does a source run\?"):
        recording.start()
    with pytest.raises(InputError, match="nothing is recorded"):
        recording.stop()


def test_who_closes_waits_for_no_beginning(recorder: Recorder) -> None:
    recording = recorder(SLOW)
    with ThreadPoolExecutor() as workers:
        started = workers.submit(recording.start)
        wait_until(Path("started").exists)
        recording.close()
        assert isinstance(started.exception(10), InputError)


def test_a_recording_may_say_much_and_its_last_word_is_told(recorder: Recorder) -> None:
    recording = recorder(TALKER)
    recording.start()
    with pytest.raises(InputError, match="failed: record: the disk is full"):
        recording.stop()


def test_a_recording_that_ended_by_itself_says_why(recorder: Recorder) -> None:
    recording = recorder(BEGINS + FAILS)
    assert not recording.problem
    recording.start()
    wait_until(lambda: recording.problem.endswith("failed: record: the disk is full"))
    assert recording.folder is None
    with pytest.raises(InputError, match="the disk is full"):
        recording.stop()


def test_a_source_that_comes_back_may_have_another_calibration(stage: Stage) -> None:
    stage.feed.start()
    stage.feed.watched.set()
    wait_until(lambda: stage.feed.rig is not None)
    stage.silent.set()
    stage.rig = replace(stage.rig, metres_per_unit=0.5)
    wait_until(lambda: stage.feed.rig is not None and stage.feed.rig.metres_per_unit == 0.5)

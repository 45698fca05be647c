"""A headless Chromium, driven over its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import itertools
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import aiohttp

EXECUTABLE = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chrome")
_OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio")


class Tab:
    """One page."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse):
        self._socket = socket
        self._ids = itertools.count()
        self.complaints: list[str] = []
        """Exceptions and errors of the page."""

    async def call(self, method: str, **parameters: Any) -> Any:
        number = next(self._ids)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            message = await self._socket.receive_json(timeout=30)
            if message.get("method") == "Runtime.exceptionThrown":
                self.complaints.append(str(message["params"]["exceptionDetails"]))
            entry = message.get("params", {}).get("entry", {})
            if message.get("method") == "Log.entryAdded" and entry["level"] == "error":
                self.complaints.append(entry["text"])
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]

    async def open(self, url: str, width: int = 1600, height: int = 1000) -> None:
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.resize(width, height)
        await self.call("Page.navigate", url=url)
        loaded = "document.readyState === 'complete' && location.href !== 'about:blank'"
        await self.until(loaded)

    async def resize(self, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        await self.call("Emulation.setDeviceMetricsOverride", **size)

    async def evaluate(self, script: str) -> Any:
        answer = await self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def until(
        self, script: str, fits: Callable[[Any], object] = bool, seconds: float = 30
    ) -> Any:
        deadline = time.monotonic() + seconds
        while not fits(value := await self.evaluate(script)):
            assert time.monotonic() < deadline, f"{script} stayed {value!r}"
            await asyncio.sleep(0.05)
        return value

    async def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        await self.call(
            "Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button="left", **more
        )

    async def move(self, x: float, y: float) -> None:
        await self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    async def click(self, x: float, y: float) -> None:
        await self.move(x, y)
        await self.mouse("Pressed", x, y, clickCount=1)
        await self.mouse("Released", x, y, clickCount=1)

    async def drag(self, start: tuple[float, float], stop: tuple[float, float]) -> None:
        await self.move(*start)
        await self.mouse("Pressed", *start, clickCount=1)
        for share in (0.3, 0.6, 1.0):
            x, y = (a + share * (b - a) for a, b in zip(start, stop, strict=True))
            await self.mouse("Moved", x, y, buttons=1)
        await self.mouse("Released", *stop, clickCount=1)

    async def key(self, key: str) -> None:
        text = {"text": key} if len(key) == 1 else {}
        await self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    async def screenshot(self, path: Path) -> None:
        picture = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(picture["data"]))


class Browser:
    """Chromium with a profile of its own; ends with the block."""

    def __init__(self) -> None:
        assert EXECUTABLE is not None
        self._profile = Path(tempfile.mkdtemp(prefix="chromium-"))
        options = (*_OPTIONS, "--remote-debugging-port=0", f"--user-data-dir={self._profile}")
        self._process = subprocess.Popen(
            [EXECUTABLE, *options, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    async def __aenter__(self) -> Self:
        self._session = aiohttp.ClientSession()
        port_file = self._profile / "DevToolsActivePort"
        deadline = time.monotonic() + 60
        while not port_file.exists() or "\n" not in port_file.read_text():
            assert time.monotonic() < deadline, "chromium did not start"
            assert self._process.poll() is None, "chromium ended"
            await asyncio.sleep(0.05)
        self._port = port_file.read_text().split()[0]
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._session.close()
        self._process.terminate()
        self._process.wait(10)
        shutil.rmtree(self._profile, ignore_errors=True)

    async def tab(self) -> Tab:
        url = f"http://127.0.0.1:{self._port}/json/new?about:blank"
        async with self._session.put(url) as answer:
            target = (await answer.json())["webSocketDebuggerUrl"]
        return Tab(await self._session.ws_connect(target, max_msg_size=0))

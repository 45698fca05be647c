"""The page and its one connection: moments out, what the operator does in."""

from __future__ import annotations

import asyncio
import hmac
import os
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from socket import gethostname
from typing import Annotated, Any

import msgspec
from aiohttp import WSMsgType, web

from services.console.feed import Feed, View
from suturetrack.grasping import GraspPoint
from suturetrack.types import InputError

_MOST_PAGES = 8
_MOST_ORDERS = 4
_LARGEST_ORDER = 4096
_PARTS = {"/": "page.html", "/page.css": "page.css", "/page.js": "page.js"}
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
_EVERY = ("0.0.0.0", "::")
_LOCAL = ("127.0.0.1", "localhost", "::1")

Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Name = Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_-]{1,64}$")]


class Snap(msgspec.Struct, tag="snap", frozen=True):
    """Where would this click land?"""

    view: View
    u: Number
    v: Number


class SnapBox(msgspec.Struct, tag="snap-box", frozen=True):
    """Which thread is in this box?"""

    view: View
    corners: Annotated[
        list[Annotated[list[Number], msgspec.Meta(min_length=2, max_length=2)]],
        msgspec.Meta(min_length=2, max_length=2),
    ]


class Seed(msgspec.Struct, tag="seed", frozen=True):
    """Look for a thread here."""

    thread: Name
    view: View
    u: Number
    v: Number


class Forget(msgspec.Struct, tag="forget", frozen=True):
    """Follow this thread no more."""

    thread: Name


class Record(msgspec.Struct, tag="record", frozen=True):
    """Start a recording, or complete it."""

    on: bool


class Grasp(msgspec.Struct, tag="grasp", frozen=True):
    """Show the pose at this part of the thread; None hides it."""

    thread: Name
    fraction: Annotated[float, msgspec.Meta(ge=0, le=1)] | None


class Shown(msgspec.Struct, tag="shown", frozen=True):
    """The page has drawn the last moment and takes the next one."""


Asked = Snap | SnapBox | Seed | Forget | Record
Order = Asked | Grasp | Shown
_ORDERS: msgspec.json.Decoder[Order] = msgspec.json.Decoder(Order)


class Page:
    """One open page: gets the newest moment whenever it has drawn the last one."""

    def __init__(self, socket: web.WebSocketResponse):
        self.socket = socket
        self.drawn = asyncio.Event()
        self.drawn.set()
        self.fresh = asyncio.Event()
        self.moment = b""
        self.orders: set[asyncio.Task[None]] = set()

    def offer(self, moment: bytes) -> None:
        """Takes a moment in place of one that was not sent yet."""
        self.moment = moment
        self.fresh.set()

    async def send(self) -> None:
        """Sends for as long as the page is open."""
        while not self.socket.closed:
            await self.drawn.wait()
            await self.fresh.wait()
            self.drawn.clear()
            self.fresh.clear()
            await self.socket.send_bytes(self.moment)


class Console:
    """The routes, and the pages that are open."""

    def __init__(self, feed: Feed, token: str):
        self._feed = feed
        self._token = token
        self._pages: set[Page] = set()
        self._workers = ThreadPoolExecutor(4, "console")

    def app(self) -> web.Application:
        """The application."""
        app = web.Application(middlewares=[self._guard])
        for path in _PARTS:
            app.router.add_get(path, _part)
        app.router.add_get("/live", self._live)
        loop = asyncio.get_running_loop()
        self._feed.deliver = lambda moment: _call(loop, self._broadcast, moment)
        self._feed.start()
        return app

    async def close(self) -> None:
        """Tells all pages good-bye."""
        for page in list(self._pages):
            await page.socket.close(message=b"the console ended")
        self._workers.shutdown(wait=False, cancel_futures=True)

    def _broadcast(self, moment: bytes) -> None:
        for page in self._pages:
            page.offer(moment)

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Only pages of this server may connect: no other site in the operator's browser."""
        try:
            host = request.url.host or ""
        except ValueError as error:
            raise web.HTTPBadRequest(text="the Host of the request is no address") from error
        if not self._token and host not in _LOCAL:
            raise web.HTTPForbidden(text="this console serves this machine only")
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="another site may not connect to the console")
        given = request.query.get("token", "")
        if request.path == "/live" and not hmac.compare_digest(
            given.encode(), self._token.encode()
        ):
            raise web.HTTPForbidden(text="the token is missing or wrong")
        response: web.StreamResponse = await handler(request)
        return response

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._pages) >= _MOST_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{_MOST_PAGES} pages are open already")
        socket = web.WebSocketResponse(heartbeat=5, max_msg_size=_LARGEST_ORDER)
        await socket.prepare(request)
        page = Page(socket)
        self._pages.add(page)
        self._feed.watched.set()
        sender = asyncio.create_task(page.send())
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    await self._take(page, message.data)
        finally:
            sender.cancel()
            self._pages.discard(page)
            if not self._pages:
                self._feed.watched.clear()
        return socket

    async def _take(self, page: Page, text: str) -> None:
        try:
            order = _ORDERS.decode(text)
        except msgspec.MsgspecError as error:
            await page.socket.send_json({"answer": "error", "text": str(error)})
            return
        if isinstance(order, Shown):
            page.drawn.set()
        elif isinstance(order, Grasp):
            where = None if order.fraction is None else GraspPoint(fraction=order.fraction)
            self._feed.grasp = None if where is None else (order.thread, where)
        else:
            await self._begin(page, order)

    async def _begin(self, page: Page, order: Asked) -> None:
        """Answers beside the images, which go on meanwhile."""
        if len(page.orders) >= _MOST_ORDERS:
            await page.socket.send_json({"answer": "error", "text": "one after the other, please"})
            return

        async def answer() -> None:
            loop = asyncio.get_running_loop()
            found = await loop.run_in_executor(self._workers, self._answer, order)
            if not page.socket.closed:
                await page.socket.send_json(found)

        task = asyncio.create_task(answer())
        page.orders.add(task)
        task.add_done_callback(page.orders.discard)

    def _answer(self, order: Asked) -> dict[str, Any]:
        try:
            if isinstance(order, Snap):
                found = self._feed.snap(order.view, order.u, order.v)
            elif isinstance(order, SnapBox):
                found = self._feed.snap_box(order.view, order.corners)
            elif isinstance(order, Record):
                found = self._feed.record(on=order.on)
            elif isinstance(order, Forget):
                found = self._feed.forget(order.thread)
            else:
                found = self._feed.seed(order.thread, order.view, order.u, order.v)
        except InputError as error:
            return {"answer": "error", "text": str(error)}
        asked = msgspec.to_builtins(order)
        return {"answer": asked["type"], "asked": asked, **found}


def serve(feed: Feed, host: str, port: int, token: str) -> None:
    """Serves until the bus is asked to stop; raises InputError when the address is not free."""
    asyncio.run(_serve(feed, host, port, token))


async def _serve(feed: Feed, host: str, port: int, token: str) -> None:
    console = Console(feed, token)
    runner = web.AppRunner(console.app(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, host, port).start()
    except OSError as error:
        await runner.cleanup()
        raise InputError(
            f"cannot serve on {host}:{port}: {os.strerror(error.errno or 0)}; "
            "give another --port or --host"
        ) from error
    address, port = runner.addresses[0][:2]
    # A browser opens no address that stands for all of a machine's.
    names = ["localhost", gethostname()] if address in _EVERY else [host]
    for name in names:
        where = f"[{name}]" if ":" in name else name
        print(f"http://{where}:{port}/" + (f"?token={token}" if token else ""), flush=True)
    while not feed.bus.stop.is_set:
        await asyncio.sleep(0.05)
    await console.close()
    await runner.cleanup()


async def _part(request: web.Request) -> web.Response:
    name = _PARTS[request.path]
    text = (files("services.console") / name).read_text(encoding="utf-8")
    headers = {
        "Cache-Control": "no-cache",
        "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
    }
    return web.Response(text=text, content_type=_TYPES[name.rpartition(".")[2]], headers=headers)


def _call(loop: asyncio.AbstractEventLoop, function: Any, argument: bytes) -> None:
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, argument)

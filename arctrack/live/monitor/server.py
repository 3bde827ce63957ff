"""HTTP server of the page, its WebSocket, and its interface for other programs."""

import asyncio
import json
import math
import time
from importlib.resources import files

from aiohttp import web
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from arctrack.live.monitor.access import Access
from arctrack.live.monitor.connections import Connections
from arctrack.live.monitor.feed import Feed
from arctrack.live.monitor.health import health_problem
from arctrack.live.monitor.metrics import registry_of
from arctrack.live.monitor.outbox import Outbox
from arctrack.live.monitor.saver import Saver

MAX_BROWSERS = 32

STATIC = {
    "page.html": "text/html",
    "page.css": "text/css",
    "page.js": "text/javascript",
    "charts.js": "text/javascript",
    "picture.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Server": "arctrack",
}
SAVES_APART_S = 10.0
"""Least time between two saves, s: the second one reaches back to the first, and no disk fills in minutes."""


class Server:
    """HTTP and WebSocket server of the page."""

    def __init__(self, feed: Feed, access: Access, saver: Saver) -> None:
        self._feed, self._access, self._saver = feed, access, saver
        self.connections = Connections()
        self._saved_s = -math.inf
        self._registry = registry_of(feed)
        self._sockets: set[web.WebSocketResponse] = set()
        folder = files("arctrack.live.monitor") / "static"
        self._files = {name: (folder / name).read_bytes() for name in STATIC}

    def app(self) -> web.Application:
        """Return the application."""
        app = web.Application(middlewares=[self.connections.watch, self._access.guard])
        app.router.add_get("/", self._page)
        app.router.add_get("/static/{name}", self._static)
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/frame.jpg", self._frame)
        app.router.add_get("/status.json", self._status)
        app.router.add_get("/metrics", self._metrics)
        app.router.add_get("/health", self._health)
        app.router.add_post("/black_box", self._black_box)
        app.on_response_prepare.append(_add_headers)
        app.on_shutdown.append(self._close_sockets)
        return app

    async def _page(self, _request: web.Request) -> web.Response:
        return self._file("page.html")

    async def _static(self, request: web.Request) -> web.Response:
        return self._file(request.match_info["name"])

    def _file(self, name: str) -> web.Response:
        if name not in STATIC:
            raise web.HTTPNotFound
        return web.Response(body=self._files[name], content_type=STATIC[name], charset="utf-8")

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if self._feed.browsers >= MAX_BROWSERS:
            raise web.HTTPServiceUnavailable(text=f"{MAX_BROWSERS} browsers show the page: close one")
        # A browser has nothing to say; one that answers no ping is gone.
        socket = web.WebSocketResponse(heartbeat=10.0, compress=False, max_msg_size=1024)
        await socket.prepare(request)
        outbox = Outbox()
        self._feed.join(outbox)
        self._sockets.add(socket)
        sending = asyncio.create_task(_send_all(outbox, socket))
        try:
            async for _ in socket:
                pass
        finally:
            self._feed.leave(outbox)
            self._sockets.discard(socket)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        return socket

    async def _frame(self, _request: web.Request) -> web.Response:
        picture = await self._feed.picture()
        if picture is None:
            raise web.HTTPServiceUnavailable(text="no frame has come yet")
        return web.Response(body=picture.jpeg, content_type="image/jpeg")

    async def _status(self, _request: web.Request) -> web.Response:
        return web.Response(text=self._feed.status_text(), content_type="application/json")

    async def _metrics(self, _request: web.Request) -> web.Response:
        return web.Response(
            body=generate_latest(self._registry), headers={"Content-Type": CONTENT_TYPE_LATEST}
        )

    async def _health(self, _request: web.Request) -> web.Response:
        reason = health_problem(self._feed)
        content = {"healthy": reason is None, "reason": reason}
        return web.json_response(content, status=200 if reason is None else 503)

    async def _black_box(self, _request: web.Request) -> web.Response:
        if not self._saver.is_there:
            return web.json_response({"error": "this run keeps no black box"}, status=404)
        wait_s = self._saved_s + SAVES_APART_S - time.monotonic()
        if wait_s > 0.0:
            again_s = math.ceil(min(wait_s, SAVES_APART_S))
            error = f"it is being saved, or was a moment ago; ask again in {again_s} s"
            return web.json_response({"error": error}, status=429, headers={"Retry-After": f"{again_s}"})
        self._saved_s = math.inf
        try:
            return await self._save()
        finally:
            self._saved_s = time.monotonic()

    async def _save(self) -> web.Response:
        answer = await self._saver.save("monitor page")
        return web.Response(
            text=json.dumps(answer),
            content_type="application/json",
            status=200 if "saved" in answer else 500,
        )

    async def _close_sockets(self, _app: web.Application) -> None:
        for socket in set(self._sockets):
            await socket.close(code=1001, message=b"the run has ended")


async def _send_all(outbox: Outbox, socket: web.WebSocketResponse) -> None:
    """Send what waits for a browser, as fast as it takes it."""
    while not socket.closed:
        message = await outbox.take()
        try:
            if isinstance(message, str):
                await socket.send_str(message)
            else:
                await socket.send_bytes(message)
        except (ConnectionResetError, RuntimeError):
            return


async def _add_headers(_request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)

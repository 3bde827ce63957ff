"""HTTP server of the page, its WebSocket, and its interface for other programs."""

import asyncio
import json
import logging
import math
import time
from importlib.resources import files

from aiohttp import web
from aiohttp.typedefs import Handler
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from arctrack.live.journal.message_pipe import PipeEnd
from arctrack.live.monitor.access import Access
from arctrack.live.monitor.feed import Feed, Outbox
from arctrack.live.monitor.metrics import registry_of
from arctrack.live.monitor.words import headline
from robot_io import TrackerState

_LOG = logging.getLogger(__name__)


class Connections:
    """Middleware that closes idle connections, and turns errors of the program into answers."""

    def __init__(self) -> None:
        self._idle_since_s: dict[web.RequestHandler, float] = {}
        self._logged: set[type[Exception]] = set()
        # What is wrong with a request, its client is told; its traceback is nothing for this machine's log.
        logging.getLogger("aiohttp.server").disabled = True

    @web.middleware
    async def watch(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Let a request be answered; an error of the program is logged once for each of its kinds."""
        connection = request.protocol
        self._idle_since_s[connection] = float("inf")
        try:
            return await handler(request)
        except (web.HTTPException, ConnectionError):
            raise
        except Exception as error:
            if type(error) not in self._logged:
                self._logged.add(type(error))
                _LOG.warning("arctrack: the monitor page's answer to %s failed: %r", request.rel_url, error)
            raise web.HTTPInternalServerError(text="the page has failed at this; its log says how") from None
        finally:
            self._idle_since_s[connection] = time.monotonic()

    async def sweep(self, server: web.Server) -> None:
        """Close what is half open, without end."""
        while True:
            await asyncio.sleep(1.0)
            now_s = time.monotonic()
            self._idle_since_s = {each: self._idle_since_s.get(each, now_s) for each in server.connections}
            longest = sorted(self._idle_since_s.items(), key=lambda pair: pair[1])
            for n, (connection, idle_since_s) in enumerate(longest):
                # Four for each browser.
                is_too_many = n < len(longest) - 128 and idle_since_s <= now_s
                # A browser has sent its request by then: a connection without one is half open.
                if (now_s - idle_since_s > 10.0 or is_too_many) and connection.transport is not None:
                    connection.transport.abort()


PATIENCE_S = 60.0
"""Time-out of the black box's answer, s: it writes what it holds."""


class Saver:
    """Client of the black box, one request at a time; without a connection there is no black box."""

    def __init__(self, connection: PipeEnd | None) -> None:
        self._connection = connection
        self._asking = asyncio.Lock()

    @property
    def is_there(self) -> bool:
        """True if there is a black box."""
        return self._connection is not None

    async def save(self, reason: str) -> dict[str, str]:
        """Return the black box' answer: `saved`, a path, or `error`, why there is none."""
        async with self._asking:
            return await asyncio.get_running_loop().run_in_executor(None, self._ask, reason)

    def _ask(self, reason: str) -> dict[str, str]:
        if self._connection is None:
            return {"error": "this run keeps no black box"}
        try:
            while self._connection.poll():
                # An answer that nobody waited for any more.
                self._connection.recv()
            self._connection.send({"save": reason})
            if not self._connection.poll(PATIENCE_S):
                return {"error": f"the black box has not answered for {PATIENCE_S:.0f} s"}
            answer: dict[str, str] = self._connection.recv()
        except (EOFError, OSError):
            return {"error": "the black box has ended"}
        return answer


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
            text=json.dumps(answer), content_type="application/json", status=200 if "saved" in answer else 500
        )

    async def _close_sockets(self, _app: web.Application) -> None:
        for socket in set(self._sockets):
            await socket.close(code=1001, message=b"the run has ended")


async def _send_all(outbox: Outbox, socket: web.WebSocketResponse) -> None:
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


MAX_AGE_S = 1.0
"""Older statuses and frames say that the loop, or the camera, stands."""


def health_problem(feed: Feed) -> str | None:
    """Return why a run does not work, None where it does."""
    status = feed.status
    if status is None:
        return "the tracker has not said yet how it stands"
    if not feed.is_alive:
        return "the tracker's process has ended"
    if feed.status_age_s > MAX_AGE_S:
        return f"the tracker has said nothing for {feed.status_age_s:.1f} s"
    if status.state is TrackerState.FAULT:
        return f"FAULT, {status.fault.name}: {headline(status.state, status.fault, status.reason)}"
    if math.isnan(feed.frame_age_s):
        return "no frame has come yet"
    if feed.frame_age_s > MAX_AGE_S:
        return f"no frame has come for {feed.frame_age_s:.1f} s"
    return None

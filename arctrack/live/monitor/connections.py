"""Connections of a monitor page: idle ones are closed, and an error is one line of the log."""

import asyncio
import logging
import time

from aiohttp import web
from aiohttp.typedefs import Handler

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

"""The process of a monitor page."""

import asyncio
import os
import socket
from multiprocessing.connection import Connection

import cv2
from aiohttp import web

from arctrack.errors import ArctrackError
from arctrack.live.journal.journal import JournalReader
from arctrack.live.journal.message_pipe import PipeEnd
from arctrack.live.monitor.access import Access
from arctrack.live.monitor.feed import Feed
from arctrack.live.monitor.options import MonitorOptions
from arctrack.live.monitor.server import Saver, Server


def run_monitor(options: MonitorOptions, parent: Connection, black_box: PipeEnd | None = None) -> None:
    """Serve a run's page until the parent's connection is closed; it is sent the page's address.

    `black_box` is sent {"save": reason}, and answers {"saved": path} or {"error": text}. ArctrackError if
    there is no run, or no such host or port.
    """
    cv2.setNumThreads(1)
    asyncio.run(_serve(options, JournalReader(options.journal), parent, Saver(black_box)))


async def _serve(options: MonitorOptions, reader: JournalReader, parent: Connection, saver: Saver) -> None:
    feed = Feed(reader, options, saver.is_there)
    server = Server(feed, Access(options.host, options.token), saver)
    runner = web.AppRunner(server.app(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, options.host, options.port).start()
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        await runner.cleanup()
        raise ArctrackError(
            f"[monitor] host = {options.host!r}, port = {options.port}: {reason}; state another, or 0"
        ) from None
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_reader(parent.fileno(), ended.set)
    parent.send(_address(options.host, runner.addresses[0][1]))
    feeding = asyncio.create_task(feed.run())
    assert runner.server is not None
    sweeping = asyncio.create_task(server.connections.sweep(runner.server))
    ending = asyncio.create_task(ended.wait())
    await asyncio.wait((feeding, ending), return_when=asyncio.FIRST_COMPLETED)
    loop.remove_reader(parent.fileno())
    sweeping.cancel()
    await runner.cleanup()
    if feeding.done():
        # It has failed, and says why.
        feeding.result()
    feeding.cancel()


def _address(host: str, port: int) -> str:
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return f"http://[{name}]:{port}/" if ":" in name else f"http://{name}:{port}/"

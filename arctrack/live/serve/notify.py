"""Notifications of a live run to systemd: ready, alive, stopping (sd_notify(3))."""

import os
import socket
import time
from contextlib import suppress


class Notifier:
    """Client of systemd's notification socket; sends nothing where systemd names none.

    `environment` (by default the process' own) has NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID.
    """

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        stated = dict(os.environ) if environment is None else environment
        self._socket: socket.socket | None = None
        path = stated.get("NOTIFY_SOCKET", "")
        if path:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
            # "@" stands for the first byte of a name that is no file's.
            self._path = "\0" + path[1:] if path.startswith("@") else path
        is_ours = stated.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        limit_us = stated.get("WATCHDOG_USEC", "") if is_ours else ""
        # As systemd.service(5) asks: at half of the limit.
        self._feed_s = float(limit_us) * 1e-6 / 2.0 if limit_us.isdigit() else float("inf")
        self._fed_s = float("-inf")

    def ready(self, status: str) -> None:
        """Notify that the run is ready, with its description."""
        self._send(f"READY=1\nSTATUS={status}")

    def stopping(self) -> None:
        """Notify that the run ends."""
        self._send("STOPPING=1")

    def goes_on(self) -> None:
        """Feed systemd's watchdog, where it has one and it is time to."""
        if self._feed_s < float("inf"):
            now_s = time.monotonic()
            if now_s - self._fed_s >= self._feed_s:
                self._fed_s = now_s
                self._send("WATCHDOG=1")

    def close(self) -> None:
        """Send nothing any more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        # A service manager that does not listen must not end a weld.
        if self._socket is not None:
            with suppress(OSError):
                self._socket.sendto(text.encode(), self._path)

"""Two serial CAN adapters that are pseudo terminals."""

from __future__ import annotations

import itertools
import os
import select
import threading


class SlcanAdapters:
    """Two serial CAN adapters on one wire: what one is told to send, the other reports as received."""

    def __init__(self):
        self._ends = [os.openpty() for _ in range(2)]
        self.ports = [os.ttyname(slave) for _, slave in self._ends]
        self.heard = [b"", b""]
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_exception):
        os.write(self._stop_write, b"x")
        self._thread.join()
        for fd in (self._stop_read, self._stop_write, *itertools.chain(*self._ends)):
            os.close(fd)

    def _run(self):
        masters = [master for master, _ in self._ends]
        pending = [b"", b""]
        while True:
            ready, _, _ = select.select([*masters, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            for i in (i for i, master in enumerate(masters) if master in ready):
                data = os.read(masters[i], 4096)
                self.heard[i] += data
                *lines, pending[i] = (pending[i] + data).split(b"\r")
                for line in lines:
                    if line.startswith(b"t"):
                        os.write(masters[1 - i], line + b"\r")

    def report(self, port, line):
        """Say something to who listens on a port, as if it came over the wire."""
        os.write(self._ends[port][0], line)

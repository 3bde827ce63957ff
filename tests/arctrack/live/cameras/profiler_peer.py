"""A profiler's program for tests: python profiler_peer.py COLUMNS ACT…, an act for each connection in turn.

An act is NAME:N: N good profiles, then what its name says; the last act is that of all that follow. Profile n
has the heights n + 0.001 columns, none in column 3, and the intensities n.
"""

from __future__ import annotations

import socket
import sys
import time
from contextlib import suppress

import numpy as np

from arctrack.live.cameras.profile_message import pack_profile

PERIOD_S = 0.01


def message(n: int, columns: int, has_sigmas: bool = False) -> bytes:
    z_mm = n + 0.001 * np.arange(columns)
    z_mm[3] = np.nan
    # Its clock began long ago, and the sensor had taken a thousand profiles before.
    time_ns = time.monotonic_ns() + 10**15
    sigma_mm = 0.001 * (1.0 + np.arange(columns)) if has_sigmas else None
    return pack_profile(1000 + n, time_ns, z_mm, np.full(columns, n, np.uint16), sigma_mm)


def act(connection: socket.socket, name: str, n_good: int, columns: int) -> None:
    for n in range(n_good):
        connection.sendall(message(n, columns))
        time.sleep(PERIOD_S)
    if name == "stalls":
        connection.sendall(message(n_good, columns)[:-1])
        connection.recv(1)
    elif name == "drips":
        # Bytes come, but no whole profile.
        for byte in message(n_good, columns)[:-1]:
            connection.sendall(bytes([byte]))
            time.sleep(0.1)
    elif name == "breaks":
        connection.sendall(message(n_good, columns)[:100])
    elif name == "narrows":
        connection.sendall(message(n_good, columns - 1))
        connection.recv(1)
    elif name == "babbles":
        connection.sendall(b"HTTP/1.1 200 OK\r\n")
        connection.recv(1)
    elif name == "has_sigmas":
        connection.sendall(message(n_good, columns, has_sigmas=True))
        connection.recv(1)
    elif name == "repeats":
        connection.sendall(message(n_good - 1, columns))
        connection.recv(1)
    elif name == "skips":
        connection.sendall(message(n_good + 2, columns))
        connection.recv(1)


def main() -> None:
    columns, acts = int(sys.argv[1]), sys.argv[2:]
    with socket.create_server(("127.0.0.1", 0)) as server:
        print(server.getsockname()[1], flush=True)
        while True:
            name, _, n_good = acts[0].partition(":")
            connection, _ = server.accept()
            with connection, suppress(OSError):
                act(connection, name, int(n_good), columns)
            acts = acts[1:] or acts


if __name__ == "__main__":
    main()

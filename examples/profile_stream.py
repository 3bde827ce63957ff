"""Send a recording's profiles over TCP, as the program of a laser profiler does.

    python examples/profile_stream.py RECORDING [--port 5021] [--loop]

It listens on this machine alone. Whoever connects gets the profiles from the first on, each when its time has
come. With the port 0 a free one is taken; the first line printed names it. A program of your own sensor sends
what the sensor gives in place of the recording's profiles: `arctrack.pack_profile` makes the bytes.
"""

from __future__ import annotations

import argparse
import socket
import time
from itertools import count

import arctrack
from noise_model.compiled.arrays import Float64, Integers

Profiles = list[tuple[float, Float64, Integers]]


def profiles_of(folder: str) -> Profiles:
    """Return a recording's profiles: the time after the first, s, heights, mm, and intensities of each."""
    recording = arctrack.read_recording(folder)
    profiler = recording.setup.profiler
    if profiler is None:
        raise SystemExit(f'{folder}: its [camera] gives images; a recording of kind = "profile" is needed')
    profiles: Profiles = []
    for row, frame in zip(recording.rows, recording.frames(), strict=True):
        if isinstance(frame, arctrack.BadFrame):
            continue
        codes, intensity = frame.image_dn[:2]
        after_s = row.timestamp_s - recording.rows[0].timestamp_s
        profiles.append((after_s, profiler.z_mm(codes), intensity))
    return profiles


def send(connection: socket.socket, profiles: Profiles, is_looped: bool) -> None:
    """Send profiles at their pace until the other end is gone, or all are sent."""
    number = 0
    for _ in count() if is_looped else (0,):
        began_s = time.monotonic()
        for after_s, z_mm, intensity in profiles:
            time.sleep(max(began_s + after_s - time.monotonic(), 0.0))
            # The sensor's own clock; which one does not matter, as long as it runs on.
            connection.sendall(arctrack.pack_profile(number, time.monotonic_ns(), z_mm, intensity))
            number += 1


def main() -> None:
    """Serve one connection after the other."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("recording")
    arguments.add_argument("--port", type=int, default=5021)
    arguments.add_argument("--loop", action="store_true", help="begin again at the end")
    given = arguments.parse_args()
    profiles = profiles_of(given.recording)
    with socket.create_server(("127.0.0.1", given.port)) as server:
        print(f"listening on 127.0.0.1:{server.getsockname()[1]}", flush=True)
        while True:
            connection, _ = server.accept()
            with connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                try:
                    send(connection, profiles, given.loop)
                except OSError:
                    print("the connection ended", flush=True)


if __name__ == "__main__":
    main()

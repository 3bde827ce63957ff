"""A GigE Vision stream off Aravis' fake camera, through the process that captures: what comes, what is lost.

    python benchmarks/gige_stream.py --seconds 60 --lost 0.01

A second process is the camera, over real sockets on loopback. This process reads frames as `arctrack serve`
does. Each frame is whole, or counted as dropped.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from arctrack.control.cell_file import CameraChoice, CaptureChoice
from arctrack.live.serve.captured_camera import CapturedCamera
from arctrack.nominal import nominal_setup
from tracker.state import Frame

FAKE = Path(__file__).resolve().parents[1] / "tests" / "arctrack" / "cameras" / "fake_gige.py"
WIDTH, ROWS = 512, 64
RAMP_STEPS = 3


def main() -> None:
    """Stream for some time, and print what came."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-hz", type=float, default=50.0)
    parser.add_argument("--lost", type=float, default=0.01, help="share of packets that are lost")
    options = parser.parse_args()
    command = [sys.executable, str(FAKE), "bench", str(options.lost)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as fake:
        assert fake.stdin is not None
        assert fake.stdout is not None
        fake.stdout.readline()
        setup = nominal_setup("v_groove", "mild_steel", width=WIDTH, height=ROWS)
        choice = CameraChoice(options.rate_hz, "gige", "127.0.0.1", CaptureChoice(rows=(16, ROWS)))
        camera = CapturedCamera(choice, Path("cell.toml").absolute(), setup)
        camera.begin()
        frames = torn = 0
        first = last = -1
        late_ms = []
        until_s = time.monotonic() + options.seconds
        while time.monotonic() < until_s:
            frame = camera.newest()
            if not isinstance(frame, Frame):
                time.sleep(0.0005)
                continue
            late_ms.append(1e3 * (time.monotonic() - frame.timestamp_s - frame.exposure_s / 2.0))
            steps = np.diff(frame.image_dn.astype(int), axis=1) % 255
            torn += len(np.unique(steps)) > RAMP_STEPS
            first = frame.index if first < 0 else first
            frames, last = frames + 1, frame.index
        dropped = camera.dropped
        camera.close()
        fake.stdin.close()
    taken = last - first + 1
    unaccounted = taken - frames - dropped
    print(f"taken {taken}, whole {frames}, dropped {dropped}, unaccounted {unaccounted}, torn {torn}")
    p50, p99, most = np.percentile(late_ms, [50, 99, 100])
    print(f"end of exposure to reader: median {p50:.1f} ms, 99 % {p99:.1f} ms, largest {most:.1f} ms")


if __name__ == "__main__":
    main()

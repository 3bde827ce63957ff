"""How late offsets go out of `arctrack serve` at 200 frames a second of 640 x 480 px, and what disturbs it.

Frames are rendered before, and published in a loop by a process of its own; a robot on a real bus sends poses
at 100 Hz; the tracker is `arctrack serve` in a third process. The torch keeps to the nominal seam, which the
frames show. Poses are extrapolated (`[service] pose_wait_s = 0`): the next one would come up to 10 ms later.

    python benchmarks/live_latency.py --seconds 600
    python benchmarks/live_latency.py --seconds 600 --browsers 10 --saves

Printed: the time from mid-exposure and from the publishing of a frame to the sending of its offset; frames
missed; memory and processor time of each process; the spread of p99 over minutes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import textwrap
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import can
import numpy as np
import psutil
import tomlkit

from arctrack.cameras.shared_frames import SharedFramesWriter
from arctrack.cell.live.serve import run_robot
from arctrack.cell.robot import Robot
from arctrack.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from arctrack.new import commented_setup
from arctrack.serve.simulated import GROUP, INTERFACE, write_simulated_cell
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from noise_model.setup import Setup
from tracker.state import Frame

RATE_HZ, EXPOSURE_S = 200.0, 0.001
RENDERED = 50
"""So many frames are drawn; they come again and again."""

TRACKER = """
    import math, sys, time
    import numpy as np
    from arctrack.cell_file import read_cell_file
    from arctrack.cli.serve import serve_cell_file
    from robot_io import SeamOffset
    from tracker.warm_up import heard_compilations

    rows = np.full((int(sys.argv[4]), 3), math.nan)
    count = 0

    def note(track, messages):
        global count
        if count < len(rows):
            valid = any(isinstance(m, SeamOffset) and m.validity == 0 for m in messages)
            rows[count] = track.frame, time.monotonic() - track.timestamp_s, valid
            count += 1

    with heard_compilations(None) as compiled:
        before = len(compiled)
        serve_cell_file(read_cell_file(sys.argv[1]), on_track=note, port=int(sys.argv[2]), hop_limit=0)
    np.save(sys.argv[3], rows[:count])
"""


def bench_setup(plan: LoopPlan) -> Setup:
    """Return the plan's setup with the bench's exposure."""
    setup = setup_of(plan)
    return replace(setup, camera=replace(setup.camera, exposure_s=EXPOSURE_S))


def publish(plan: LoopPlan, name: str, told: Connection) -> None:
    """Publish the rendered frames at their rate until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    setup = bench_setup(plan)
    robot, rng, renderer = Robot(world_of(plan, setup)), np.random.default_rng(plan.seed), Renderer()
    lit = Condition(1.0, 1.0, EXPOSURE_S)
    images = [draw_frame(setup, robot.T_base_tool(), lit, rng, renderer=renderer) for _ in range(RENDERED)]
    camera = setup.camera
    with SharedFramesWriter(name, camera.height, camera.width, setup.sensor.dtype) as frames:
        told.send(True)
        index, due_s = 0, time.monotonic()
        while not told.poll():
            image = images[index % RENDERED]
            now_s = time.monotonic()
            frames.publish(Frame(index, now_s - EXPOSURE_S / 2.0, image, EXPOSURE_S, 120.0))
            index, due_s = index + 1, due_s + 1.0 / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))


def drive(plan: LoopPlan, port: int, told: Connection) -> None:
    """Be the robot until the other end is closed: it stays on its nominal path."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    bus = can.Bus(GROUP, interface=INTERFACE, port=port, hop_limit=0)

    def goes_on(robot: Robot) -> bool:
        robot.offset_mm = np.zeros(2)
        return not told.poll()

    told.send(True)
    run_robot(plan, bus, lambda _shot: None, goes_on)
    bus.shutdown()


def started(target, *arguments) -> Connection:
    """Start a process and wait until it is ready; closing the connection ends it."""
    spawn = multiprocessing.get_context("spawn")
    told, its_end = spawn.Pipe()
    spawn.Process(target=target, args=(*arguments, its_end), daemon=True).start()
    its_end.close()
    told.recv()
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long, after the first ten")
    parser.add_argument("--joint", default="lap")
    parser.add_argument("--browsers", type=int, default=0, help="so many look at the page")
    parser.add_argument("--saves", action="store_true", help="the black box saves all the time")
    parser.add_argument("--priority", type=int, default=50, help="real-time priority of the loop, 0 for none")
    parser.add_argument("--pose-wait", type=float, default=0.0, help="[service] pose_wait_s")
    options = parser.parse_args()

    plan = LoopPlan(
        joint=options.joint,
        displaced_mm=0.0,
        weave_mm=0.0,
        length_mm=10_000.0,
        rate_hz=RATE_HZ,
        size_px=(640, 480),
    )
    name = f"bench-{os.getpid()}"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        cell = write_simulated_cell(Path(folder) / "cell", plan, INTERFACE, GROUP, name)
        (cell.parent / "setup.toml").write_text(commented_setup(bench_setup(plan)))
        document = tomlkit.parse(cell.read_text())
        document["service"]["pose_wait_s"] = options.pose_wait
        if options.priority:
            document["process"].update({"priority": options.priority, "lock_memory": True})
        cell.write_text(tomlkit.dumps(document))
        camera = started(publish, plan, name)
        robot = started(drive, plan, port)
        rows_path = Path(folder) / "rows.npy"
        count = str(int((options.seconds + 120.0) * RATE_HZ))
        command = [
            sys.executable,
            "-c",
            textwrap.dedent(TRACKER),
            str(cell),
            str(port),
            str(rows_path),
            count,
        ]
        tracker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        lines = _until_ready(tracker)
        print(*lines, sep="\n", flush=True)
        browsers = [_browser(lines) for _ in range(options.browsers)]
        _watch(tracker, options.seconds, options.saves)
        tracker.send_signal(signal.SIGTERM)
        print(tracker.communicate(timeout=300.0)[0])
        for browser in browsers:
            browser.kill()
        camera.close()
        robot.close()
        _print_rows(np.load(rows_path))


def _until_ready(tracker: subprocess.Popen) -> list[str]:
    lines = []
    while not lines or not lines[-1].startswith("ready"):
        line = tracker.stdout.readline()
        assert line, "the tracker ended"
        lines.append(line.rstrip())
    return lines


def _browser(lines: list[str]) -> subprocess.Popen:
    raise SystemExit("no page yet")


def _watch(tracker: subprocess.Popen, seconds: float, saves: bool) -> None:
    """Let it run, and print what each of its processes takes."""
    time.sleep(10.0)
    whole = psutil.Process(tracker.pid)
    processes = [whole, *whole.children(recursive=True)]
    before = {process: process.cpu_times() for process in processes}
    resident: list[tuple[float, float]] = []
    began_s = time.monotonic()
    while time.monotonic() - began_s < seconds:
        if saves:
            tracker.send_signal(signal.SIGUSR1)
        time.sleep(min(10.0, seconds / 6.0))
        memory = whole.memory_full_info()
        resident.append((time.monotonic() - began_s, memory.uss / 1e6))
    took_s = time.monotonic() - began_s
    for process in processes:
        after, first = process.cpu_times(), before[process]
        share = (after.user + after.system - first.user - first.system) / took_s
        what = "loop" if process is whole else " ".join(process.cmdline())[-40:]
        resident_mb = process.memory_info().rss / 1e6
        print(f"process {process.pid}: {100.0 * share:.0f} % of a core, {resident_mb:.0f} MB, {what}")
    times_s, uss_mb = np.array(resident).T
    slope = np.polyfit(times_s, uss_mb, 1)[0] * 60.0 if len(resident) > 2 else float("nan")
    print(f"the loop's own memory: {uss_mb[0]:.1f} to {uss_mb[-1]:.1f} MB, {slope:+.3f} MB a minute")


def _print_rows(rows: np.ndarray) -> None:
    """Print what the frames after the first ten seconds came to."""
    rows = rows[int(10.0 * RATE_HZ) :]
    frames, late_ms, valid = rows[:, 0], 1000.0 * rows[:, 1], rows[:, 2]
    steps = np.diff(frames)
    print(f"frames {len(rows)}, valid offsets {int(valid.sum())}, missed {int((steps - 1).sum())}")
    for what, shift_ms in (("mid-exposure", 0.0), ("published", 500.0 * EXPOSURE_S)):
        times = late_ms - shift_ms
        p50, p99, p999 = np.quantile(times, [0.5, 0.99, 0.999])
        print(f"{what} to CAN: p50 {p50:.2f}, p99 {p99:.2f}, p99.9 {p999:.2f}, max {times.max():.2f} ms")
    minutes = np.array_split(late_ms, max(1, round(len(late_ms) / (60.0 * RATE_HZ))))
    p99s = np.array([np.quantile(minute, 0.99) for minute in minutes])
    spread = p99s.std(ddof=1) / np.sqrt(len(p99s)) if len(p99s) > 1 else float("nan")
    print(f"p99 by minutes: mean {p99s.mean():.2f} ± {2.0 * spread:.2f} ms (2 sigma of the mean)")
    interval = np.diff(late_ms / 1000.0 + frames / RATE_HZ)
    print(f"between offsets: {1000 * interval.min():.2f} to {1000 * interval.max():.2f} ms")


if __name__ == "__main__":
    main()

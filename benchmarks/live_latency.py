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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import can
import numpy as np
import psutil
import tomlkit

from arctrack.live.cameras.shared_frames import SharedFramesWriter
from arctrack.live.serve.simulated import GROUP, INTERFACE, write_simulated_cell
from arctrack.live.simulated_cell import run_robot
from arctrack.recording.new import commented_setup
from arctrack.simulation.cell.robot import Robot
from arctrack.simulation.cell.weld.closed_loop import LoopPlan, setup_of, world_of
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from noise_model.setup import Setup
from tracker.state import Frame

EXPOSURE_S, SETTLES_S = 0.001, 5.0
SPEED_MM_S = 2.0
"""So slow that ten minutes end before the bus' largest coordinate, 1638 mm."""

RENDERED = 50
"""So many frames are drawn; they come again and again."""

TRACKER = """
    import math, sys, time
    import numpy as np
    from arctrack.control.cell_file import read_cell_file
    from arctrack.cli.serve import serve_cell_file
    from robot_io import SeamOffset
    from tracker.warm_up import compilations_reported

    rows = np.full((int(sys.argv[4]), 3), math.nan)
    count, before = 0, None

    def note(track, messages):
        global count, before
        if before is None:
            before = len(compiled)
        if count < len(rows):
            valid = any(isinstance(m, SeamOffset) and m.validity == 0 for m in messages)
            rows[count] = track.frame, time.monotonic() - track.timestamp_s, valid
            count += 1

    with compilations_reported(None) as compiled:
        serve_cell_file(read_cell_file(sys.argv[1]), on_track=note, port=int(sys.argv[2]), hop_limit=0)
        print(f"compiled after ready: {len(compiled) - before}")
    np.save(sys.argv[3], rows[:count])
"""


BROWSERS = """
    import asyncio, sys
    import aiohttp

    async def look(session, url):
        heard = 0
        try:
            async with session.ws_connect(url + "ws", max_msg_size=0) as page:
                async for message in page:
                    heard += len(message.data)
        except aiohttp.ClientError:
            pass
        return heard

    async def main():
        async with aiohttp.ClientSession() as session:
            heard = await asyncio.gather(*(look(session, sys.argv[1]) for _ in range(int(sys.argv[2]))))
        print("browsers heard, MB:", *(f"{n / 1e6:.1f}" for n in heard))

    asyncio.run(main())
"""
"""Browsers as the page sees them: they take all that it sends. What they draw is another machine's work."""


@dataclass(frozen=True)
class Process:
    """A process of a run: the share of a core that it took, its memory, MB, and what it is."""

    cpu: float
    resident_mb: float
    what: str


@dataclass(frozen=True)
class Measured:
    """What a run came to.

    `frames`, `late_s` and `is_valid` (n,): each frame's number, the time from its mid-exposure to its offset,
    and whether that was VALID. `loop_mb` (m, 2): the loop's own memory, MB, by seconds.
    """

    frames: np.ndarray
    late_s: np.ndarray
    is_valid: np.ndarray
    processes: list[Process]
    loop_mb: np.ndarray
    lines: list[str]


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
            index, due_s = index + 1, due_s + 1.0 / plan.rate_hz
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


def started(target: Callable[..., None], *arguments: object) -> Connection:
    """Start a process and wait until it is ready; closing the connection ends it."""
    spawn = multiprocessing.get_context("spawn")
    told, its_end = spawn.Pipe()
    spawn.Process(target=target, args=(*arguments, its_end), daemon=True).start()
    its_end.close()
    told.recv()
    return told


def measured(
    plan: LoopPlan,
    seconds: float,
    choices: Mapping[str, Mapping[str, object]],
    browsers: int = 0,
    saves: bool = False,
) -> Measured:
    """Run camera, robot and tracker for a time after SETTLES_S; `choices` are keys of the cell file."""
    name = f"bench-{os.getpid()}"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        cell = write_simulated_cell(Path(folder) / "cell", plan, INTERFACE, GROUP, name)
        (cell.parent / "setup.toml").write_text(commented_setup(bench_setup(plan)))
        document = tomlkit.parse(cell.read_text())
        document["monitor"] = {"port": 0}
        for table, keys in choices.items():
            document[table].update(keys)
        cell.write_text(tomlkit.dumps(document))
        camera, robot = started(publish, plan, name), started(drive, plan, port)
        rows_path = Path(folder) / "rows.npy"
        words = (str(cell), str(port), str(rows_path), str(int((seconds + 300.0) * plan.rate_hz)))
        command = [sys.executable, "-c", textwrap.dedent(TRACKER), *words]
        tracker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            lines = _until_ready(tracker)
            looking = _browsers(lines, browsers) if browsers else None
            time.sleep(SETTLES_S)
            processes, loop_mb = _watched(tracker, seconds, saves)
            tracker.send_signal(signal.SIGTERM)
            lines += tracker.communicate(timeout=300.0)[0].splitlines()
            if looking is not None:
                lines += looking.communicate()[0].splitlines()
        finally:
            tracker.kill()
            camera.close()
            robot.close()
        rows = np.load(rows_path)[int(SETTLES_S * plan.rate_hz) :]
    return Measured(rows[:, 0], rows[:, 1], rows[:, 2] > 0.0, processes, loop_mb, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="how long, after the first five")
    parser.add_argument("--rate", type=float, default=200.0, help="frames a second")
    parser.add_argument("--joint", default="lap")
    parser.add_argument("--browsers", type=int, default=0, help="so many look at the page")
    parser.add_argument("--saves", action="store_true", help="the black box saves all the time")
    parser.add_argument("--priority", type=int, default=50, help="real-time priority of the loop, 0 for none")
    parser.add_argument("--pose-wait", type=float, default=0.0, help="[service] pose_wait_s")
    options = parser.parse_args()
    plan = bench_plan(options.joint, options.rate, (640, 480))
    choices: dict[str, dict[str, object]] = {"service": {"pose_wait_s": options.pose_wait}}
    if options.priority:
        choices["process"] = {"priority": options.priority, "lock_memory": True}
    _print(measured(plan, options.seconds, choices, options.browsers, options.saves), plan.rate_hz)


def bench_plan(joint: str, rate_hz: float, size_px: tuple[int, int]) -> LoopPlan:
    """Return what is welded: a seam where the program has it, for longer than any run."""
    return LoopPlan(
        joint=joint,
        displaced_mm=0.0,
        weave_mm=0.0,
        length_mm=10_000.0,
        speed_mm_s=SPEED_MM_S,
        rate_hz=rate_hz,
        size_px=size_px,
    )


def _until_ready(tracker: subprocess.Popen[str]) -> list[str]:
    assert tracker.stdout is not None
    lines: list[str] = []
    while not lines or not lines[-1].startswith("ready"):
        line = tracker.stdout.readline()
        assert line, "the tracker ended"
        lines.append(line.rstrip())
    return lines


def _browsers(lines: list[str], count: int) -> subprocess.Popen[str]:
    """Look at the page that the tracker's lines name, so many times at once."""
    (url,) = (line.partition(": ")[2] for line in lines if line.startswith("page: "))
    command = [sys.executable, "-c", textwrap.dedent(BROWSERS), url, str(count)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def _watched(tracker: subprocess.Popen[str], seconds: float, saves: bool) -> tuple[list[Process], np.ndarray]:
    """Let it run, and return what each of its processes took, and the loop's own memory."""
    loop = psutil.Process(tracker.pid)
    processes = [loop, *loop.children(recursive=True)]
    before = {process: process.cpu_times() for process in processes}
    began_s = time.monotonic()
    loop_mb = []
    while (elapsed_s := time.monotonic() - began_s) < seconds:
        # Not what smaps says: whoever reads that holds up the process whose memory it is.
        memory = loop.memory_info()
        loop_mb.append((elapsed_s, (memory.rss - memory.shared) / 1e6))
        if saves:
            tracker.send_signal(signal.SIGUSR1)
        time.sleep(min(10.0, seconds / 6.0, seconds - elapsed_s))
    taken = []
    for process in processes:
        now, first = process.cpu_times(), before[process]
        cpu = (now.user + now.system - first.user - first.system) / elapsed_s
        what = "loop" if process is loop else " ".join(process.cmdline())[-60:]
        taken.append(Process(cpu, process.memory_info().rss / 1e6, what))
    return taken, np.array(loop_mb)


def _print(run: Measured, rate_hz: float) -> None:
    """Print what a run came to."""
    print(*run.lines, sep="\n")
    for process in run.processes:
        print(f"{100.0 * process.cpu:.0f} % of a core, {process.resident_mb:.0f} MB, {process.what}")
    times_s, own_mb = run.loop_mb.T
    slope = np.polyfit(times_s, own_mb, 1)[0] * 60.0 if len(own_mb) > 2 else float("nan")
    print(f"the loop's own memory: {own_mb[0]:.1f} to {own_mb[-1]:.1f} MB, {slope:+.3f} MB a minute")
    missed = int((np.diff(run.frames) - 1).sum())
    print(f"frames {len(run.frames)}, valid offsets {int(run.is_valid.sum())}, missed {missed}")
    late_ms = 1000.0 * run.late_s
    for what, shift_ms in (("mid-exposure", 0.0), ("published", 500.0 * EXPOSURE_S)):
        p50, p99, p999 = np.quantile(late_ms - shift_ms, [0.5, 0.99, 0.999])
        most = late_ms.max() - shift_ms
        print(f"{what} to CAN: p50 {p50:.2f}, p99 {p99:.2f}, p99.9 {p999:.2f}, max {most:.2f} ms")
    minutes = np.array_split(late_ms, max(1, round(len(late_ms) / (60.0 * rate_hz))))
    p99s = np.array([np.quantile(minute, 0.99) for minute in minutes])
    spread = p99s.std(ddof=1) / np.sqrt(len(p99s)) if len(p99s) > 1 else float("nan")
    print(f"p99 by minutes: mean {p99s.mean():.2f} ± {2.0 * spread:.2f} ms (2 sigma of the mean)")


if __name__ == "__main__":
    main()

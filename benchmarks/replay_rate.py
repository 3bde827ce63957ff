"""How many frames a second a replay tracks, where its time goes, and what its pictures take.

    python benchmarks/replay_rate.py [RECORDING ...] [--frames 400] [--repeats 3] [--workers 2]
                                       [--cores 1 2 3]

Without a recording a V-groove of 640x480 px is simulated first, as PNGs. What a frame takes of the CPU is the
least of the repeats, after a warm-up: `decode` is reading and decoding all frames, `step` is the tracker over
frames that are in memory, both alone; `rest` is what a whole replay takes beyond them: poses, bus, logs,
results, threads. `Frames/s a core` are by the CPU time. Then it replays with pictures, on as many cores as
are named: what tracking and drawing take in this process, and what processes take that draw beside it, their
start included. In the end one worker process and several replay two recordings each, by the clock, once all
is imported and compiled.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

from arctrack.nominal import nominal_setup
from arctrack.recording import Recording, read_recording
from arctrack.replay.replay import ReplayOptions, replay_recording
from arctrack.replays import ReplayJob, ReplayResult, replay_job
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from arctrack.workers import at_once, processes
from tracker.state import Frame
from tracker.tracker import Tracker

OPTIONS = ReplayOptions(pictures=False)
RATE_HZ = 50.0


def cpu_and_wall_s(work: Callable[[], object]) -> tuple[float, float]:
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    work()
    return time.process_time() - cpu_s, time.perf_counter() - wall_s


def in_one_process(recording: Recording, out: Path, repeats: int) -> None:
    n = len(recording.rows)
    poses = recording.poses_at([row.timestamp_s for row in recording.rows])
    tracked = [pair for pair in zip(recording.frames(), poses, strict=True) if isinstance(pair[0], Frame)]

    def decode() -> None:
        for _ in recording.frames():
            pass

    def steps() -> None:
        tracker = Tracker(recording.setup, True, recording.correction)
        for frame, pose in tracked:
            tracker.step(frame, pose)

    def replay() -> None:
        replay_recording(recording, out, OPTIONS)

    replay()
    runs = [[cpu_and_wall_s(part) for part in (decode, steps, replay)] for _ in range(repeats)]
    decode_ms, step_ms, whole_ms = (
        1e3 / n * min(cpu_s for cpu_s, _ in part) for part in zip(*runs, strict=True)
    )
    wall_ms = 1e3 / n * min(wall_s for *_, (_, wall_s) in runs)
    print(
        f"{recording.name}: CPU ms a frame: decode {decode_ms:.2f}, step {step_ms:.2f}, "
        f"rest {whole_ms - decode_ms - step_ms:.2f}, in all {whole_ms:.2f}, or "
        f"{1e3 / whole_ms:.0f} frames/s a core; by the clock {wall_ms:.2f} ms, {1e3 / wall_ms:.0f} frames/s"
    )


def with_pictures(recording: Recording, out: Path, repeats: int, cores: int) -> None:
    n, runs = len(recording.rows), []
    for _ in range(repeats):
        moments = [(time.perf_counter(), os.times())]

        def on_frame(done: int, moments: list[tuple[float, os.times_result]] = moments) -> None:
            if done in (1, n):
                moments.append((time.perf_counter(), os.times()))

        replay_recording(recording, out, on_frame=on_frame, cores=cores)
        moments.append((time.perf_counter(), os.times()))
        _, first, tracked, drawn = moments
        beside_s = drawn[1].children_user + drawn[1].children_system
        beside_s -= moments[0][1].children_user + moments[0][1].children_system
        runs.append((cpu_s(first, tracked), cpu_s(tracked, drawn), beside_s, drawn[0] - tracked[0]))
    track_ms, draw_ms, beside_ms, wall_ms = (1e3 / n * min(part) for part in zip(*runs, strict=True))
    print(
        f"{recording.name}: with pictures on {cores} cores: CPU ms a frame: tracking {track_ms:.2f}, "
        f"drawing {draw_ms:.2f}, processes beside it {beside_ms:.2f}; drawing by the clock {wall_ms:.2f} ms"
    )


def cpu_s(begin: tuple[float, os.times_result], end: tuple[float, os.times_result]) -> float:
    return end[1].user + end[1].system - begin[1].user - begin[1].system


def frames_per_s(executor: Executor, jobs: list[ReplayJob]) -> float:
    began_s = time.perf_counter()
    done = list(at_once(replay_job, jobs, executor))
    took_s = time.perf_counter() - began_s
    assert all(isinstance(replayed, ReplayResult) for replayed in done)
    return (
        sum(replayed.summaries[0].frames for replayed in done if isinstance(replayed, ReplayResult)) / took_s
    )


def in_workers(recording: Recording, out: Path, repeats: int, workers: int) -> None:
    rates = {}
    for count in (1, workers):
        jobs = [ReplayJob(recording.path, out / f"{n}", None, OPTIONS) for n in range(2 * count)]
        with processes(count) as executor:
            frames_per_s(executor, jobs[:count])
            rates[count] = max(frames_per_s(executor, jobs) for _ in range(repeats))
    ratio = rates[workers] / rates[1]
    print(
        f"{recording.name}: one worker {rates[1]:.0f} frames/s, {workers} workers {rates[workers]:.0f}: "
        f"{ratio:.2f} times as many"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2, 3])
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        paths: list[Path] = chosen.recordings
        if not paths:
            setup = balance(nominal_setup("v_groove", "mild_steel", width=640, height=480))
            plan = SimulationPlan(frames=chosen.frames, rate_hz=RATE_HZ, production=True)
            paths = [simulate_recording(Path(scratch, "v_groove"), setup, plan)]
        for path in paths:
            recording = read_recording(path)
            in_one_process(recording, Path(scratch, "out"), chosen.repeats)
            for cores in chosen.cores:
                with_pictures(recording, Path(scratch, "pictures"), chosen.repeats, cores)
            in_workers(recording, Path(scratch, "workers"), chosen.repeats, chosen.workers)


if __name__ == "__main__":
    main()

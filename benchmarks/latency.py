"""How long a robot waits for a step of the tracker: at 200 Hz, beside a memory hog, cold, at a start.

    python benchmarks/latency.py
    python benchmarks/latency.py --joint v_groove --width 640 --steps 400 --beside HEAD~1

The torch travels, weaves, rises and tilts; a new frame comes every 5 ms, with laser, speckle and arc. Each
step waits for its tick: the loop sleeps until 0.5 ms before it, then spins, as that of `arctrack serve` does.
A step that is late takes the next tick. Steps run in a process of their own, pinned to the first core; with
--beside another revision's run there too, in turn with them, some 50 steps each. Wall time is what a robot
waits; CPU time leaves out what else the machine did meanwhile. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from latency_cases import HEIGHTS, METALS, Case, draw_case
from latency_peers import print_peers
from latency_worker import COLD, SEARCH, STRETCHES, TRACK

from noise_model.compiled.arrays import Float64

ROOT = Path(__file__).resolve().parents[1]
THIS = "this tree"
CORES = sorted(os.sched_getaffinity(0))

HOG = "memory hog"
SITUATIONS = {"200 Hz": TRACK, HOG: TRACK, "cold caches": COLD, "search": SEARCH}
"""What is timed, and the worker's name for it."""

HOG_MB = 200
"""So much memory another process copies to and fro, on the last core."""

SEARCH_SHARE = 0.2
"""Searches are so much rarer than the other steps."""

READY_RUNS, READY_TARGET_S = 3, 3.0
PASSES = 200


class Worker:
    """A process that tracks a case's frames with the arctrack of a folder."""

    def __init__(self, tree: Path, case: Case) -> None:
        command = [sys.executable, str(Path(__file__).with_name("latency_worker.py")), str(case.folder)]
        self._process = subprocess.Popen(
            [*command, str(time.monotonic())],
            cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ready = self._answer()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate()

    def block(self, situation: str, stretch: int) -> Steps:
        """Take a stretch of frames to and fro."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([situation, stretch]) + "\n")
        self._process.stdin.flush()
        answer = self._answer()
        return Steps(*(np.array(answer[name], dtype=np.float64) for name in ("wall_ms", "cpu_ms", "valid")))

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"the worker ended with exit code {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@dataclass(frozen=True)
class Steps:
    """Wall and CPU time (n,) of steps, ms, and which tracks were valid."""

    wall_ms: Float64
    cpu_ms: Float64
    valid: Float64

    @classmethod
    def joined(cls, blocks: list[Steps]) -> Steps:
        """Return the steps of several blocks."""
        return cls(*(np.concatenate([getattr(b, name) for b in blocks]) for name in cls.__annotations__))

    def at(self, percents: Sequence[float]) -> tuple[Float64, Float64]:
        """Return percentiles of wall and of CPU time, ms."""
        return np.percentile(self.wall_ms, percents), np.percentile(self.cpu_ms, percents)


@contextmanager
def memory_hog() -> Iterator[None]:
    """Let another process copy memory to and fro meanwhile, on the last core that there is."""
    context = multiprocessing.get_context("spawn")
    runs = context.Event()
    process = context.Process(target=_copy_for_ever, args=(CORES[-1], runs), daemon=True)
    process.start()
    runs.wait()
    try:
        yield
    finally:
        process.kill()
        process.join()


def _copy_for_ever(core: int, runs: Any) -> None:
    os.sched_setaffinity(0, {core})
    halves = np.ones((2, HOG_MB * 500_000), np.uint8)
    runs.set()
    for source in itertools.cycle((0, 1)):
        np.copyto(halves[1 - source], halves[source])


def tree_of(revision: str) -> Path:
    """Return a folder with a revision's files; it is kept, what its kernels are compiled to as well."""
    git = ["git", "-C", str(ROOT)]
    commit = subprocess.check_output([*git, "rev-parse", "--short=12", f"{revision}^{{commit}}"], text=True)
    # In a folder that others may write to, its code could be theirs.
    tree = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / f"arctrack-{commit.strip()}"
    if not tree.exists():
        files = subprocess.check_output([*git, "archive", commit.strip()])
        tree.mkdir(0o700, parents=True)
        subprocess.run(["tar", "-x", "-C", str(tree)], input=files, check=True)
    return tree


def one_pass_ms(case: Case) -> float:
    """Return what one pass over the frame takes, ms."""
    image = np.load(case.folder / "images.npy", mmap_mode="r")[0].copy()
    took = np.empty(PASSES)
    for n in range(PASSES):
        began_s = time.perf_counter()
        cv2.sumElems(image)
        took[n] = time.perf_counter() - began_s
    return 1e3 * float(np.median(took))


def run_steps(workers: Mapping[str, Worker], situation: str, steps: int) -> dict[str, Steps]:
    """Return so many steps of each worker at least, in turn."""
    blocks: dict[str, list[Steps]] = {name: [] for name in workers}
    for stretch in itertools.cycle(range(STRETCHES)):
        for name, worker in workers.items():
            blocks[name].append(worker.block(SITUATIONS[situation], stretch))
        if all(sum(len(b.wall_ms) for b in done) >= steps for done in blocks.values()):
            break
    return {name: Steps.joined(done) for name, done in blocks.items()}


def print_steps(cases: list[Case], trees: Mapping[str, Path], steps: int) -> dict[str, dict[str, float]]:
    """Print the steps' times by situation; return this tree's median CPU time by situation and case, ms."""
    print("A step, ms; the target is for the wall time's p99. Last, each over another revision's")
    print(
        f"{'':16} {'':11} {'':12} {'target':>6} {'p50':>6} {'p99':>6} {'p99.9':>6} {'max':>6} {'CPU p50':>7}"
        f" {'p99':>6} {'valid':>5} {'over one pass':>13}   {'p50':>5} {'p99':>5} {'CPU p50':>7} {'p99':>5}"
    )
    medians: dict[str, dict[str, float]] = {situation: {} for situation in SITUATIONS}
    for case in cases:
        floor_ms = one_pass_ms(case)
        with ExitStack() as stack:
            workers = {name: stack.enter_context(Worker(tree, case)) for name, tree in trees.items()}
            for situation in SITUATIONS:
                share = SEARCH_SHARE if situation == "search" else 1.0
                with memory_hog() if situation == HOG else nullcontext():
                    done = run_steps(workers, situation, round(share * steps))
                medians[situation][case.name] = float(np.median(done[THIS].cpu_ms))
                for name, timed in done.items():
                    other = next((done[n] for n in done if n != THIS), None) if name == THIS else None
                    print(_row(case, situation, name, timed, floor_ms) + _ratios(timed, other), flush=True)
    return medians


def _row(case: Case, situation: str, name: str, steps: Steps, floor_ms: float) -> str:
    target_ms = case.search_target_ms if situation == "search" else case.track_target_ms
    target = "" if target_ms is None else f"{target_ms:.1f}"
    wall_ms, cpu_ms = steps.at((50.0, 99.0, 99.9, 100.0))
    walls = " ".join(f"{value:6.2f}" for value in wall_ms)
    return (
        f"{case.name:16} {situation:11} {name:12.12} {target:>6} {walls} {cpu_ms[0]:7.2f} {cpu_ms[1]:6.2f}"
        f" {steps.valid.mean():5.2f} {wall_ms[0] / floor_ms:13.0f}"
    )


def _ratios(steps: Steps, other: Steps | None) -> str:
    if other is None:
        return ""
    wall, cpu = np.divide(steps.at((50.0, 99.0)), other.at((50.0, 99.0)))
    return f"   {wall[0]:5.2f} {wall[1]:5.2f} {cpu[0]:7.2f} {cpu[1]:5.2f}"


def print_ready(cases: list[Case], trees: Mapping[str, Path]) -> None:
    """Print how long a fresh process takes to be ready, and its first frames, all compiled before."""
    print(
        f"\nA fresh process, all kept on disk: s until ready, target {READY_TARGET_S:.0f}; first frames, ms"
    )
    print(
        f"{'':16} {'':12} {'import':>7} {'setup':>7} {'warm-up':>7} {'ready':>7} {'slowest':>7}"
        f" {'compiled':>8}   {'first':>6} {'slowest':>7} {'second':>6}"
    )
    for case in cases:
        for name, tree in trees.items():
            runs = []
            for _ in range(READY_RUNS):
                with Worker(tree, case) as worker:
                    runs.append(worker.ready)
            spent_s = np.array([run["spent_s"] for run in runs])
            first_ms = np.array([run["first_ms"] for run in runs])
            ready_s = spent_s.sum(axis=1)
            first, second = np.median(first_ms, axis=0)
            print(
                f"{case.name:16} {name:12.12} {' '.join(f'{s:7.2f}' for s in np.median(spent_s, axis=0))}"
                f" {np.median(ready_s):7.2f} {ready_s.max():7.2f} {max(run['compiled'] for run in runs):8}"
                f"   {first:6.2f} {first_ms[:, 0].max():7.2f} {second:6.2f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=2000, help="how many steps are timed, of each kind")
    parser.add_argument("--joint", choices=METALS, action="append", help="default: all of them")
    parser.add_argument("--width", choices=HEIGHTS, type=int, action="append", help="px; default: both")
    parser.add_argument("--beside", metavar="REV", help="a git revision that runs in turn with this tree")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    trees = {options.beside: tree_of(options.beside)} if options.beside else {}
    trees[THIS] = ROOT
    with tempfile.TemporaryDirectory() as folder:
        chosen = [
            Case(joint, width, Path(folder) / f"{joint}_{width}")
            for width in options.width or HEIGHTS
            for joint in options.joint or METALS
        ]
        with ProcessPoolExecutor(len(CORES)) as pool:
            cases = list(pool.map(draw_case, chosen))
        os.sched_setaffinity(0, {CORES[0]})
        medians = print_steps(cases, trees, options.steps)
        print_ready(cases, trees)
        print_peers(cases, medians["200 Hz"], medians["search"])


if __name__ == "__main__":
    main()

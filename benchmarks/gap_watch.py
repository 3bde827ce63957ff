"""How often the watch beside a live run tells a gap without one, and what it names where there is one.

    python benchmarks/gap_watch.py run-lengths [--blocks N]
    python benchmarks/gap_watch.py looks [--joint JOINT] [--effect ID …] [--seed N]

Run lengths: blocks whose mean ln(misfit) is normal, and alike to its neighbour's by a first-order
autoregression, go through `GapWatch` until it tells a gap. Looks: twelve frames of each effect at its typical
values, the setup's own values off within their tolerance, through the tracker and the first look.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from arctrack.live.watch.process import GapPolicy, GapWatch
from arctrack.nominal import nominal_setup
from arctrack.recording import read_recording
from arctrack.recording.frames import BadFrame
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from noise_model.compiled.arrays import Float64
from noise_model.effects import REGISTRY
from sim_to_real.first_look import first_look
from sim_to_real.search.score_test import FAMILIES
from tracker.state import Pose, Track
from tracker.tracker import Tracker

LEVELS, SCATTERS, ALIKE = (0.95, 1.15), (0.1, 0.2), (0.0, 0.3, 0.6, 0.9)
FRAMES, WIDTH, HEIGHT = 12, 320, 240


def autoregressive(count: int, alike: float, rng: np.random.Generator) -> Float64:
    """Return standard normal values (count,) of which neighbours correlate so."""
    values = rng.normal(size=count)
    for n in range(1, count):
        values[n] = alike * values[n - 1] + math.sqrt(1.0 - alike**2) * values[n]
    return values


def gaps_told(levels: Float64) -> int:
    """Return how many gaps a watch tells in blocks of so many frames as it needs."""
    watch, gaps, frames = GapWatch(), 0, GapPolicy.min_frames
    for block, level in enumerate(levels):
        before = watch.is_gap
        for n in range(frames):
            watch.see(Track(n, block + n / frames, 0, map_misfit=math.exp(level)))
        gaps += watch.is_gap and not before
    return gaps


def print_run_lengths(runs: int, blocks: int) -> None:
    print(
        f"Gaps told in {runs} runs without one, each of {blocks} blocks of a second: {blocks / 3600.0:.1f} h"
    )
    print(f"{'misfit':>6} {'scatter':>7}" + "".join(f"{f'alike {alike:g}':>11}" for alike in ALIKE))
    for level in LEVELS:
        for scatter in SCATTERS:
            told = []
            for n, alike in enumerate(ALIKE):
                draws = [np.random.default_rng([n, run]) for run in range(runs)]
                told.append(
                    sum(
                        gaps_told(math.log(level) + scatter * autoregressive(blocks, alike, rng))
                        for rng in draws
                    )
                )
            print(f"{level:6.2f} {scatter:7.2f}" + "".join(f"{count:11d}" for count in told), flush=True)


def look_at(joint: str, effect: str | None, seed: int) -> tuple[str, ...]:
    """Return an effect, the misfit of its frames' map, and what the first look makes of it, as cells."""
    setup = balance(nominal_setup(joint, "mild_steel", width=WIDTH, height=HEIGHT))
    hidden = {} if effect is None else {effect: dict(REGISTRY[effect].typical)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drawn"
        plan = SimulationPlan(frames=FRAMES, seed=seed, production=True)
        recording = read_recording(simulate_recording(path, setup, plan, None, hidden))
        frames = [frame for frame in recording.frames() if not isinstance(frame, BadFrame)]
    buffer = recording.pose_buffer()
    poses = {frame.timestamp_s: Pose(buffer.at(frame.timestamp_s).T_base_tool) for frame in frames}
    tracker = Tracker(setup)
    misfits = [tracker.step(frame, poses[frame.timestamp_s]).map_misfit for frame in frames]
    began_s = time.process_time()
    look = first_look(setup, frames, poses.get)
    took_s = time.process_time() - began_s
    best = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in look.closed[:2])
    verdict = "no gap" if not look.is_gap else " or ".join(look.likely) or "nothing known"
    return (
        effect or "none",
        f"{np.nanmedian(misfits):.2f}",
        f"{look.mean_square:.1f}",
        verdict,
        best,
        f"{took_s:.1f}",
    )


def print_looks(joint: str, effects: list[str], seed: int) -> None:
    print(f"{'effect':18} {'misfit':>6} {'mean sq.':>8} {'looks like':40} {'would close':40} {'CPU s':>5}")
    for effect in (None, *effects):
        name, misfit, square, verdict, best, took = look_at(joint, effect, seed)
        print(f"{name:18} {misfit:>6} {square:>8} {verdict:40} {best:40} {took:>5}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    asked = parser.add_subparsers(dest="what", required=True)
    lengths = asked.add_parser("run-lengths")
    lengths.add_argument("--blocks", type=int, default=28_800, help="of a second each")
    lengths.add_argument("--runs", type=int, default=5)
    looks = asked.add_parser("looks")
    looks.add_argument("--joint", default="v_groove")
    looks.add_argument("--effect", action="append", choices=list(FAMILIES), help="default: all of them")
    looks.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.what == "run-lengths":
        print_run_lengths(options.runs, options.blocks)
    else:
        print_looks(options.joint, options.effect or list(FAMILIES), options.seed)


if __name__ == "__main__":
    main()

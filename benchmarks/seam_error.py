"""Seam error against truth.csv, with and without the arc map, side by side; constant part removed and not.

    python benchmarks/seam_error.py RECORDING... [--calibrate-on RECORDING]
    python benchmarks/seam_error.py --simulate SEEDS [--joint JOINT] [--speed-mm-s SPEED]

With --calibrate-on the camera's pose is first found from that recording's arc light. --simulate makes a
recording of 118 mm for each metal and seed, laser and arc on in every frame, 10 frames a second, with weave,
tilt, a seam that wanders, and an arc that flickers and spatters, of which the tracker is told nothing; and
tracks those.

At the torch: the offset that is sent against the true seam there, as the sensor passed it before, once the
torch stands on what was measured.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.recording import BadFrame, read_recording, read_truth
from arctrack.simulation.simulate import SimulationPlan, balance, simulate_recording
from calibration.hand_eye_arc import estimate_hand_eye
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, transform
from tracker import flags
from tracker.seam.locate import seam_displacement
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker

WAY_MM, TRAVEL_MM_S = 118.0, 20.0
HIDDEN = {
    "laser_speckle": {"contrast": 0.0},
    "arc_flicker": {"sigma_rel": 0.1},
    "spatter": {"rate_per_frame": 5.0},
}
GUESSED = flags.OFFSET_EXTRAPOLATED.mask | flags.OFFSET_HELD.mask
Posed = list[tuple[Frame, Pose | None]]


def frames_of(path: Path) -> tuple[Setup, Posed]:
    recording = read_recording(path)
    buffer = recording.pose_buffer()
    frames = [
        (f, recording.pose_at(buffer, f.timestamp_s))
        for f in recording.frames()
        if not isinstance(f, BadFrame)
    ]
    return recording.setup, frames


def torch_errors_mm(setup: Setup, frames: Posed, tracks: list[Track], true: dict[int, Float64]) -> Float64:
    """Return the errors (n, 2) as (y, z), mm, of the offsets that are sent on the measured stretch."""
    T_joint_tool = {
        f.index: invert(seam_frame(setup.joint, transform(p.T_base_tool, np.zeros(3)))) @ p.T_base_tool
        for f, p in frames
        if p is not None
    }
    seen = sorted(
        (seam_displacement(setup, T_joint_tool[n], point) for n, point in true.items() if n in T_joint_tool),
        key=lambda at: at[0],
    )
    stations = np.array([station for station, _ in seen])
    # A tool that tilts may look at a place twice.
    forward = np.diff(stations, prepend=-np.inf) > 0.0
    there = CubicSpline(stations[forward], np.array([displacement for _, displacement in seen])[forward])
    errors = []
    for track in tracks:
        torch_mm = T_joint_tool[track.frame][0, 3] if track.frame in T_joint_tool else np.nan
        sent = np.array([track.offset_y_mm, track.offset_z_mm])
        if stations[0] <= torch_mm <= stations[-1] and np.isfinite(sent).all() and not track.flags & GUESSED:
            errors.append(sent - there(torch_mm))
    return np.reshape(errors, (-1, 2))


def columns(errors_mm: Float64) -> str:
    """Return RMS, RMS about the mean and largest about the mean of errors (n, 2)."""
    if not len(errors_mm):
        return 6 * f" {'–':>8}"
    removed = errors_mm - errors_mm.mean(axis=0)
    kinds = np.sqrt(np.mean(errors_mm**2, axis=0)), removed.std(axis=0), np.abs(removed).max(axis=0)
    return "".join(f" {number:8.3f}" for kind in kinds for number in kind)


def print_row(path: Path, setup: Setup, frames: Posed, use_arc_map: bool) -> None:
    truth = read_truth(path)
    if truth is None:
        raise SystemExit(f"{path}: has no truth.csv")
    true = {int(frame): point for frame, point in zip(truth.frames, truth.seam_tool_mm, strict=True)}
    tracker = Tracker(setup, use_arc_map)
    tracks = [tracker.step(frame, pose) for frame, pose in frames]
    wanted = [t for t, (f, _) in zip(tracks, frames, strict=True) if f.laser_on and f.arc_on]
    found = np.array([np.subtract(t.seam_tool_mm, true[t.frame])[1:] for t in wanted if t.valid])
    sent = torch_errors_mm(setup, frames, tracks, true)
    print(
        f"{path.name:20} {'yes' if use_arc_map else 'no':4} {len(found):3d}/{len(wanted):<3d}"
        f"{columns(found.reshape(-1, 2))}   {len(sent):4d}{columns(sent)}",
        flush=True,
    )


def simulated(folder: Path, joint: str, seeds: int, speed_mm_s: float) -> Iterator[Path]:
    """Simulate recordings into a folder and yield them one by one."""
    frames = 1 + round(WAY_MM / speed_mm_s * SimulationPlan.rate_hz)
    for metal in TABLE_1:
        setup = balance(nominal_setup(joint, metal))
        for seed in range(seeds):
            plan = SimulationPlan(frames=frames, travel_speed_mm_s=speed_mm_s, seed=seed, production=True)
            yield simulate_recording(folder / f"{metal}_{seed}", setup, plan, hidden_effects=HIDDEN)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--calibrate-on", type=Path)
    parser.add_argument("--simulate", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--joint", choices=list(DIMENSIONS), default="corrugation")
    parser.add_argument("--speed-mm-s", type=float, default=TRAVEL_MM_S, metavar="SPEED")
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    T_tool_camera = None
    if chosen.calibrate_on:
        setup, frames = frames_of(chosen.calibrate_on)
        T_tool_camera = estimate_hand_eye(setup, [(f, p) for f, p in frames if p is not None]).T_tool_camera
    kinds = f" {'RMS, mm':>17} {'constant removed':>17} {'its maximum':>17}"
    print(f"{'':20} {'arc':4} {'':7}{kinds}   {'at the':>4}{kinds[2:]}")
    axes = 3 * f" {'lateral':>8} {'vertical':>8}"
    print(f"{'recording':20} {'map':4} {'valid':7}{axes}   {'torch':>4}{axes[1:]}")
    with tempfile.TemporaryDirectory() as folder:
        made = simulated(Path(folder), chosen.joint, chosen.simulate, chosen.speed_mm_s)
        for path in itertools.chain(chosen.recordings, made):
            setup, frames = frames_of(path)
            if T_tool_camera is not None:
                setup = replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))
            for use_arc_map in (True, False):
                print_row(path, setup, frames, use_arc_map)


if __name__ == "__main__":
    main()

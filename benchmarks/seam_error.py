"""Seam error against truth.csv, with and without the arc map, side by side; constant part removed and not.

    python benchmarks/seam_error.py RECORDING... [--calibrate-on RECORDING]

With --calibrate-on the camera's pose is first found from that recording's arc light.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from arctrack.recording import BadFrame, read_recording, read_truth
from calibration.hand_eye import estimate_hand_eye
from noise_model.setup import Setup
from tracker.state import Frame, Pose
from tracker.step import Tracker


def frames_of(path: str) -> tuple[Setup, list[tuple[Frame, Pose | None]]]:
    recording = read_recording(path)
    buffer = recording.pose_buffer()
    frames = [
        (f, recording.pose_at(buffer, f.timestamp_s))
        for f in recording.frames()
        if not isinstance(f, BadFrame)
    ]
    return recording.setup, frames


def print_row(path: str, setup: Setup, frames: list[tuple[Frame, Pose | None]], use_arc_map: bool) -> None:
    truth = read_truth(path)
    if truth is None:
        raise SystemExit(f"{path}: has no truth.csv")
    true = {int(frame): point for frame, point in zip(truth.frames, truth.seam_tool_mm, strict=True)}
    tracker = Tracker(setup, use_arc_map)
    tracks = [tracker.step(frame, pose) for frame, pose in frames]
    wanted = [t for t, (f, _) in zip(tracks, frames, strict=True) if f.laser_on and f.arc_on]
    found = np.array([np.subtract(t.seam_tool_mm, true[t.frame])[1:] for t in wanted if t.valid])
    rms, spread = np.sqrt(np.mean(found**2, axis=0)), np.std(found, axis=0)
    worst = np.abs(found - found.mean(axis=0)).max(axis=0)
    print(
        f"{Path(path).name:20} {'yes' if use_arc_map else 'no':4} {len(found):3d}/{len(wanted):<3d} "
        f"{rms[0]:8.3f} {rms[1]:8.3f} {spread[0]:9.4f} {spread[1]:8.4f} {worst[0]:9.3f} {worst[1]:8.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--calibrate-on")
    chosen = parser.parse_args()
    T_tool_camera = None
    if chosen.calibrate_on:
        setup, frames = frames_of(chosen.calibrate_on)
        T_tool_camera = estimate_hand_eye(setup, [(f, p) for f, p in frames if p is not None]).T_tool_camera
    print(f"{'':20} {'arc':4} {'':7} {'RMS, mm':>17} {'constant part removed':>18} {'its maximum':>18}")
    print(f"{'recording':20} {'map':4} {'valid':7}" + 3 * f" {'lateral':>8} {'vertical':>8}")
    for path in chosen.recordings:
        setup, frames = frames_of(path)
        if T_tool_camera is not None:
            setup = replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))
        for use_arc_map in (True, False):
            print_row(path, setup, frames, use_arc_map)


if __name__ == "__main__":
    main()

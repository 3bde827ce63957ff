"""Predicted against recorded arc images of the laser-off frames, after one level per recording.

    python benchmarks/arc_image.py RECORDING...

Twice: with the camera as stated, and with its pose found from the arc's light (`calibrate hand-eye`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arctrack.recording import BadFrame, read_recording
from calibration.hand_eye_arc import estimate_hand_eye
from noise_model.setup import Setup
from tracker.state import Frame, Pose
from validation.second_renderer.agreement import arc_agreement


def read(path: str) -> tuple[str, Setup, list[tuple[Frame, Pose]]]:
    recording = read_recording(path)
    buffer = recording.pose_buffer()
    posed = [
        (f, recording.pose_at(buffer, f.timestamp_s))
        for f in recording.frames()
        if not isinstance(f, BadFrame)
    ]
    return recording.name, recording.setup, [(frame, pose) for frame, pose in posed if pose is not None]


def row(name: str, camera: str, setup: Setup, frames: Sequence[tuple[Frame, Pose]]) -> None:
    agreement = arc_agreement(setup, frames)
    worst = agreement.median_ratio[np.argmax(np.abs(agreement.median_ratio - 1.0))]
    share = agreement.within_5_percent
    print(
        f"{name:20} {camera:10} {agreement.level:8.4f} {worst:14.4f} "
        f"{np.average(share, weights=agreement.blocks):12.1%} {share.min():12.1%} {len(agreement.frames):7d}"
    )


def main(paths: list[str]) -> None:
    print(f"{'':39} {'median ratio':>14} {'blocks within 5 %':>25}")
    print(
        f"{'recording':20} {'camera':10} {'level':>8} {'worst frame':>14} {'all':>12} {'worst frame':>12} "
        f"{'frames':>7}"
    )
    for path in paths:
        name, setup, frames = read(path)
        row(name, "stated", setup, frames)
        T_tool_camera = estimate_hand_eye(setup, frames).T_tool_camera
        row(name, "found", replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera)), frames)


if __name__ == "__main__":
    main(sys.argv[1:])

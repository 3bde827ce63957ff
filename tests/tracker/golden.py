"""The golden replay: stored frames, and what the tracker made of them when it was last changed on purpose.

`python tests/tracker/golden.py --regenerate` writes the reference anew from the stored frames, with
`--render` the frames too.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from rendered import CURRENT_A, EXPOSURE_S, frame_of, pose_at, small_setup

from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from tracker.state import Frame, Pose, Track
from tracker.tracker import Tracker

HERE = Path(__file__).parent
FRAMES, STRIPES, SEAMS = HERE / "golden", HERE / "golden_stripes.csv", HERE / "golden_seams.csv"

SEAM = SeamLine(0.0, 1.3, -0.4, 0.01, 0.002)
CASES: dict[str, tuple[Setup, tuple[Pose, ...]]] = {
    "v_groove": (small_setup("v_groove"), (pose_at(0.0), pose_at(8.0, 0.5, -0.5, (1.0, -2.0, 2.0)))),
    "v_groove_upright": (small_setup("v_groove", upright=True), (pose_at(4.0),)),
    "lap": (small_setup("lap"), (pose_at(0.0),)),
    "corrugation": (small_setup("corrugation"), (pose_at(-10.0),)),
}


def stored(case: str, index: int) -> Path:
    return FRAMES / f"{case}_{index}.png"


def replay() -> Iterator[tuple[str, Track]]:
    """Every stored frame's track."""
    for case, (setup, poses) in CASES.items():
        tracker = Tracker(setup)
        for index, pose in enumerate(poses):
            image = cv2.imread(str(stored(case, index)), cv2.IMREAD_UNCHANGED)
            assert image is not None, stored(case, index)
            yield case, tracker.step(Frame(index, 0.1 * index, image, EXPOSURE_S, CURRENT_A), pose)


def seam_row(track: Track) -> list[float]:
    offset = (track.offset_y_mm, track.offset_z_mm)
    return [*track.seam_tool_mm, *offset, track.gap_mm, track.mismatch_mm]


def render() -> None:
    FRAMES.mkdir(exist_ok=True)
    for case, (setup, poses) in CASES.items():
        for index, pose in enumerate(poses):
            image = frame_of(setup, pose, SEAM, index=index).image_dn
            cv2.imwrite(str(stored(case, index)), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def regenerate() -> None:
    with STRIPES.open("w", newline="") as stripes, SEAMS.open("w", newline="") as seams:
        write_stripe, write_seam = csv.writer(stripes), csv.writer(seams)
        write_stripe.writerow(["case", "frame", "scan", "position_px"])
        write_seam.writerow(
            [
                "case",
                "frame",
                "seam_x_mm",
                "seam_y_mm",
                "seam_z_mm",
                "offset_y_mm",
                "offset_z_mm",
                "gap_mm",
                "mismatch_mm",
            ]
        )
        for case, track in replay():
            assert track.valid
            assert track.stripe is not None
            for scan in np.flatnonzero(np.isfinite(track.stripe.position_px))[::4]:
                write_stripe.writerow([case, track.frame, scan, f"{track.stripe.position_px[scan]:.6f}"])
            write_seam.writerow([case, track.frame, *(f"{value:.6f}" for value in seam_row(track))])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--regenerate", action="store_true", help="write the reference anew")
    parser.add_argument("--render", action="store_true", help="write the frames anew")
    options = parser.parse_args()
    if options.render:
        render()
    if options.regenerate:
        regenerate()

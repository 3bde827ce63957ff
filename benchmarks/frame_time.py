"""Milliseconds a frame of `Tracker.step` at 640x480 after warm-up, beside one pass over the frame.

    python benchmarks/frame_time.py [--repeats N]

Simulated frames of the three joints, laser and arc on; run it under `taskset -c 0` for one core.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from arctrack.nominal import nominal_setup
from arctrack.simulate import balance
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from tracker.state import Frame, Pose
from tracker.step import Tracker

JOINTS = (("v_groove", "mild_steel"), ("lap", "zn_coated"), ("corrugation", "zn_coated"))
FRAMES = 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    cv2.setNumThreads(1)
    print(f"{'joint':14} {'p50, ms':>9} {'p99, ms':>9} {'max, ms':>9} {'p50 / one pass':>16}")
    for joint, material in JOINTS:
        setup = balance(nominal_setup(joint, material))
        rng = np.random.default_rng(0)
        frames = []
        for i in range(FRAMES):
            T_base_tool = np.eye(4)
            T_base_tool[:3, 3] = [2.0 * i, rng.uniform(-1.0, 1.0), rng.uniform(0.0, 1.0)]
            image = draw_frame(setup, T_base_tool, Condition(1.0, 1.0, 0.005), rng)
            frames.append((Frame(i, 0.1 * i, image, 0.005, 100.0), Pose(T_base_tool)))
        tracker = Tracker(setup)
        for frame, pose in frames:
            tracker.step(frame, pose)
        took_ms = []
        for _ in range(repeats):
            for frame, pose in frames:
                started = time.perf_counter()
                tracker.step(frame, pose)
                took_ms.append(1e3 * (time.perf_counter() - started))
        passes_ms = []
        for _ in range(200):
            started = time.perf_counter()
            cv2.sumElems(frames[0][0].image_dn)
            passes_ms.append(1e3 * (time.perf_counter() - started))
        p50, p99 = np.percentile(took_ms, [50, 99])
        print(f"{joint:14} {p50:9.2f} {p99:9.2f} {max(took_ms):9.2f} {p50 / np.median(passes_ms):16.0f}")


if __name__ == "__main__":
    main()

"""The seam's error with the arc map and without, where what the map is made of is wrong.

    python benchmarks/wrong_map.py [--frames N]

Frames of 640x480 drawn from the forward model, laser and arc on, tracked with a setup whose metal, arc centre
(x, y, z, mm) or arc output is another one. RMS over the frames with its mean removed, mm, and the 95 %
interval of the ratio of the two over frames drawn again: above 1 the map hurts.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from seam_truth import seam_in_tool

from arctrack.nominal import nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import SeamLine
from tracker.state import Frame, Pose
from tracker.tracker import Tracker

JOINTS = (("v_groove", "mild_steel"), ("lap", "zn_coated"), ("corrugation", "zn_coated"))
SEAM = SeamLine(0.0, 0.4, -0.2)
EXPOSURE_S, CURRENT_A = 0.005, 100.0
DRAWS = 2000


def believed(setup: Setup) -> Iterator[tuple[str, Setup]]:
    """Yield what a tracker may believe of a setup: itself first, then with one thing wrong."""
    x, y, z = setup.arc.center_in_tool_mm
    yield "right", setup
    other = TABLE_1["zn_coated" if setup.material.name == "mild_steel" else "mild_steel"]
    yield "metal", replace(setup, material=other)
    for off_mm in ((0.0, 0.0, -2.0), (0.0, 0.0, 2.0), (10.0, 0.0, 0.0), (-20.0, 0.0, 0.0), (0.0, 15.0, 5.0)):
        moved = x + off_mm[0], y + off_mm[1], z + off_mm[2]
        name = "arc " + ",".join(f"{step:+.0f}" for step in off_mm)
        yield name, replace(setup, arc=replace(setup.arc, center_in_tool_mm=moved))
    for factor in (0.1, 0.5, 2.0, 10.0):
        yield (
            f"arc x {factor:g}",
            replace(setup, arc=replace(setup.arc, radiance_e=factor * setup.arc.radiance_e)),
        )


def drawn(setup: Setup, n: int) -> list[tuple[Frame, Pose, Float64]]:
    """Draw frames along a seam, with their poses and the true seam points (3,), tool frame, mm."""
    rng = np.random.default_rng(0)
    frames = []
    for i in range(n):
        T_base_tool = np.eye(4)
        T_base_tool[:3, 3] = [1.5 * i, rng.uniform(-1.0, 1.0), rng.uniform(0.0, 1.0)]
        scene = make_scene(setup, T_base_tool, SEAM)
        image = draw_frame(setup, T_base_tool, Condition(1.0, 1.0, EXPOSURE_S), rng, seam=SEAM)
        truth = seam_in_tool(setup, scene)
        frames.append((Frame(i, 0.1 * i, image, EXPOSURE_S, CURRENT_A), Pose(T_base_tool), truth))
    return frames


def errors_mm(setup: Setup, frames: list[tuple[Frame, Pose, Float64]], use_arc_map: bool) -> Float64:
    """Return the errors (n, 2) as (y, z), mm, of frames that are tracked one after the other, NaN if not."""
    tracker = Tracker(setup, use_arc_map)
    off = np.full((len(frames), 2), np.nan)
    for n, (frame, pose, truth) in enumerate(frames):
        track = tracker.step(frame, pose)
        if track.valid:
            off[n] = (np.array(track.seam_tool_mm) - truth)[1:]
    return off


def rms(off: Float64) -> Float64:
    """Return the RMS (2,) about the mean of errors (n, 2)."""
    return np.asarray(np.nanstd(off, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40)
    n = parser.parse_args().frames
    cv2.setNumThreads(1)
    print(
        "joint        wrong         valid with, without   RMS y, z with   and without     ratios' 95 %: y, z"
    )
    for joint, material in JOINTS:
        setup = balance(nominal_setup(joint, material))
        frames = drawn(setup, n)
        for name, wrong in believed(setup):
            found = [errors_mm(wrong, frames, use) for use in (True, False)]
            both = np.isfinite(found[0][:, 0]) & np.isfinite(found[1][:, 0])
            with_map, without = (off[both] for off in found)
            again = np.random.default_rng(1).integers(0, len(with_map), (DRAWS, len(with_map)))
            ratios = np.array([rms(with_map[one]) / rms(without[one]) for one in again])
            low, high = np.quantile(ratios, [0.025, 0.975], axis=0)
            valid = [int(np.isfinite(off[:, 0]).sum()) for off in found]
            (y, z), (y_without, z_without) = rms(with_map), rms(without)
            print(
                f"{joint:12} {name:13} {valid[0]:6} {valid[1]:8}   {y:.4f} {z:.4f} "
                f"  {y_without:.4f} {z_without:.4f}"
                f"   {low[0]:.2f}-{high[0]:.2f}  {low[1]:.2f}-{high[1]:.2f}"
            )


if __name__ == "__main__":
    main()

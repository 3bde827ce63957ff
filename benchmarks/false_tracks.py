"""Frames of the arc alone that the tracker takes for a seam, though it is told that the laser is on.

    python benchmarks/false_tracks.py [--frames N] [--seed K] [--blocks] [--joint JOINT]

Frames of 320x240 drawn from the forward model: every joint, materials, poses, seams off their place, arc
levels, the camera off by its tolerance, and for half of the poses one of the effects (not the slow ones), of
which the tracker knows nothing. Each pose is drawn FRAMES_A_SCENE times, by turns for one that searches
and for one that knows the seam: each of these has a level, random effects and noise of its own. --blocks adds
frames of blocks of random codes, which no forward model makes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import DIMENSIONS, nominal_setup
from arctrack.simulation.simulate import balance
from noise_model.condition import Condition
from noise_model.effects import REGISTRY
from noise_model.forward import Renderer, draw_frame
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import SeamLine
from tracker.geometry import SensorGeometry
from tracker.seam.gaussian_process import SeamHistory
from tracker.state import Frame, Pose
from tracker.step import step
from tracker.stripe.read import Work
from tracker.tracker_state import TrackerMemory

FRAMES_A_SCENE = 20
EXPOSURE_S = 0.005
SLOW = ("interreflection", "argon_line_leak", "filter_shift")
EFFECTS = [name for name in REGISTRY if name not in SLOW]
STATIONS_MM = np.arange(-60.0, 100.0, 4.0)


def known_seam(seam: SeamLine) -> TrackerMemory:
    """Return a state that has seen the seam where it is."""
    history = SeamHistory()
    for station in STATIONS_MM:
        history = history.with_measurement(station, np.array([seam.y_mm, seam.z_mm]), np.full(2, 0.01**2))
    return TrackerMemory(history)


def count(setup: Setup, true: Setup, rng: np.random.Generator, of: Counter[str], frames: int) -> None:
    """Draw a pose's frames and count those that are tracked, by joint."""
    seam = SeamLine(0.0, *rng.uniform(-1.0, 1.0, 2))
    T_base_tool = np.eye(4)
    T_base_tool[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 2.0, 3), degrees=True).as_matrix()
    T_base_tool[:3, 3] = rng.uniform(-60.0, 60.0), *rng.normal(0.0, 1.0, 2)
    geometry, renderer = SensorGeometry.of(setup), Renderer()
    states, work = (TrackerMemory(), known_seam(seam)), Work.of(geometry)
    for i in range(frames):
        level = 4.0 ** rng.uniform(-1.5, 1.0)
        condition = Condition(0.0, level, EXPOSURE_S, 0.1 * i)
        image = draw_frame(true, T_base_tool, condition, rng, seam=seam, renderer=renderer)
        frame = Frame(i, 0.1 * i, image, EXPOSURE_S)
        track = step(geometry, states[i % 2], frame, Pose(T_base_tool), work)[1]
        of["frames"] += 1
        if track.stripe is not None:
            of["lines"] += int(np.isfinite(track.stripe.position_px).sum())
        if track.valid:
            of["tracked"] += 1
            print(
                f"  tracked: {setup.joint.type} of {setup.material.name}, "
                f"{', '.join(true.effects) or 'no effect'}, {track.flag_names}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--blocks", action="store_true")
    parser.add_argument("--joint", choices=list(DIMENSIONS), action="append")
    chosen = parser.parse_args()
    joints = chosen.joint or list(DIMENSIONS)
    counts: dict[str, Counter[str]] = {joint: Counter() for joint in joints}
    for scene in range(-(-chosen.frames // FRAMES_A_SCENE)):
        rng = np.random.default_rng([chosen.seed, scene])
        joint = joints[scene % len(joints)]
        setup = balance(nominal_setup(joint, str(rng.choice(list(TABLE_1))), width=320, height=240))
        effects = {str(rng.choice(EFFECTS)): {}} if rng.random() < 0.5 else {}
        camera = setup.camera
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(
            rng.normal(0.0, setup.tolerance.hand_eye_deg, 3), degrees=True
        ).as_matrix()
        off[:3, 3] = rng.normal(0.0, setup.tolerance.hand_eye_mm, 3)
        camera = replace(camera, T_tool_camera=camera.T_tool_camera @ off)
        count(setup, replace(setup, camera=camera, effects=effects), rng, counts[joint], FRAMES_A_SCENE)
    for joint, of in counts.items():
        lines = of["lines"] / max(1, 320 * of["frames"])
        print(
            f"{joint:12} {of['tracked']:4} of {of['frames']} frames tracked, {100 * lines:.2f} % of the lines"
        )
    if chosen.blocks:
        print_blocks(np.random.default_rng(chosen.seed), joints)


def print_blocks(rng: np.random.Generator, joints: list[str]) -> None:
    for joint in joints:
        setup = balance(nominal_setup(joint, "zn_coated", width=320, height=240))
        geometry = SensorGeometry.of(setup)
        work, tracked = Work.of(geometry), 0
        for i in range(200):
            size = int(rng.integers(2, 33))
            blocks = rng.integers(0, 256, (240 // size + 1, 320 // size + 1))
            image = np.kron(blocks, np.ones((size, size)))[:240, :320].astype(np.uint8)
            frame = Frame(i, 0.1 * i, image, EXPOSURE_S)
            state = (TrackerMemory(), known_seam(SeamLine(0.0, 0.0, 0.0)))[i % 2]
            tracked += step(geometry, state, frame, Pose(np.eye(4)), work)[1].valid
        print(f"{joint:12} {tracked:4} of 200 frames of random blocks tracked")


if __name__ == "__main__":
    main()

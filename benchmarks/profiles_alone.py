"""Profiles alone beside images of the same parts: errors over sigma, RMS and time of a step, joint by joint.

    python benchmarks/profiles_alone.py [--parts 10] [--frames 6] [--seed 1] [--joint NAME] [--arc]
                                       [--columns 1280]

Each part has dimensions, a place and a roll of its own; the tool goes on by 0.8 mm from frame to frame, aside
and tilted at random. A profiler and a camera with its laser see the same part from the same poses, in the
same sheet, over 38 mm, the camera with 640 columns. Profiles have noise of 0.01 mm in common over three
columns, 5 % dropouts and 3 % false echoes; images have speckle, and with `--arc` the light of an arc. The
truth is where the drawn seam meets the sheet. Both trackers know the part's dimensions, and a sensor that is
exact. Times are the CPU's.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import DIMENSIONS, nominal_setup, with_profiler
from arctrack.simulation.simulate import balance
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.drawn_profile import draw_profile
from noise_model.forward import Renderer, draw_frame
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup
from noise_model.setup_keys import Tolerance
from noise_model.surface.joint import SeamLine, corrugation_height, seam_height_mm
from noise_model.transforms import invert, transform
from tracker.state import Frame, Pose
from tracker.tracker import Tracker

JOINTS = tuple(name for name in DIMENSIONS if name != "outside_corner")
FALSE_SIGMAS, FALSE_MM = 5.0, 0.25
STEP_MM = 0.8
EXACT = Tolerance(hand_eye_deg=0.0, hand_eye_mm=0.0)
KINDS = ("image", "profile")


@dataclass
class Tally:
    """Frames of one joint by one kind of sensor: errors and sigmas (y, z), mm, of valid ones; times, s."""

    n_frames: int = 0
    errors_mm: list[Float64] = field(default_factory=list)
    sigmas_mm: list[Float64] = field(default_factory=list)
    searched_s: list[float] = field(default_factory=list)
    tracked_s: list[float] = field(default_factory=list)

    @property
    def rms_mm(self) -> Float64:
        """RMS of the errors (y, z), mm."""
        return np.asarray(np.sqrt(np.mean(np.square(self.errors_mm), axis=0)))

    @property
    def over_sigma(self) -> Float64:
        """RMS of the errors (y, z) over their sigmas."""
        shares = np.divide(self.errors_mm, self.sigmas_mm)
        return np.asarray(np.sqrt(np.mean(np.square(shares), axis=0)))

    @property
    def n_false(self) -> int:
        """Number of valid frames wrong beyond FALSE_SIGMAS and FALSE_MM."""
        errors, sigmas = np.abs(self.errors_mm), np.array(self.sigmas_mm)
        return int(((errors > FALSE_MM) & (errors > FALSE_SIGMAS * sigmas)).any(axis=1).sum())


def drawn_setup(joint: str, rng: np.random.Generator) -> Setup:
    """Return the setup of a camera over a part whose dimensions are drawn, a fifth off the nominal ones."""
    setup = replace(nominal_setup(joint, "mild_steel"), tolerance=EXACT)
    kept = ("pitch_mm", "width_mm")
    size = {
        name: value * (1.0 if name in kept else rng.uniform(0.8, 1.2))
        for name, value in DIMENSIONS[joint].items()
    }
    return balance(replace(setup, joint=replace(setup.joint, dimensions=size)))


def pose_at(x_mm: float, rng: np.random.Generator, height_mm: float) -> Float64:
    """Return a tool's pose (4, 4) near the nominal seam."""
    T = np.eye(4)
    T[:3, 3] = x_mm, rng.normal(0.0, 0.3), height_mm + rng.normal(0.0, 0.3)
    T[:3, :3] = Rotation.from_euler("xyz", rng.normal(0.0, 1.0, 3), degrees=True).as_matrix()
    return T


def true_point(setup: Setup, T_base_tool: Float64, seam: SeamLine) -> Float64:
    """Return where the seam meets the sheet (3,), tool frame, mm."""
    scene = make_scene(setup, T_base_tool, seam)
    height_mm, T_joint_tool = seam_height_mm(setup.joint), scene.T_joint_tool
    T_tool_joint = invert(T_joint_tool)
    normal, offset = np.array(setup.laser.plane_in_tool[:3]), setup.laser.plane_in_tool[3]
    along = normal @ T_tool_joint[:3, 0]
    x_mm = 0.0
    for _ in range(200):
        rise_mm = float(corrugation_height(np.array(x_mm), scene.shape.corrugation))
        point = transform(T_tool_joint, np.array([0.0, 0.0, height_mm + rise_mm]))
        x_mm = float(-(normal @ point + offset) / along)
    return np.asarray(transform(T_tool_joint, np.array([x_mm, 0.0, height_mm + rise_mm])))


def run_part(
    joint: str, seed: int, n_frames: int, columns: int, arc: bool, tallies: dict[str, Tally]
) -> None:
    """Track one part by either kind of sensor."""
    rng = np.random.default_rng([seed, 0])
    imaged = drawn_setup(joint, rng)
    setups = {"image": imaged, "profile": with_profiler(imaged, columns)}
    seen = replace(imaged, effects={"laser_speckle": expected_speckle(imaged)})
    seam = SeamLine(0.0, rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), 0.0, 0.0, rng.normal(0.0, 0.02))
    trackers = {kind: Tracker(setup) for kind, setup in setups.items()}
    for tracker in trackers.values():
        tracker.warm_up()
    renderer, noise = Renderer(1), np.random.default_rng([seed, 1])
    start_mm = rng.uniform(0.0, 200.0)
    for n in range(n_frames):
        x_mm = start_mm + STEP_MM * n
        rise_mm = make_scene(imaged, np.eye(4)).shape.corrugation
        height_mm = float(corrugation_height(np.array(x_mm), rise_mm))
        T_base_tool = pose_at(x_mm, rng, height_mm)
        condition = Condition(1.0, float(arc), imaged.camera.exposure_s, 0.1 * n)
        images = {
            "image": draw_frame(
                seen, T_base_tool, condition, noise, seam=seam, renderer=renderer, part_seed=seed
            ),
            "profile": draw_profile(
                setups["profile"], make_scene(setups["profile"], T_base_tool, seam), noise
            ),
        }
        for kind, tracker in trackers.items():
            tally, setup = tallies[kind], setups[kind]
            current_a = imaged.arc.current_a if arc else 0.0
            frame = Frame(n, 0.1 * n, images[kind], setup.camera.exposure_s, current_a, arc_on=arc)
            began_s = time.thread_time()
            track = tracker.step(frame, Pose(T_base_tool))
            took_s = time.thread_time() - began_s
            (tally.searched_s if n == 0 else tally.tracked_s).append(took_s)
            tally.n_frames += 1
            if track.valid:
                truth = true_point(setup, T_base_tool, seam)
                tally.errors_mm.append(np.asarray(track.seam_tool_mm)[1:] - truth[1:])
                tally.sigmas_mm.append(np.array([track.sigma_y_mm, track.sigma_z_mm]))


def main() -> None:
    """Print a line for each joint and kind of sensor."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--parts", type=int, default=10)
    arguments.add_argument("--frames", type=int, default=6)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--joint", choices=JOINTS)
    arguments.add_argument("--columns", type=int, default=1280, help="of a profile")
    arguments.add_argument("--arc", action="store_true", help="the arc burns while images are taken")
    given = arguments.parse_args()
    print(f"{'joint':12} {'kind':8} valid     RMS y   z mm   error/sigma y   z  false  step ms, search")
    for joint in (given.joint,) if given.joint else JOINTS:
        tallies = {kind: Tally() for kind in KINDS}
        for part in range(given.parts):
            run_part(joint, given.seed * 1000 + part, given.frames, given.columns, given.arc, tallies)
        for kind, tally in tallies.items():
            (rms_y, rms_z), (over_y, over_z) = tally.rms_mm, tally.over_sigma
            step_ms, search_ms = (1e3 * np.median(took) for took in (tally.tracked_s, tally.searched_s))
            print(
                f"{joint:12} {kind:8} {len(tally.errors_mm):3}/{tally.n_frames:3} {rms_y:7.4f} {rms_z:7.4f}"
                f" {over_y:8.2f} {over_z:6.2f} {tally.n_false:5} {step_ms:8.2f} {search_ms:7.2f}",
                flush=True,
            )
        image, profile = (tallies[kind] for kind in KINDS)
        ratio_y, ratio_z = profile.rms_mm / image.rms_mm
        steps = np.median(profile.tracked_s) / np.median(image.tracked_s)
        print(f"{joint:12} ratio            {ratio_y:7.2f} {ratio_z:7.2f} {'':23}{steps:8.2f}", flush=True)


if __name__ == "__main__":
    main()

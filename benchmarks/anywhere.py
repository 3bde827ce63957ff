"""The tracker anywhere: joints, views, metals, lasers, sensors at random, in a world that is not the model.

    python benchmarks/anywhere.py [--draws 60] [--frames 6] [--seed 1] [--workers 2] [--pictures FOLDER]

Each draw states a setup with the true camera and dimensions. What it does not state: where the seam runs,
speckle, the frame's noise. Some draws are plates without the joint that the setup states. Told by joint and
by view: how many frames are valid, errors across (y) and along the normal (z), error over sigma, and valid
frames that are wrong beyond 5 sigma and 0.25 mm. `--pictures` draws the ten worst frames.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from swept_world import Speckle, SweptJoint, SweptWorld, departure

from arctrack.nominal import nominal_setup
from noise_model.arrays import Float64
from noise_model.setup import Setup, Tolerance
from noise_model.surface.joint import Joint
from tracker.state import Frame, Pose
from tracker.tracker import Tracker

JOINTS = (
    "v_groove", "closed_v", "u_groove", "half_v", "lap", "corrugation", "butt", "fillet", "plate",
)  # fmt: skip
VIEWS = ("ahead", "behind", "beside", "steep")
SIZES = ((320, 240), (480, 360), (640, 480))
STEP_MM = 0.8
"""How far the tool goes from frame to frame."""

EXACT = 1e-5
FALSE_SIGMAS, FALSE_MM = 5.0, 0.25
WORST, SIGMA_FLOOR_MM = 10, 0.02
"""So many frames are told as the worst, by their error over sigma, which counts as this at least."""


@dataclass(frozen=True)
class Scene:
    """One draw: what is stated, what is there, and how the tool goes."""

    seed: int
    joint: str
    view: str
    setup: Setup
    world: SweptJoint
    speckle: Speckle
    arc_on: bool
    poses: tuple[Float64, ...]


@dataclass(frozen=True)
class Outcome:
    """One frame's track beside the truth; NaN where there is no seam."""

    seed: int
    scene: str
    joint: str
    view: str
    frame: int
    valid: bool
    error_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    flags: str

    @property
    def is_false(self) -> bool:
        """Whether the frame is valid and wrong."""
        if not self.valid:
            return False
        if self.joint == "plate":
            return True
        pairs = zip(self.error_mm, self.sigma_mm, strict=True)
        return any(abs(e) > FALSE_MM and abs(e) > FALSE_SIGMAS * s for e, s in pairs)


def draw_scene(seed: int, n_frames: int) -> Scene:
    """Draw a scene; equal seeds give equal scenes."""
    draw = np.random.default_rng([seed, 0])
    joint, view = JOINTS[seed % len(JOINTS)], VIEWS[(seed // len(JOINTS)) % len(VIEWS)]
    even = draw.uniform
    dimensions = {
        "v_groove": lambda: _groove("included_angle_deg", even(50, 90), even(2.5, 6), even(0.8, 2)),
        "closed_v": lambda: _groove("included_angle_deg", even(50, 90), even(2.5, 6), 0.0),
        "u_groove": lambda: (
            _groove("bevel_angle_deg", even(10, 25), even(4, 7), even(0.8, 2))
            | {"root_radius_mm": even(2, 3.5)}
        ),
        "half_v": lambda: _groove("bevel_angle_deg", even(30, 55), even(2.5, 5), even(0.8, 2)),
        "lap": lambda: {"thickness_mm": even(0.8, 3)},
        "corrugation": lambda: (
            {"thickness_mm": even(0.8, 2), "height_mm": even(3, 8)} | {"pitch_mm": 60.0, "width_mm": 30.0}
        ),
        "butt": lambda: {"gap_mm": even(0.8, 2), "thickness_mm": even(2, 5)},
        "fillet": lambda: {"included_angle_deg": even(70, 110)},
    }
    stated_type = draw.choice(["v_groove", "butt", "lap", "fillet", "half_v"]) if joint == "plate" else joint
    size = dimensions[stated_type]()
    joint_type = "v_groove" if stated_type == "closed_v" else str(stated_type)
    width, height = SIZES[draw.integers(len(SIZES))]
    metal = ["mild_steel", "zn_coated"][draw.integers(2)]
    setup = nominal_setup(joint_type, metal, width=width, height=height)
    tilt_deg = draw.uniform(8, 18) if view == "steep" else draw.uniform(25, 42)
    azimuth_deg = {
        "ahead": draw.uniform(-15, 15),
        "behind": 180.0 + draw.uniform(-15, 15),
        "beside": draw.choice([-1, 1]) * draw.uniform(30, 60),
        "steep": draw.uniform(-40, 40),
    }[view]
    far, aim = draw.uniform(100, 160), np.array([35.0, 0.0, 0.0])
    lean = np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
    tilt = math.radians(tilt_deg)
    eye = aim + far * np.array([*(math.sin(tilt) * lean), math.cos(tilt)])
    turned = bool(draw.random() < 0.25)
    px_per_mm = math.exp(draw.uniform(math.log(6.0), math.log(18.0))) * width / 640.0
    focal_px = px_per_mm * far
    camera = replace(
        setup.camera,
        fx=focal_px,
        fy=focal_px,
        T_tool_camera=_looking(eye, aim, turned),
    )
    laser = replace(
        setup.laser,
        stripe_sigma_mm=draw.uniform(0.15, 0.45),
        peak_e=math.exp(draw.uniform(math.log(3e3), math.log(14e3))),
    )
    exact = Tolerance(hand_eye_deg=EXACT, hand_eye_mm=EXACT)
    seam = ((-100.0, 0.0, 0.0), (1000.0, 0.0, 0.0))
    setup = replace(
        setup,
        camera=camera,
        laser=laser,
        tolerance=exact,
        joint=Joint(joint_type, {k: float(v) for k, v in size.items()}, seam),
    )
    there = setup.joint if joint != "plate" else Joint("flat", {}, seam)
    slope = 0.0 if joint_type == "corrugation" else draw.uniform(-0.01, 0.01)
    world = SweptJoint.of(there, draw.uniform(-1.5, 1.5), draw.uniform(100, 250), slope)
    contrast = 0.0 if draw.random() < 0.3 else draw.uniform(0.05, 0.6)
    speckle = Speckle(contrast, draw.uniform(0.5, 1.3))
    arc_on = bool(draw.random() < 0.4)
    yaw, pitch, roll = draw.uniform(-3, 3), draw.uniform(-3, 3), draw.uniform(-3, 3)
    start, y_off, z_off = draw.uniform(0, 60), draw.uniform(-1, 1), draw.uniform(0, 1.5)
    poses = []
    for n in range(n_frames):
        T = np.eye(4)
        wobble = 0.5 * np.sin(0.7 * n + draw.uniform(0, 0.1))
        T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch + wobble, roll], degrees=True).as_matrix()
        x = start + STEP_MM * n
        lift = float(departure(x, world.bend)[2])
        T[:3, 3] = x, y_off + 0.2 * math.sin(0.9 * n), z_off + lift
        poses.append(T)
    if arc_on:
        setup = _balanced(setup, world, poses[0])
    return Scene(seed, joint, view, setup, world, speckle, arc_on, tuple(poses))


def _groove(angle: str, angle_deg: float, depth_mm: float, gap_mm: float) -> dict[str, float]:
    return {angle: angle_deg, "depth_mm": depth_mm, "root_gap_mm": gap_mm}


def _looking(eye: Float64, aim: Float64, turned: bool) -> Float64:
    """Return T_tool_camera of a camera whose rows run along the tool's y, or, turned, along its x."""
    z_axis = (aim - eye) / np.linalg.norm(aim - eye)
    along = np.array([1.0, 0.0, 0.0]) if turned else np.array([0.0, -1.0, 0.0])
    x_axis = along - (along @ z_axis) * z_axis
    x_axis /= np.linalg.norm(x_axis)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    T[:3, 3] = eye
    return T


def _balanced(setup: Setup, world: SweptJoint, T_base_tool: Float64) -> Setup:
    """Return the setup with the arc's radiance that an aperture chosen well gives it."""
    small = setup.camera.coarser(8)
    bright = replace(setup, camera=small, arc=replace(setup.arc, radiance_e=1.0))
    light = SweptWorld(bright, world, Speckle(0.0, 1.0)).arc_light(T_base_tool)
    share = min(0.12 / float(light.mean()), 0.8 / float(np.quantile(light, 0.97)))
    return replace(setup, arc=replace(setup.arc, radiance_e=share * setup.sensor.full_well_e))


def frames_of(scene: Scene) -> Iterable[tuple[Frame, Pose, Float64]]:
    """Yield frames, poses and true seam points (3,), mm, tool frame."""
    world = SweptWorld(scene.setup, scene.world, scene.speckle)
    arc = scene.setup.arc.current_a if scene.arc_on else 0.0
    for n, T in enumerate(scene.poses):
        draw = np.random.default_rng([scene.seed, 1, n])
        image = world.frame(T, True, scene.arc_on, draw)
        frame = Frame(n, 0.1 * n, image, scene.setup.camera.exposure_s, arc, True, scene.arc_on)
        yield frame, Pose(T), scene.world.seam_tool_mm(scene.setup, T)


def run(seed: int, n_frames: int) -> list[Outcome]:
    """Track one scene; return its frames' outcomes."""
    scene = draw_scene(seed, n_frames)
    name = (
        f"{seed} {scene.joint} {scene.view} {scene.setup.camera.width}px C={scene.speckle.contrast:.2f} "
        f"{'arc' if scene.arc_on else 'dry'} {scene.setup.material.name}"
    )
    try:
        tracker = Tracker(scene.setup)
    except ValueError as error:
        print(f"{name}: no setup: {error}", flush=True)
        return []
    outcomes = []
    for frame, pose, truth in frames_of(scene):
        track = tracker.step(frame, pose)
        error_y, error_z = np.subtract(track.seam_tool_mm, truth)[1:].tolist()
        sigma = track.sigma_y_mm, track.sigma_z_mm
        place = seed, name, scene.joint, scene.view, frame.index
        outcomes.append(Outcome(*place, track.valid, (error_y, error_z), sigma, ",".join(track.flag_names)))
    return outcomes


def draw_picture(outcome: Outcome, n_frames: int, folder: Path) -> None:
    """Draw the frame of an outcome into a folder; the scene is made again."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame, _, _ in frames_of(draw_scene(outcome.seed, n_frames)):
        if frame.index == outcome.frame:
            name = f"{outcome.scene.replace(' ', '_')}_{frame.index}.png"
            cv2.imwrite(str(folder / name), frame.image_dn)
            return


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def table(outcomes: list[Outcome], by: str) -> None:
    """Print what was seen, a line a group."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[str(getattr(outcome, by))].append(outcome)
    print(f"\n{by:12} frames  valid   RMS y   RMS z  99 % |y|  e/s y  e/s z  false")
    for name, group in groups.items():
        used = [o for o in group if o.valid]
        error, pulls = _errors(used)
        worst = float(np.quantile(np.abs(error[:, 0]), 0.99)) if len(used) else math.nan
        share, wrong = 100 * len(used) / len(group), sum(o.is_false for o in group)
        print(
            f"{name:12} {len(group):6} {share:5.0f}% {_rms(error[:, 0]):7.3f} {_rms(error[:, 1]):7.3f} "
            f"{worst:9.3f} {_rms(pulls[:, 0]):6.2f} {_rms(pulls[:, 1]):6.2f} {wrong:6}"
        )


def _errors(used: list[Outcome]) -> tuple[Float64, Float64]:
    """Return errors (n, 2), mm, and errors over sigma (n, 2) of outcomes."""
    error = np.array([o.error_mm for o in used]).reshape(-1, 2)
    return error, error / np.array([o.sigma_mm for o in used]).reshape(-1, 2)


def say(number: int, outcomes: list[Outcome]) -> None:
    """Print one scene."""
    used = [o for o in outcomes if o.valid]
    error, pulls = _errors(used)
    why = sorted({o.flags for o in outcomes if not o.valid})[:2]
    print(
        f"{number:4} {outcomes[0].scene:60} {len(used)}/{len(outcomes)} "
        f"rms {_rms(error[:, 0]):.3f} {_rms(error[:, 1]):.3f} e/s {_rms(pulls[:, 0]):.2f} "
        f"{_rms(pulls[:, 1]):.2f} {'FALSE ' if any(o.is_false for o in outcomes) else ''}{why}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=60, help="scenes that are drawn")
    parser.add_argument("--frames", type=int, default=6, help="frames of each")
    parser.add_argument("--seed", type=int, default=1, help="of the first scene; the others follow")
    parser.add_argument("--workers", type=int, default=1, help="processes at once")
    parser.add_argument("--pictures", type=Path, help="draw the worst frames into this folder")
    parser.add_argument("--verbose", action="store_true", help="print every scene")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.draws)
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(options.workers) as pool:
        for done, tracked in enumerate(pool.map(run, seeds, [options.frames] * len(seeds)), 1):
            outcomes += tracked
            if options.verbose and tracked:
                say(done, tracked)
            elif not options.verbose:
                print(f"{done} of {len(seeds)} scenes", end="\r", flush=True)
    told = [o for o in outcomes if o.joint != "plate"]
    table(told, "joint")
    table(told, "view")
    table([o for o in outcomes if o.joint == "plate"], "joint")
    false = [o for o in outcomes if o.is_false]
    print(f"\nfalse valids: {len(false)} of {len(outcomes)} frames")
    ranked = sorted(
        (o for o in outcomes if o.valid),
        key=lambda o: (
            -max(abs(e) / max(s, SIGMA_FLOOR_MM) for e, s in zip(o.error_mm, o.sigma_mm, strict=True))
        ),
    )[:WORST]
    for o in ranked:
        print(
            f"worst: {o.scene} frame {o.frame}: error y {o.error_mm[0]:+.3f} ({o.sigma_mm[0]:.3f}), "
            f"z {o.error_mm[1]:+.3f} ({o.sigma_mm[1]:.3f}) mm {o.flags}"
        )
        if options.pictures:
            draw_picture(o, options.frames, options.pictures)


if __name__ == "__main__":
    main()

"""Scenes at random: joints, views, metals, lasers, sensors and what real pictures show beside the stripe."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from arctrack.simulation.programmed_path import LEAD_IN_MM, ProgrammedPath
from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.setup_keys import Tolerance
from noise_model.surface.joint import Joint
from noise_model.transforms import transform
from tracker.state import Frame, Pose
from validation.anywhere.swept_joint import SweptJoint, departure
from validation.anywhere.swept_light import Ghost, Look, SceneSurroundings, SlitBand
from validation.anywhere.swept_welding import draw_welding
from validation.anywhere.swept_world import SpeckleField, SweptWorld

JOINTS = (
    "v_groove", "closed_v", "u_groove", "half_v", "lap", "corrugation", "butt", "closed_butt", "fillet",
    "plate", "outside_corner",
)  # fmt: skip
ARCS = ("drawn", "on", "welding")
PATHS = ("drawn", "turning", "circle", "corner")
VIEWS = ("ahead", "behind", "beside", "steep")
SIZES = ((320, 240), (480, 360), (640, 480))
STEP_MM = 0.8
"""How far the tool goes from frame to frame."""

EXACT = 1e-5
SEAM_MM = ((-100.0, 0.0, 0.0), (1000.0, 0.0, 0.0))
STATED_AS = {"closed_v": "v_groove", "closed_butt": "butt"}
ON_PLATES = ("v_groove", "butt", "closed_butt", "lap", "fillet", "half_v", "outside_corner")
"""Joints that a setup states where there is a plate."""

CLOSED_GAP_MM = 0.1
"""The gap that is stated for a closed butt, and the widest that there is."""

BLUNT_MM = (0.02, 0.06)
"""By so much its two edges together are blunt."""

FAN_SHARE, HALL_SHARE, GHOST_SHARE, GLINTS_SHARE = 1 / 4, 1 / 3, 1 / 10, 1 / 10
"""So many scenes have a fan that ends in the image, light of the hall, a ghost, glints."""

TURNING_SHARE = 1 / 5
"""Share of the scenes whose seam turns: a circle or the corner of a box."""

CIRCLES_MM, CORNERS_MM = (45.0, 300.0), (4.0, 60.0)
"""Radii of circles and of corners. A sensor that looks 35 mm ahead sees no circle that is much smaller."""

MIN_LIT_MM = 10.0
"""A fan reaches so far to either side: over any joint's own width."""


def _groove(angle: str, angle_deg: float, depth_mm: float, gap_mm: float) -> dict[str, float]:
    return {angle: angle_deg, "depth_mm": depth_mm, "root_gap_mm": gap_mm}


Draw = Callable[[float, float], float]
SIZE_OF: dict[str, Callable[[Draw], dict[str, float]]] = {
    "v_groove": lambda even: _groove("included_angle_deg", even(50, 90), even(2.5, 6), even(0.8, 2)),
    "closed_v": lambda even: _groove("included_angle_deg", even(50, 90), even(2.5, 6), 0.0),
    "u_groove": lambda even: (
        _groove("bevel_angle_deg", even(10, 25), even(4, 7), even(0.8, 2)) | {"root_radius_mm": even(2, 3.5)}
    ),
    "half_v": lambda even: _groove("bevel_angle_deg", even(30, 55), even(2.5, 5), even(0.8, 2)),
    "lap": lambda even: {"thickness_mm": even(0.8, 3)},
    "corrugation": lambda even: (
        {"thickness_mm": even(0.8, 2), "height_mm": even(3, 8)} | {"pitch_mm": 60.0, "width_mm": 30.0}
    ),
    "butt": lambda even: {"gap_mm": even(0.8, 2), "thickness_mm": even(2, 5)},
    "closed_butt": lambda even: {"gap_mm": CLOSED_GAP_MM, "thickness_mm": even(2, 5)},
    "fillet": lambda even: {"included_angle_deg": even(70, 110)},
    "outside_corner": lambda even: {"included_angle_deg": even(70, 120)},
}
"""How a joint's dimensions are drawn, mm and deg."""


@dataclass(frozen=True)
class RandomScene:
    """One draw: what is stated, what is there, and how the tool goes."""

    seed: int
    joint: str
    view: str
    stated: str
    setup: Setup
    fan_half_angle_deg: float | None
    world: SweptJoint
    speckle: SpeckleField
    around: SceneSurroundings
    arc_on: bool
    poses: tuple[Float64, ...]
    path: str = "straight"

    @property
    def name(self) -> str:
        """What is in it, in words that a file's name may hold."""
        around, look, fan_deg = self.around, self.around.look, self.fan_half_angle_deg
        joint = self.joint if self.joint == self.stated else f"{self.joint}-not-{self.stated}"
        words = [
            f"{self.seed} {joint} {self.view} {self.setup.camera.width}px C={self.speckle.contrast:.2f}",
            f"{'arc' if self.arc_on else 'dry'} {self.setup.material.name}",
        ]
        if self.path != "straight":
            words.append(f"{self.path}={1.0 / self.world.bend[6]:.0f}mm")
        if fan_deg is not None:
            stated = "" if self.setup.laser.fan_half_angle_deg else "-unstated"
            words.append(f"fan={fan_deg:.1f}deg{stated}")
        if around.hall_e > 0.0:
            words.append(f"hall={100 * around.hall_e / self.setup.laser.peak_e:.0f}%")
        if look.contrast > 0.0:
            words.append(f"texture={look.contrast:.2f},{look.grain_mm:.1f}mm")
        words += [f"band={b.y_mm:+.2f},{b.width_mm:.2f}mm,{b.share:.1f}" for b in look.bands]
        if around.ghost is not None:
            words.append(f"ghost={around.ghost.strength:.1f},{sum(around.ghost.shift_px):+.0f}px")
        if around.n_glints:
            words.append(f"glints={around.n_glints}")
        if around.welding is not None:
            welding = around.welding
            words.append(f"streaks={welding.n_streaks:.0f} glare={welding.glare:.2f}")
            words.append(f"mirrored={welding.mirrored:.2f}")
        return " ".join(words)


def joint_of(seed: int) -> str:
    """Return the joint that a seed's scene has."""
    return JOINTS[seed % len(JOINTS)]


def draw_scene(seed: int, n_frames: int, arc: str = "drawn", path: str = "drawn") -> RandomScene:
    """Draw a scene; equal seeds give equal scenes.

    `arc` is one of `ARCS`: two in five are on as drawn, all are, or all are and add what welding adds. `path`
    is one of `PATHS`: one in five turns as drawn, or all do, but for seams with ridges.
    """
    draw, more = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 2])
    joint, view = joint_of(seed), VIEWS[(seed // len(JOINTS)) % len(VIEWS)]
    stated = str(draw.choice(ON_PLATES)) if joint == "plate" else joint
    size = {name: float(value) for name, value in SIZE_OF[stated](draw.uniform).items()}
    setup, turned = _draw_sensor(Joint(STATED_AS.get(stated, stated), size, SEAM_MM), view, draw)
    # A closed butt is a plate with a slit in it.
    there = Joint("flat", {}, SEAM_MM) if joint in ("plate", "closed_butt") else setup.joint
    slope = 0.0 if setup.joint.has_ridges else draw.uniform(-0.01, 0.01)
    bow_mm, period_mm = draw.uniform(-1.5, 1.5), draw.uniform(100, 250)
    if joint == "closed_butt" and more.random() < 0.5:
        bow_mm = 0.0
    turning = np.random.default_rng([seed, 5])
    along = _draw_path(setup, path, turning)
    world = SweptJoint.of(
        there, bow_mm, period_mm, slope, (0.0, 0.0, 0.0, 0.0) if along is None else along.arc
    )
    if along is not None:
        setup = replace(setup, joint=along.path.taken_by(setup.joint))
    contrast = 0.0 if draw.random() < 0.3 else draw.uniform(0.05, 0.6)
    speckle = SpeckleField(contrast, draw.uniform(0.5, 1.3))
    arc_on = bool(draw.random() < 0.4) or arc != "drawn"
    poses = _draw_poses(n_frames, world, draw)
    if along is not None:
        poses = _turned_poses(poses, world, along)
    if arc_on:
        setup = _balanced(setup, world, poses[0])
    around = _draw_surroundings(seed, joint, setup, turned, stated == "closed_butt" and not arc_on, more)
    if arc == "welding":
        around = replace(around, welding=draw_welding(np.random.default_rng([seed, 4])))
    fan_deg = _draw_fan(setup, turned, more) if more.random() < FAN_SHARE else None
    if more.random() < 0.5:
        setup = replace(setup, laser=replace(setup.laser, fan_half_angle_deg=fan_deg))
    shape = "straight" if along is None else along.shape
    return RandomScene(
        seed, joint, view, stated, setup, fan_deg,
        world=world, speckle=speckle, around=around, arc_on=arc_on, poses=poses, path=shape,
    )  # fmt: skip


def _draw_sensor(joint: Joint, view: str, draw: np.random.Generator) -> tuple[Setup, bool]:
    """Draw a setup, and whether its camera's rows run along the tool's x instead of its y."""
    width, height = SIZES[draw.integers(len(SIZES))]
    metal = ["mild_steel", "zn_coated"][draw.integers(2)]
    setup = nominal_setup(joint.type, metal, width=width, height=height)
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
    focal_px = far * math.exp(draw.uniform(math.log(6.0), math.log(18.0))) * width / 640.0
    camera = replace(setup.camera, fx=focal_px, fy=focal_px, T_tool_camera=_looking(eye, aim, turned))
    laser = replace(
        setup.laser,
        stripe_sigma_mm=draw.uniform(0.15, 0.45),
        peak_e=math.exp(draw.uniform(math.log(3e3), math.log(14e3))),
    )
    exact = Tolerance(hand_eye_deg=EXACT, hand_eye_mm=EXACT)
    return replace(setup, camera=camera, laser=laser, tolerance=exact, joint=joint), turned


def _draw_poses(n_frames: int, world: SweptJoint, draw: np.random.Generator) -> tuple[Float64, ...]:
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
    return tuple(poses)


class DrawnPath(NamedTuple):
    """A path that turns: its shape, course, the torch's first station on it, mm, and the arc of its world."""

    shape: str
    path: ProgrammedPath
    start_mm: float
    arc: tuple[float, float, float, float]


def _draw_path(setup: Setup, path: str, draw: np.random.Generator) -> DrawnPath | None:
    """Draw a path that turns, None for a straight one."""
    share, shape = draw.random(), str(draw.choice(["circle", "corner"]))
    if setup.joint.has_ridges or (path == "drawn" and share >= TURNING_SHARE):
        return None
    shape = shape if path in ("drawn", "turning") else path
    radius_mm = math.exp(draw.uniform(*np.log(CIRCLES_MM if shape == "circle" else CORNERS_MM)))
    course = ProgrammedPath.of(f"{shape}:{radius_mm}", setup)
    first_mm = LEAD_IN_MM if shape == "corner" else 0.0
    turn = math.pi * (0.5 if shape == "corner" else 1.5)
    # A corner is met by the sheet first, and left by the torch last.
    start_mm = draw.uniform(first_mm - 45.0, first_mm + turn * radius_mm)
    if shape == "circle":
        start_mm = draw.uniform(20.0, 100.0)
    arc = 1.0 / radius_mm, first_mm, first_mm + turn * radius_mm, math.radians(course.roll_deg)
    return DrawnPath(shape, course, start_mm, arc)


def _turned_poses(poses: tuple[Float64, ...], world: SweptJoint, along: DrawnPath) -> tuple[Float64, ...]:
    """Return poses of a straight path on one that turns: the tool looks at its path ahead."""
    turned = []
    for n, T in enumerate(poses):
        straight_mm, station_mm = float(T[0, 3]), along.start_mm + STEP_MM * n
        lift_mm = float(departure(station_mm, world.bend)[2] - departure(straight_mm, world.bend)[2])
        there = along.path.T_base_seam(station_mm)
        there[:3, 3] = transform(there, np.array([0.0, T[1, 3], T[2, 3] + lift_mm]))
        there[:3, :3] = along.path.R_base_tool(station_mm) @ T[:3, :3]
        turned.append(there)
    return tuple(turned)


def _px_per_mm(setup: Setup) -> float:
    """Return the scale where the sheet meets a plate at tool height."""
    camera = setup.camera
    return camera.fx / float(np.linalg.norm(camera.T_tool_camera[:3, 3] - setup.laser.point_mm))


def _draw_fan(setup: Setup, turned: bool, draw: np.random.Generator) -> float:
    """Draw the half angle, deg, of a fan that ends in the image."""
    along_px = setup.camera.height if turned else setup.camera.width
    lit_mm = max(draw.uniform(0.4, 0.9) * 0.5 * along_px / _px_per_mm(setup), MIN_LIT_MM)
    return math.degrees(math.atan(lit_mm / setup.laser.origin_mm[2]))


def _draw_surroundings(
    seed: int, joint: str, setup: Setup, turned: bool, needs_hall: bool, draw: np.random.Generator
) -> SceneSurroundings:
    around, look = SceneSurroundings(), Look()
    if draw.random() < HALL_SHARE or needs_hall:
        around = replace(around, hall_e=draw.uniform(0.005, 0.15) * setup.laser.peak_e)
        grain_mm = math.exp(draw.uniform(math.log(0.2), math.log(3.0)))
        look = Look(draw.uniform(0.0, 0.3), grain_mm, seed)
    if joint == "closed_butt":
        look = replace(look, unlike=draw.uniform(-0.1, 0.1), bands=_draw_bands(draw))
    width_px = 2.355 * setup.laser.stripe_sigma_mm * _px_per_mm(setup)
    if draw.random() < GHOST_SHARE:
        off_px = draw.choice([-1, 1]) * draw.uniform(2, 8) * width_px
        strength = math.exp(draw.uniform(math.log(0.1), math.log(1.5)))
        around = replace(around, ghost=Ghost((off_px, 0.0) if turned else (0.0, off_px), strength))
    if draw.random() < GLINTS_SHARE:
        around = replace(around, n_glints=int(draw.integers(1, 7)), glint_reach_px=3.0 * width_px)
    return replace(around, look=look)


def _draw_bands(draw: np.random.Generator) -> tuple[SlitBand, ...]:
    """Draw a closed butt's slit, with a rim beside it or without, or its rim alone."""
    kind = draw.choice(["slit", "slit and rim", "rim"], p=[0.6, 0.2, 0.2])
    # No edge is quite sharp: plates without a gap show a slit too.
    slit_mm = draw.uniform(0.0, CLOSED_GAP_MM) + draw.uniform(*BLUNT_MM)
    slit = SlitBand(0.0, slit_mm, draw.uniform(0.0, 0.3))
    rim = SlitBand(0.0, draw.uniform(0.03, 0.1), draw.uniform(1.5, 3.0))
    if kind == "slit and rim":
        return slit, rim._replace(y_mm=draw.choice([-1, 1]) * 0.5 * (slit_mm + rim.width_mm))
    return (slit,) if kind == "slit" else (rim,)


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
    of_one = replace(setup, camera=small, arc=replace(setup.arc, radiance_e=1.0))
    light = SweptWorld(of_one, world, SpeckleField(0.0, 1.0), SceneSurroundings()).arc_light(T_base_tool)
    mean, bright = float(light.mean()), float(np.quantile(light, 0.97))
    if mean == 0.0:
        return setup
    share = min(0.12 / mean, 0.8 / bright if bright > 0.0 else math.inf)
    return replace(setup, arc=replace(setup.arc, radiance_e=share * setup.sensor.full_well_e))


def world_of(scene: RandomScene) -> SweptWorld:
    """Return the world that a scene's frames are taken in."""
    true_laser = replace(scene.setup.laser, fan_half_angle_deg=scene.fan_half_angle_deg)
    return SweptWorld(replace(scene.setup, laser=true_laser), scene.world, scene.speckle, scene.around)


def frames_of(scene: RandomScene) -> Iterable[tuple[Frame, Pose, Float64]]:
    """Yield frames, poses and true seam points (3,), mm, tool frame."""
    world = world_of(scene)
    arc = scene.setup.arc.current_a if scene.arc_on else 0.0
    for n, T in enumerate(scene.poses):
        draw = np.random.default_rng([scene.seed, 1, n])
        image = world.frame(T, True, scene.arc_on, draw)
        frame = Frame(n, 0.1 * n, image, scene.setup.camera.exposure_s, arc, True, scene.arc_on)
        yield frame, Pose(T), scene.world.seam_tool_mm(scene.setup, T)

"""What the blind check's recordings state: nominal setups, and how the tool moves over the nominal seam."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from noise_model.arc_source import Arc
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.sensor import Sensor
from noise_model.instrument.spectrum import Filter
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from noise_model.surface.joint import Joint
from noise_model.transforms import moved
from sim_to_real.decision.experiments import Experiment
from validation.second_renderer.world_effect import Generator
from validation.second_renderer.world_light import Studio, TrueWorld
from validation.second_renderer.world_surface import Departure, TrueSurface

JOINTS = ("v_groove", "lap", "corrugation")
WIDE_JOINTS = (*JOINTS, "butt", "fillet", "outside_corner")
METALS = (Material("mild_steel", 0.021, 0.326, 112.0), Material("zn_coated", 0.495, 0.153, 8.331))

WIDTH_PX = 640
CURRENT_A, EXPOSURE_S = 100.0, 0.005
ARC_RADIUS_MM = 3.0

AHEAD = (85.0, 105.0), (0.0, 10.0), (120.0, 140.0)
BESIDE = (40.0, 70.0), (35.0, 55.0), (115.0, 135.0)
BEHIND = (-35.0, -15.0), (0.0, 10.0), (130.0, 145.0)
VIEWS = (AHEAD, BESIDE, BEHIND)
"""From where and up to where a camera may stand: along travel, beside it to either side, and up; mm."""

ARC_MEAN, ARC_PEAK, PEAK_QUANTILE = 0.15, 0.9, 0.98
"""The arc's nominal light over full well: on average, and at most at the brightest pixels but a few."""

PREVIEW = 8
"""The nominal arc is judged on an image so many times smaller."""


@dataclass(frozen=True)
class WorldMotion:
    """The tool over the nominal seam along base's x: even travel, and swings of (amplitude, period_s, phase).

    `speed_mm_s`, `yaw_deg` and `height_mm` (the middle one) stay; `weave` in mm, `rise` in mm, `roll` and
    `pitch` in degrees swing.
    """

    joint: Joint
    speed_mm_s: float
    yaw_deg: float
    height_mm: float
    weave: tuple[float, float, float]
    rise: tuple[float, float, float]
    roll: tuple[float, float, float]
    pitch: tuple[float, float, float]

    def height_at_mm(self, time_s: float) -> float:
        """Return the tool's height over the nominal surface below it, mm."""
        return self.height_mm + _swing(self.rise, time_s)

    def straight(self) -> WorldMotion:
        """Return the same without swings."""
        still = 0.0, 1.0, 0.0
        return replace(self, weave=still, rise=still, roll=still, pitch=still)

    def T_base_tool(self, time_s: float) -> Float64:
        """Return the tool's pose (4, 4), mm; it keeps its distance to a corrugated sheet."""
        x = self.speed_mm_s * time_s
        lift, _ = TrueSurface(self.joint, Departure()).lift_mm(np.array(x))
        angles = [self.yaw_deg, _swing(self.pitch, time_s), _swing(self.roll, time_s)]
        T_base_tool = np.eye(4)
        T_base_tool[:3, :3] = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        T_base_tool[:3, 3] = x, _swing(self.weave, time_s), self.height_at_mm(time_s) + float(lift)
        return T_base_tool


@dataclass(frozen=True)
class ContinuedMotion:
    """A motion that goes on as an experiment says: `motion` until `from_s`, the experiment's from `to_s` on.

    In between the tool takes speed, turn and move of the experiment up smoothly.
    """

    motion: WorldMotion
    experiment: Experiment
    from_s: float
    to_s: float

    def height_at_mm(self, time_s: float) -> float:
        """Return the tool's height over the nominal surface below it, mm; moved up, it is as much higher."""
        unmoved = self.motion.T_base_tool(self._run_time_s(time_s))
        raised_mm = float(self.T_base_tool(time_s)[2, 3] - unmoved[2, 3])
        return self.motion.height_at_mm(self._run_time_s(time_s)) + raised_mm

    def T_base_tool(self, time_s: float) -> Float64:
        """Return the tool's pose (4, 4), mm."""
        s = self._passed(time_s)
        share = s * s * (3.0 - 2.0 * s)
        turn_deg, move_mm = np.array(self.experiment.turn_deg), np.array(self.experiment.move_mm)
        unmoved = self.motion.T_base_tool(self._run_time_s(time_s))
        return moved(unmoved, share * turn_deg, share * move_mm)

    def _run_time_s(self, time_s: float) -> float:
        """Return when the tool would have been as far without the experiment."""
        s, over_s = self._passed(time_s), max(time_s - self.to_s, 0.0)
        # The integral of the share that T_base_tool takes: the speed rises as turn and move do.
        ahead_s = (self.to_s - self.from_s) * (s**3 - 0.5 * s**4) + over_s
        return time_s + (self.experiment.speed - 1.0) * ahead_s

    def _passed(self, time_s: float) -> float:
        return min(max((time_s - self.from_s) / (self.to_s - self.from_s), 0.0), 1.0)


def draw_stated(draw: Generator, joint: str | None, width_px: int = WIDTH_PX) -> tuple[Setup, WorldMotion]:
    """Draw a nominal setup, its `[arc] radiance_e` still 1, and a motion; `joint` is drawn if None.

    Its camera has images so wide; every other one looks from beside the seam's plane, but at laps.

    Raises ValueError for a joint or a width that there is not.
    """
    _check_width(width_px)
    drawn = JOINTS[draw.integers(len(JOINTS))]
    stated_joint = _draw_joint(draw, drawn if joint is None else joint)
    # Steel mirrors a lap's arc beside the image: there is nothing to see there.
    is_steel = bool(draw.random() < 0.5) and stated_joint.type in ("v_groove", "flat")
    camera = _draw_camera(draw, stated_joint.type)
    stated = _nominal(camera.coarser(WIDTH_PX // width_px), METALS[0 if is_steel else 1], stated_joint)
    return stated, _draw_motion(draw, stated_joint)


def draw_wide(draw: Generator, joint: str | None, width_px: int = WIDTH_PX) -> tuple[Setup, WorldMotion]:
    """Draw as `draw_stated`, of more joints, and from wherever a camera is mounted: ahead, beside or behind.

    Raises ValueError for a joint or a width that there is not.
    """
    _check_width(width_px)
    drawn = WIDE_JOINTS[draw.integers(len(WIDE_JOINTS))]
    stated_joint = _draw_wide_joint(draw, drawn if joint is None else joint)
    view = VIEWS[draw.integers(len(VIEWS))]
    low, high = np.array(view).T
    seen_from = np.round(draw.uniform(low, high)) * [1.0, draw.choice([-1.0, 1.0]), 1.0]
    # Steel's narrow lobe mirrors the arc beside most images.
    is_steel = bool(draw.random() < 0.5) and stated_joint.type in ("v_groove", "butt") and view is AHEAD
    camera = _camera(seen_from).coarser(WIDTH_PX // width_px)
    return _nominal(camera, METALS[0 if is_steel else 1], stated_joint), _draw_motion(draw, stated_joint)


def _nominal(camera: Camera, material: Material, joint: Joint) -> Setup:
    return Setup(
        camera=camera,
        sensor=Sensor(bits=8, gain_e_per_dn=80.0, black_level_dn=4.0, read_noise_e=45.0, full_well_e=20400.0),
        filter=Filter(center_nm=690.0, fwhm_nm=10.0, effective_index=1.8),
        laser=Laser(690.0, (1.0, 0.0, 0.0, -35.0), (35.0, 0.0, 140.0), 0.45, 5000.0),
        arc=Arc(ARC_RADIUS_MM, (0.0, 0.0, _arc_height_mm(joint)), 1.0, CURRENT_A, 1.3),
        material=material,
        joint=joint,
    )


def _arc_height_mm(joint: Joint) -> float:
    """Return the arc's height over the seam line: on the sheet that it burns to, above a fillet's root."""
    if joint.type == "fillet":
        return math.ceil(10.0 * ARC_RADIUS_MM / math.sin(math.radians(0.5 * _angle_deg(joint)))) / 10.0
    return joint.dimensions["thickness_mm"] if joint.type in ("lap", "corrugation") else 0.0


def _angle_deg(joint: Joint) -> float:
    return joint.dimensions["included_angle_deg"]


def _check_width(width_px: int) -> None:
    if width_px < 1 or WIDTH_PX % width_px:
        raise ValueError(f"width_px = {width_px}: must divide {WIDTH_PX}")


def _draw_joint(draw: Generator, joint_type: str) -> Joint:
    """Draw a joint's dimensions; those of other types are drawn too, so that a type changes nothing else."""
    dimensions = {
        "flat": {},
        "v_groove": {
            "included_angle_deg": round(draw.uniform(60.0, 80.0)),
            "depth_mm": round(draw.uniform(3.0, 5.0), 1),
            "root_gap_mm": round(draw.uniform(0.5, 1.5), 1),
        },
        "lap": {"thickness_mm": round(draw.uniform(1.5, 2.5), 1)},
        "corrugation": {"thickness_mm": 1.5, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
    }
    return _joint(joint_type, dimensions)


def _draw_wide_joint(draw: Generator, joint_type: str) -> Joint:
    """Draw a joint's dimensions as `_draw_joint`, of all types."""
    dimensions: dict[str, dict[str, float]] = {
        "flat": {},
        "v_groove": {
            "included_angle_deg": round(draw.uniform(50.0, 90.0)),
            "depth_mm": round(draw.uniform(2.5, 6.0), 1),
            "root_gap_mm": round(draw.uniform(0.5, 2.0), 1),
        },
        "lap": {"thickness_mm": round(draw.uniform(1.5, 3.0), 1)},
        "corrugation": {"thickness_mm": 1.5, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
        "butt": {
            "gap_mm": round(draw.uniform(0.4, 1.2), 1),
            "thickness_mm": round(draw.uniform(2.0, 4.0), 1),
        },
        "fillet": {"included_angle_deg": round(draw.uniform(80.0, 100.0))},
        "outside_corner": {"included_angle_deg": round(draw.uniform(85.0, 110.0))},
    }
    return _joint(joint_type, dimensions)


def _joint(joint_type: str, dimensions: Mapping[str, Mapping[str, float]]) -> Joint:
    if joint_type not in dimensions:
        raise ValueError(f"joint {joint_type!r} is not known: there are {', '.join(dimensions)}")
    size = {name: float(value) for name, value in dimensions[joint_type].items()}
    return Joint(joint_type, size, ((-90.0, 0.0, 0.0), (230.0, 0.0, 0.0)))


def _draw_camera(draw: Generator, joint_type: str) -> Camera:
    """Draw the camera's place: ahead, and in every other world 25 to 40 mm beside the seam's plane."""
    beside_mm = round(draw.uniform(25.0, 40.0)) * draw.choice([-1.0, 1.0]) * draw.integers(2)
    ahead = 95.0 - 0.4 * abs(beside_mm), beside_mm, 130.0
    return _camera(np.array((-20.0, 0.0, 135.0) if joint_type == "lap" else ahead))


def _camera(seen_from_mm: Float64) -> Camera:
    return Camera(
        width=WIDTH_PX,
        height=480,
        fx=2190.0,
        fy=2190.0,
        cx=319.5,
        cy=239.5,
        T_tool_camera=_looking(seen_from_mm, np.array([36.0, 0.0, 0.0])),
        focal_length_mm=16.2,
        exposure_s=EXPOSURE_S,
    )


def _draw_motion(draw: Generator, joint: Joint) -> WorldMotion:
    phases = draw.uniform(0.0, 2.0 * math.pi, 4)
    return WorldMotion(
        joint=joint,
        speed_mm_s=draw.uniform(7.0, 9.0),
        yaw_deg=draw.uniform(-3.0, 3.0),
        height_mm=1.3,
        weave=(draw.uniform(1.0, 1.8), draw.uniform(1.4, 2.0), phases[0]),
        rise=(1.2, draw.uniform(2.0, 2.8), phases[1]),
        roll=(draw.uniform(2.5, 4.5), draw.uniform(2.4, 3.3), phases[2]),
        pitch=(draw.uniform(2.5, 4.5), draw.uniform(1.6, 2.3), phases[3]),
    )


def balanced(stated: Setup, motion: WorldMotion, times_s: tuple[float, ...]) -> Setup:
    """Return the setup with the `[arc] radiance_e` that a user's aperture would give it, to three digits.

    `times_s` are those at which the nominal arc is looked at.
    """
    small = stated.camera.coarser(PREVIEW)
    world = TrueWorld(replace(stated, camera=small, arc=replace(stated.arc, radiance_e=1.0)), np.eye(4))
    studio = Studio(world, (0.0, motion.speed_mm_s * max(times_s)))
    sights = [studio.sight(motion.T_base_tool(time_s)) for time_s in times_s]
    light = np.stack([studio.arc_light(s, studio.arc_body(s, (0.0, 0.0, 0.0))) for s in sights])
    share = min(ARC_MEAN / float(light.mean()), ARC_PEAK / float(np.quantile(light, PEAK_QUANTILE)))
    radiance_e = float(f"{share * stated.sensor.full_well_e:.3g}")
    return replace(stated, arc=replace(stated.arc, radiance_e=radiance_e))


def _looking(from_mm: Float64, at_mm: Float64) -> Float64:
    """Return T_tool_camera of a camera whose x axis runs along the tool's -y, as far as it can."""
    forward = (at_mm - from_mm) / np.linalg.norm(at_mm - from_mm)
    right = np.array([0.0, -1.0, 0.0])
    right = right - (right @ forward) * forward
    right /= np.linalg.norm(right)
    T_tool_camera = np.eye(4)
    T_tool_camera[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T_tool_camera[:3, 3] = from_mm
    return T_tool_camera


def _swing(swing: tuple[float, float, float], time_s: float) -> float:
    amplitude, period_s, phase = swing
    return amplitude * math.sin(2.0 * math.pi * time_s / period_s + phase)

"""Recordings from arctrack's own forward model: stripe, arc light, sensor noise; with their truth.

The robot follows a straight nominal seam, weaves, rises and tilts within what the sensor sees. The true seam
leaves its nominal line and bends. True values differ from the nominal ones by about the setup's tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from arctrack.errors import ArctrackError
from arctrack.recording import RecordingWriter, SetupFile, VideoFormat
from arctrack.recording.setup_file import setup_text
from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.effects import Values, apply_setup_effects, checked, pose_time_s
from noise_model.forward import Renderer, draw_frame, predict
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup, require_setup
from noise_model.stripe import check_stripe
from noise_model.surface.joint import (
    BentSeam,
    Joint,
    SeamLine,
    corrugation_height,
    seam_frame,
    seam_height_mm,
    section,
)
from noise_model.transforms import invert, transform
from tracker.state import Frame

MEETS_WITHIN_MM = 100.0
"""Range along the seam, from the laser sheet's foot, in which their crossing is sought."""

MIN_FRAMES = 12
RATES_HZ, SPEEDS_MM_S, WANDERS_MM, TILTS_DEG = (0.01, 1000.0), (0.0, 1000.0), (0.0, 100.0), (0.0, 45.0)
"""Ranges of a plan: times are written to the microsecond, and the tool goes forward."""


@dataclass(frozen=True)
class SimulationPlan:
    """Plan of a simulated recording.

    Parameters
    ----------
    frames : int
        How many frames.
    rate_hz : float
        Frames a second.
    travel_speed_mm_s : float
        The torch's speed along the seam.
    seed : int
        The same seed makes the same recording.
    seam_wander_mm : float
        How far the true seam leaves its nominal line to the side, half of it up and down.
    weave_mm : float
        How far the tool swings to either side.
    height_mm : tuple of float
        The tool's lowest and highest height over the nominal seam.
    tilt_deg : float
        How far the tool tilts.
    pose_rate_hz, pose_jitter_s : float
        Poses a second, and 1 sigma of their times.
    production : bool
        True has laser and arc on in every frame.
    exact : bool
        True keeps the nominal values for the true ones.
    video : bool
        True writes one lossless video instead of PNGs.
    """

    frames: int = 24
    rate_hz: float = 10.0
    travel_speed_mm_s: float = 8.0
    seed: int = 0
    seam_wander_mm: float = 0.5
    weave_mm: float = 1.5
    height_mm: tuple[float, float] = (0.1, 2.5)
    tilt_deg: float = 4.0
    pose_rate_hz: float = 100.0
    pose_jitter_s: float = 0.0011
    production: bool = False
    exact: bool = False
    video: bool = False

    def __post_init__(self) -> None:
        least = 1 if self.production else MIN_FRAMES
        if self.frames < least:
            cure = "" if self.production else "; with --production a single one will do"
            raise ArctrackError(f"--frames {self.frames}: at least {least} are needed{cure}")
        for option, value, (low, high) in (
            ("--fps", self.rate_hz, RATES_HZ),
            ("--speed-mm-s", self.travel_speed_mm_s, SPEEDS_MM_S),
            ("--seam-wander-mm", self.seam_wander_mm, WANDERS_MM),
            ("--weave-mm", self.weave_mm, WANDERS_MM),
            ("--tilt-deg", self.tilt_deg, TILTS_DEG),
        ):
            if not low <= value <= high:
                raise ArctrackError(f"{option} {value:g}: must be from {low:g} to {high:g}")


@dataclass(frozen=True)
class FrameSwitches:
    """Light sources that are on in a frame."""

    laser_on: bool
    arc_on: bool
    current_a: float
    exposure_s: float


def simulate_recording(
    path: Path | str,
    setup: Setup,
    plan: SimulationPlan | None = None,
    on_frame: Callable[[int], None] | None = None,
    hidden_effects: Mapping[str, Values] | None = None,
    stated: SetupFile | None = None,
) -> Path:
    """Write a recording of a nominal setup, with its truth.

    The laser speckles as its optics say (`noise_model.plan.noise.expected_speckle`), unless the setup names
    `laser_speckle`. Of the two parameters `hidden_effects` may give another one; a contrast of 0 is none.

    Parameters
    ----------
    path : Path or str
        The recording's folder, which must not exist yet.
    setup : Setup
        The nominal setup.
    plan : SimulationPlan, optional
        What to simulate.
    on_frame : callable, optional
        Hears the number of frames done.
    hidden_effects : mapping, optional
        Effects that act beside those of the setup, by id; the setup that is written does not name them.
    stated : SetupFile, optional
        The file that the setup was read from: it is written as it stands, and poses are the controller's.

    Returns
    -------
    Path
        The recording's folder.

    Raises
    ------
    ArctrackError
        If the folder exists, or if the setup's seam is not straight.
    """
    plan = plan or SimulationPlan()
    require_setup(setup)
    if len(setup.joint.seam_in_base_mm) != 2:
        raise ArctrackError("[joint] seam_in_base_mm: only a straight seam of two points can be simulated")
    try:
        check_stripe(setup)
        effects = checked({**setup.effects, **(hidden_effects or {})}, setup.joint, setup.missing)
        if "laser_speckle" not in setup.effects:
            given = (hidden_effects or {}).get("laser_speckle", {})
            effects = checked({**effects, "laser_speckle": {**expected_speckle(setup), **given}})
    except ValueError as error:
        raise ArctrackError(str(error)) from error
    draw_setup, draw_motion, draw_order, draw_noise = (
        np.random.default_rng([plan.seed, n]) for n in range(4)
    )
    true_setup = setup if plan.exact else true_values(setup, draw_setup)
    true_setup = replace(true_setup, effects=effects)
    motion = SimulatedMotion(setup, plan, draw_motion, apply_setup_effects(true_setup).joint)
    renderer = Renderer()
    video = VideoFormat(plan.rate_hz) if plan.video else None
    toml = None if stated is None else setup_text(stated.path)
    T_tool_controllertool = np.eye(4)
    if stated is not None and stated.T_tool_controllertool is not None:
        T_tool_controllertool = stated.T_tool_controllertool
    with RecordingWriter(path, setup, video=video, toml=toml) as writer:
        for timestamp_s in _pose_times_s(plan, draw_motion):
            writer.write_pose(timestamp_s, motion.T_base_tool(timestamp_s) @ T_tool_controllertool)
        for n, switches in enumerate(conditions(setup, plan, draw_order)):
            timestamp_s = n / plan.rate_hz
            T_base_tool = motion.T_base_tool(pose_time_s(true_setup, timestamp_s))
            seam = motion.true_seam(*make_scene(apply_setup_effects(true_setup), T_base_tool).stations_mm)
            condition = Condition.of(setup, **vars(switches), timestamp_s=timestamp_s)
            image_dn = draw_frame(
                true_setup,
                T_base_tool,
                condition,
                draw_noise,
                seam=seam,
                renderer=renderer,
                part_seed=plan.seed,
            )
            writer.write_frame(
                Frame(
                    index=n,
                    timestamp_s=timestamp_s,
                    image_dn=image_dn,
                    **vars(switches),
                )
            )
            writer.write_truth(n, motion.seam_point(T_base_tool, seam))
            if on_frame is not None:
                on_frame(n + 1)
    return Path(path)


def balance(setup: Setup) -> Setup:
    """Return the setup with the `[arc] radiance_e` that a user's aperture and filter would give it.

    The arc's light then fills on average `ARC_SHARE` of full well in a frame at its nominal current.
    """
    T_base_tool = SimulatedMotion(
        setup, SimulationPlan(weave_mm=0.0, tilt_deg=0.0), np.random.default_rng(0)
    ).T_base_tool(0.0)
    arc_alone = Condition(laser_level=0.0, arc_level=1.0, exposure_s=setup.camera.exposure_s)
    mean_e = float(predict(setup, T_base_tool, arc_alone).mean_e.mean())
    if not mean_e > 0.0:
        raise ArctrackError("[camera.pose_in_tool]: the camera sees no arc light at all")
    # The mean arc light of a frame over full well that `balance` sets.
    radiance_e = setup.arc.radiance_e * 0.15 * setup.sensor.full_well_e / mean_e
    # Three digits: nobody knows it better, and the file stays readable.
    return replace(setup, arc=replace(setup.arc, radiance_e=float(f"{radiance_e:.3g}")))


def true_values(setup: Setup, draw: np.random.Generator) -> Setup:
    """Return the true setup: every value off the nominal one by a draw from its tolerance."""
    tolerance = setup.tolerance
    T_camera_moved = np.eye(4)
    turn_rad = math.radians(tolerance.hand_eye_deg) * draw.standard_normal(3)
    T_camera_moved[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix()
    T_camera_moved[:3, 3] = tolerance.hand_eye_mm * draw.standard_normal(3)

    def tolerances() -> float:
        # What lies beyond three is no tolerance but a gap.
        return float(np.clip(draw.standard_normal(), -3.0, 3.0))

    def near_one(tolerance_rel: float) -> float:
        return math.exp(tolerance_rel * tolerances())

    camera, sensor = setup.camera, setup.sensor
    return replace(
        setup,
        camera=replace(camera, T_tool_camera=camera.T_tool_camera @ T_camera_moved),
        arc=replace(setup.arc, radiance_e=setup.arc.radiance_e * near_one(tolerance.arc_level_rel)),
        laser=replace(setup.laser, peak_e=setup.laser.peak_e * near_one(tolerance.laser_level_rel)),
        sensor=replace(
            sensor,
            black_level_dn=sensor.black_level_dn + tolerance.black_level_dn * tolerances(),
            read_noise_e=sensor.read_noise_e * near_one(tolerance.read_noise_rel),
        ),
    )


def conditions(setup: Setup, plan: SimulationPlan, rng: np.random.Generator) -> list[FrameSwitches]:
    """Return the light of each frame; the arc is off in all of a setup without one.

    For diagnosis: dark, laser alone, arc alone, both, two currents, two exposures; the frames without arc
    at either end, since an arc is struck once.
    """
    has_arc, exposure_s = setup.arc.shines, setup.camera.exposure_s
    current_a = setup.arc.current_a if has_arc else 0.0
    # The second current and the second exposure, over the nominal ones.
    short_s, high_a = 0.5 * exposure_s, 1.4 * current_a
    both = FrameSwitches(True, has_arc, current_a, exposure_s)
    if plan.production:
        return [both] * plan.frames
    both_high, both_short = replace(both, current_a=high_a), replace(both, exposure_s=short_s)
    arc, arc_high, arc_short = (replace(c, laser_on=False) for c in (both, both_high, both_short))
    laser = FrameSwitches(True, False, 0.0, exposure_s)
    dark = replace(laser, laser_on=False)
    ends = [dark, laser, replace(laser, exposure_s=short_s)]
    middle = [both, both_high, both_short, arc, arc_high, arc_short]
    more = [both, both_high, both, both_short, arc]
    middle += [more[n % len(more)] for n in range(plan.frames - MIN_FRAMES)]
    order = rng.permutation(len(middle))
    return [*ends, *(middle[n] for n in order), *reversed(ends)]


class SimulatedMotion:
    """Tool pose and true seam over time; phases are drawn once.

    The tool follows the setup's joint, the true seam runs along `true_joint`, by default the same.
    """

    def __init__(
        self,
        setup: Setup,
        plan: SimulationPlan,
        draw: np.random.Generator,
        true_joint: Joint | None = None,
    ) -> None:
        self._setup, self._plan = setup, plan
        start_mm = np.asarray((true_joint or setup.joint).seam_in_base_mm[0])
        self._T_base_true = seam_frame(true_joint or setup.joint, start_mm)
        self._phases = draw.uniform(0.0, 2.0 * np.pi, 6)
        self._corrugation = section(setup.joint).corrugation
        self._T_base_joint = seam_frame(setup.joint, np.asarray(setup.joint.seam_in_base_mm[0]))
        ends_mm = transform(invert(self._T_base_joint), np.asarray(setup.joint.seam_in_base_mm))[:, 0]
        # The path starts where base's x is 0, if the seam runs there.
        self._start_mm = 0.0 if ends_mm[0] <= 0.0 <= ends_mm[1] else float(ends_mm[0])

    def T_base_tool(self, timestamp_s: float) -> Float64:
        """Return the tool's pose, (4, 4) mm."""
        plan = self._plan
        x_mm = self._start_mm + plan.travel_speed_mm_s * timestamp_s
        low_mm, high_mm = plan.height_mm
        height_mm = 0.5 * (low_mm + high_mm)
        height_mm += 0.5 * (high_mm - low_mm) * self._wave(timestamp_s / 2.4, 1)
        # The torch keeps its distance to a corrugated sheet.
        height_mm += float(corrugation_height(np.array(x_mm), self._corrugation))
        tilts_deg = [
            plan.tilt_deg * self._wave(timestamp_s / period_s, 2 + n) for n, period_s in enumerate((2.9, 1.9))
        ]
        T_joint_tool = np.eye(4)
        T_joint_tool[:3, :3] = Rotation.from_euler("xy", tilts_deg, degrees=True).as_matrix()
        lateral_mm = plan.weave_mm * self._wave(timestamp_s / 1.7, 0)
        T_joint_tool[:3, 3] = x_mm, lateral_mm, height_mm
        return self._T_base_joint @ T_joint_tool

    def true_seam(self, first_mm: float, last_mm: float, torch_mm: float) -> BentSeam:
        """Return the true seam from one station to another, the arc where it is at the torch's."""
        return BentSeam.along(self._line, (first_mm, last_mm), torch_mm, self._setup.joint.has_ridges)

    def seam_point(self, T_base_tool: Float64, seam: BentSeam) -> Float64:
        """Return the point (3,) where the true seam meets the laser plane, tool frame, mm."""
        station_mm, _ = self._met(T_base_tool, self._line)
        drawn = seam.lines[int(seam.stretch_at(np.array(station_mm)))]
        return self._met(T_base_tool, lambda station_mm: drawn)[1]

    def _met(self, T_base_tool: Float64, line_at: Callable[[float], SeamLine]) -> tuple[float, Float64]:
        """Return the station at which a seam meets the laser plane, and where (3,), tool frame, mm."""
        T_tool_joint = invert(T_base_tool) @ self._T_base_true
        plane = self._setup.laser.plane

        def point_tool(station_mm: float) -> Float64:
            height_mm = seam_height_mm(self._setup.joint)
            height_mm += float(corrugation_height(np.array(station_mm), self._corrugation))
            point_joint = transform(line_at(station_mm).frame(), np.array([station_mm, 0.0, height_mm]))
            return transform(T_tool_joint, point_joint)

        def distance_mm(station_mm: float) -> float:
            return float(self._setup.laser.off_mm(point_tool(station_mm)))

        foot_mm = transform(
            invert(T_tool_joint), np.array([-plane[3] / plane[0] if plane[0] else math.nan, 0.0, 0.0])
        )[0]
        ends_mm = foot_mm - MEETS_WITHIN_MM, foot_mm + MEETS_WITHIN_MM
        # A sheet along the seam has no foot: NaN.
        if not distance_mm(ends_mm[0]) * distance_mm(ends_mm[1]) <= 0.0:
            raise ArctrackError(
                f"[laser] plane_in_tool: the sheet does not meet the seam within {MEETS_WITHIN_MM:g} mm of "
                "where it meets the tool's axis of travel; it hardly leans across the seam"
            )
        station_mm = float(brentq(distance_mm, *ends_mm, xtol=1e-9))
        return station_mm, point_tool(station_mm)

    def _line(self, station_mm: float) -> SeamLine:
        wander = np.array([self._plan.seam_wander_mm, 0.5 * self._plan.seam_wander_mm])
        # Wavelengths sideways and in height: plates are straight, cut edges less so.
        wave_number = 2.0 * np.pi / np.array((100.0, 600.0))
        phase = wave_number * station_mm + self._phases[4:]
        place = wander * np.sin(phase)
        slope = wander * wave_number * np.cos(phase)
        return SeamLine(station_mm, float(place[0]), float(place[1]), float(slope[0]), float(slope[1]))

    def _wave(self, turns: float, phase: int) -> float:
        return math.sin(2.0 * math.pi * turns + float(self._phases[phase]))


def _pose_times_s(plan: SimulationPlan, draw: np.random.Generator) -> list[float]:
    """Return the controller's times from before the first frame to after the last, jittered, rising."""
    period_s = 1.0 / plan.pose_rate_hz
    last_s = (plan.frames - 1) / plan.rate_hz
    regular_s = np.arange(-0.4, last_s + 0.5, period_s)
    limit_s = 0.45 * period_s
    jitter_s = np.clip(plan.pose_jitter_s * draw.standard_normal(len(regular_s)), -limit_s, limit_s)
    return [float(t) for t in np.round(regular_s + jitter_s, 6)]

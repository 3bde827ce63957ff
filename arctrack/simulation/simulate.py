"""Recordings from arctrack's own forward model: stripe, arc light, sensor noise; with their truth.

The robot follows a nominal seam, straight or one that turns, weaves, rises and tilts within what the sensor
sees. The true seam leaves its nominal line and bends. True values differ from the nominal ones by about the
setup's tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.recording import RecordingWriter, SetupFile, VideoFormat
from arctrack.recording.setup_file import setup_text
from arctrack.simulation.programmed_path import ProgrammedPath
from arctrack.simulation.simulated_motion import MIN_FRAMES, TurningMotion
from arctrack.simulation.simulated_motion import SimulatedMotion as SimulatedMotion
from arctrack.simulation.simulated_motion import SimulationPlan as SimulationPlan
from noise_model.condition import Condition
from noise_model.drawn_profile import draw_profile
from noise_model.effects import Values, apply_setup_effects, checked, pose_time_s
from noise_model.forward import Renderer, draw_frame, predict
from noise_model.plan.noise import expected_speckle
from noise_model.setup import Setup, require_setup
from noise_model.stripe import check_stripe
from tracker.state import Frame


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
        If the folder exists, or if neither the setup's seam is straight nor the plan names a path.
    """
    plan = plan or SimulationPlan()
    require_setup(setup)
    setup, stated, course = _with_path(setup, plan, stated)
    if setup.profiler is not None and hidden_effects:
        raise ArctrackError('[camera] kind = "profile": effects act on images alone; leave --effect out')
    try:
        check_stripe(setup)
        effects = checked({**setup.effects, **(hidden_effects or {})}, setup.joint, setup.missing)
        if "laser_speckle" not in setup.effects and setup.profiler is None:
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
    if course is not None:
        if "surface_tilt" in effects:
            raise ArctrackError(
                f"--path {plan.path}: a plate that tilts (surface_tilt) needs a straight seam"
            )
        motion = TurningMotion(setup, plan, np.random.default_rng([plan.seed, 1]), course)
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
            seen = motion.seen_from(true_setup, T_base_tool)
            condition = Condition.of(setup, **vars(switches), timestamp_s=timestamp_s)
            if setup.profiler is None:
                image_dn = draw_frame(
                    seen.setup,
                    T_base_tool,
                    condition,
                    draw_noise,
                    seam=seen.seam,
                    renderer=renderer,
                    part_seed=plan.seed,
                )
            else:
                image_dn = draw_profile(seen.setup, motion.scene_at(seen, T_base_tool), draw_noise)
            writer.write_frame(Frame(index=n, timestamp_s=timestamp_s, image_dn=image_dn, **vars(switches)))
            writer.write_truth(n, seen.point_tool)
            if on_frame is not None:
                on_frame(n + 1)
    return Path(path)


def _with_path(
    setup: Setup, plan: SimulationPlan, stated: SetupFile | None
) -> tuple[Setup, SetupFile | None, ProgrammedPath | None]:
    """Return a setup with the seam that a plan names, its file if it still fits, and the path."""
    if plan.path is not None:
        course = ProgrammedPath.of(plan.path, setup)
        return replace(setup, joint=course.taken_by(setup.joint)), None, course
    if len(setup.joint.seam_in_base_mm) != 2:
        raise ArctrackError(
            "[joint] seam_in_base_mm: a straight seam of two points is simulated, or one that --path names"
        )
    return setup, stated, None


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
    """Return the true setup: every value off the nominal one by a draw from its tolerance.

    Lens, camera pose and sheet are off together where a calibration says how.
    """
    tolerance, covariance = setup.tolerance, setup.calibration_errors
    # One draw for each value, so that an exact one leaves the others' as they are.
    sizes = draw.standard_normal(len(covariance.names))[: len(covariance.modes)]
    setup = setup.with_errors(covariance.errors(sizes))

    def tolerances() -> float:
        # What lies beyond three is no tolerance but a gap.
        return float(np.clip(draw.standard_normal(), -3.0, 3.0))

    def near_one(tolerance_rel: float) -> float:
        return math.exp(tolerance_rel * tolerances())

    sensor = setup.sensor
    return replace(
        setup,
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


def _pose_times_s(plan: SimulationPlan, draw: np.random.Generator) -> list[float]:
    """Return the controller's times from before the first frame to after the last, jittered, rising."""
    period_s = 1.0 / plan.pose_rate_hz
    last_s = (plan.frames - 1) / plan.rate_hz
    regular_s = np.arange(-0.4, last_s + 0.5, period_s)
    limit_s = 0.45 * period_s
    jitter_s = np.clip(plan.pose_jitter_s * draw.standard_normal(len(regular_s)), -limit_s, limit_s)
    return [float(t) for t in np.round(regular_s + jitter_s, 6)]

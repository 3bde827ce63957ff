"""Scenarios of the blind check: a nominal setup, what is really there, a motion, and hidden effects.

`draw` makes one up, `make` renders it. A scenario's *world* (joint, metal, camera's true pose, seam, motion)
comes from its own seed, so that recordings with different effects can share one and its rendered layers.
`followed_by` lets a scenario go on with an experiment that its diagnosis asked for.
Tiers: `A` one effect in the catalogue's form, `C` one in another form, `D` two effects, `E` none, `F` one in
a plain run: straight, and all frames taken alike; in more joints and views `G` one in its further form, `H`
three effects, `I` none, with a seam and values that are hard. Every value that `[tolerance]` names is off by
a draw from it in all of them, in `I` from its tails.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, moved, transform
from sim_to_real.decision.experiments import N_MORE, Experiment
from tracker.state import Frame
from validation.second_renderer.world import (
    FORMS,
    FURTHER,
    apply_moment_effects,
    apply_world_effects,
    expected_charge,
    form_of,
    read_out,
)
from validation.second_renderer.world_effect import CATALOGUE, Generator, HiddenEffect, Moment, signed
from validation.second_renderer.world_light import Studio, TrueWorld
from validation.second_renderer.world_stated import (
    CURRENT_A,
    EXPOSURE_S,
    WIDTH_PX,
    ContinuedMotion,
    WorldMotion,
    balanced,
    draw_stated,
    draw_wide,
)
from validation.second_renderer.world_surface import Departure, TrueSurface

TIERS = {"A": 1, "C": 1, "D": 2, "E": 0, "F": 1, "G": 1, "H": 3, "I": 0}
"""How many effects a tier hides."""

WIDE_TIERS = "GHI"
"""The tiers of more joints and views (`world_stated.draw_wide`)."""

WIDE_STREAM = 6
"""The stream of their worlds' draws; that of others is 0."""

UNBOUNCED = ("flat", "butt", "outside_corner")
"""Joints without faces that light each other visibly."""

RATE_HZ, N_FRAMES = 10.0, 24
LOOKED_AT_S = (0.3, 1.2, 2.0)
"""When the nominal arc's light is balanced."""

POSE_PERIOD_S, POSE_JITTER_S, POSE_LEAD_S, POSE_TAIL_S = 0.01, 0.0011, 0.4, 0.5
HIGH_A, SHORT_S = 140.0, 0.0025

MOVE_S = 0.6
PAUSE_S = POSE_TAIL_S + MOVE_S + POSE_LEAD_S
"""Between run and experiment the tool goes on as before, moves over, and goes on: no late clock sees that."""

WITHIN = 3.0
"""So many of its tolerances a value may be off without being a gap."""

TAIL_FROM = 1.5
"""In tier I every value is off by so many of its tolerances or more."""

FULL_STRIPE_E = 30_000.0
"""The stripe's nominal peak where blooming is hidden: without saturation there is none."""


Tolerances = Callable[[Generator, int], Float64]
"""Draws by how many of its tolerances each of so many values is off (n,)."""


@dataclass(frozen=True)
class StatedSwitches:
    """What a frame's line in frames.csv says."""

    laser_on: bool
    arc_on: bool
    current_a: float
    exposure_s: float


@dataclass(frozen=True, eq=False)
class Scenario:
    """All that a recording is made from.

    `stated` is the nominal setup, the only one that a diagnosis may know; `world` what is really there before
    the hidden `effects`. Of `switches` the last `n_more` are of an experiment after the run, and a pause.
    """

    seed: int
    tier: str
    stated: Setup
    world: TrueWorld
    motion: WorldMotion | ContinuedMotion
    switches: tuple[StatedSwitches, ...]
    effects: tuple[HiddenEffect, ...]
    n_more: int = 0

    @property
    def n_run(self) -> int:
        """How many frames the run itself has."""
        return len(self.switches) - self.n_more

    @property
    def duration_s(self) -> float:
        """The time from the run's first frame to its last."""
        return (self.n_run - 1) / RATE_HZ

    def time_s(self, index: int) -> float:
        """Return when a frame is taken."""
        return index / RATE_HZ + (PAUSE_S if index >= self.n_run else 0.0)

    @property
    def labels(self) -> dict[str, Any]:
        """What stays sealed: effects, forms, parameters and true values, as JSON has them."""
        true, departure = self.world.setup, self.world.departure
        return {
            "tier": self.tier,
            "seed": self.seed,
            "effects": [hidden.id for hidden in self.effects],
            "form": [hidden.form for hidden in self.effects],
            "parameters": [dict(hidden.values) for hidden in self.effects],
            "true_values": {
                "T_tool_camera": true.camera.T_tool_camera.tolist(),
                "arc_radiance_e": true.arc.radiance_e,
                "laser_peak_e": true.laser.peak_e,
                "black_level_dn": true.sensor.black_level_dn,
                "read_noise_e": true.sensor.read_noise_e,
                "departure": vars(departure).copy(),
            },
        }


@dataclass(frozen=True, eq=False)
class MadeRecording:
    """A made recording: all that `arctrack.recording.RecordingWriter` takes, and the sealed labels.

    `setup` is the nominal one (`RecordingWriter(path, setup)`); `frames` go to `write_frame` as they are,
    each of `poses`, (timestamp_s, T_base_tool), to `write_pose`, and `truth` (n_frames, 3), the true seam
    point in the laser plane, mm, tool frame, row by row to `write_truth(frame.index, row)`.
    """

    setup: Setup
    frames: tuple[Frame, ...]
    poses: tuple[tuple[float, Float64], ...]
    truth: Float64
    labels: dict[str, Any]


def draw(
    seed: int,
    tier: str,
    *,
    world_seed: int | None = None,
    joint: str | None = None,
    effects: Sequence[str] | None = None,
    form: str | None = None,
    strength: float | None = None,
    is_dry: bool = False,
    width_px: int = WIDTH_PX,
) -> Scenario:
    """Draw a scenario; what is given is not drawn.

    `world_seed` is the seed itself without it. `effects` are ids, as many as the tier has; `form` names one
    effect's form; `strength` is 0 for about three times what noise and tolerance hide, 1 for clearly visible.
    `is_dry` leaves the arc out of tier F's plain run. Images are `width_px` wide. Equal arguments give equal
    scenarios.

    Raises ValueError for an unknown tier, joint, effect or form, and for effects that the tier or the joint
    cannot have. Raises ImportError where Mitsuba cannot start: the nominal arc is balanced with it.
    """
    if tier not in TIERS:
        raise ValueError(f"tier {tier!r} is not known: there are {', '.join(TIERS)}")
    of_world = np.random.default_rng(
        [seed if world_seed is None else world_seed, WIDE_STREAM if tier in WIDE_TIERS else 0]
    )
    of_effects, of_values, of_order = (np.random.default_rng([seed, n]) for n in (1, 2, 3))
    stated, motion = (draw_wide if tier in WIDE_TIERS else draw_stated)(of_world, joint, width_px)
    stated = balanced(stated, motion, LOOKED_AT_S)
    departure = _draw_hard_seam(of_world) if tier == "I" else _draw_seam(of_world)
    tolerances = _in_tails if tier == "I" else _within_tolerance
    T_tool_camera = _draw_camera(of_world, stated, tolerances)
    hidden = _draw_effects(of_effects, tier, stated, effects, form, strength)
    if any(effect.id == "blooming" for effect in hidden):
        stated = replace(stated, laser=replace(stated.laser, peak_e=FULL_STRIPE_E))
    true = _draw_true(of_values, stated, T_tool_camera, tolerances)
    world = TrueWorld(true, np.eye(4), departure)
    if tier == "F":
        return Scenario(seed, tier, stated, world, motion.straight(), _plain_switches(is_dry), hidden)
    return Scenario(seed, tier, stated, world, motion, _draw_switches(of_order), hidden)


def followed_by(scenario: Scenario, experiment: Experiment) -> Scenario:
    """Return a scenario whose run is followed by an experiment; the run stays as it is, bit for bit.

    The motion goes on over the same seam, effects that depend on time or on the frame's index go on as well.
    """
    assert isinstance(scenario.motion, WorldMotion), "one experiment follows a run"
    stated, from_s = scenario.stated, scenario.duration_s + POSE_TAIL_S
    more = StatedSwitches(
        experiment.laser_on,
        experiment.arc_on,
        experiment.current * stated.arc.current_a if experiment.arc_on else 0.0,
        experiment.exposure * stated.camera.exposure_s,
    )
    return replace(
        scenario,
        motion=ContinuedMotion(scenario.motion, experiment, from_s, from_s + MOVE_S),
        switches=(*scenario.switches, *N_MORE * [more]),
        n_more=N_MORE,
    )


def make(scenario: Scenario, cache_dir: Path | None = None, first: int = 0) -> MadeRecording:
    """Render a scenario from a frame's index on; layers of the arc's light are kept in `cache_dir`.

    Equal scenarios give equal recordings, with and without what is kept. Raises ImportError where Mitsuba
    cannot start.
    """
    effects = scenario.effects
    world = apply_world_effects(scenario.world, effects)
    frames, truth = [], []
    for part, stations in _parts(scenario):
        indices = part[max(first - part.start, 0) :]
        if not indices:
            continue
        studio = Studio(world, stations, cache_dir)
        for index in indices:
            moment = apply_moment_effects(stated_moment(scenario, index), effects)
            T_base_tool = scenario.motion.T_base_tool(moment.pose_time_s)
            noise = np.random.default_rng([scenario.seed, 4, index])
            charge = expected_charge(studio, effects, moment, T_base_tool, noise)
            image_dn = read_out(world, effects, moment, charge, noise)
            switches = vars(scenario.switches[index])
            frames.append(Frame(index, scenario.time_s(index), image_dn, **switches))
            truth.append(true_seam_tool_mm(world, T_base_tool))
    return MadeRecording(scenario.stated, tuple(frames), _poses(scenario), np.array(truth), scenario.labels)


def stated_moment(scenario: Scenario, index: int) -> Moment:
    """Return a frame's moment before any effect."""
    switches, arc = scenario.switches[index], scenario.world.setup.arc
    time_s = scenario.time_s(index)
    output = (switches.current_a / arc.current_a) ** arc.current_exponent if switches.arc_on else 0.0
    return Moment(
        index=index,
        time_s=time_s,
        duration_s=scenario.duration_s,
        pose_time_s=time_s,
        laser_level=float(switches.laser_on),
        arc_level=output,
        exposure_s=switches.exposure_s,
        tool_height_mm=scenario.motion.height_at_mm(time_s),
    )


def true_seam_tool_mm(world: TrueWorld, T_base_tool: Float64) -> Float64:
    """Return the true seam point (3,) in the laser plane, mm, tool frame."""
    surface = TrueSurface(world.setup.joint, world.departure)
    T_tool_joint = invert(T_base_tool) @ world.T_base_joint

    def over_plane(x_mm: float) -> float:
        return float(world.setup.laser.off_mm(transform(T_tool_joint, surface.seam_point(x_mm))))

    start = float(transform(invert(T_tool_joint), world.setup.laser.origin_mm)[0])
    x_mm = float(brentq(over_plane, start - 80.0, start + 80.0, xtol=1e-9))
    return transform(T_tool_joint, surface.seam_point(x_mm))


def _parts(scenario: Scenario) -> Iterator[tuple[range, tuple[float, float]]]:
    """Yield indices of run and experiment, and the tool's first and last station, mm.

    The mesh that the run is rendered on reaches as far as its own stations say, whatever follows.
    """
    for part in (range(scenario.n_run), range(scenario.n_run, len(scenario.switches))):
        if part:
            first_s, last_s = scenario.time_s(part[0]), scenario.time_s(part[-1])
            motion = scenario.motion
            yield part, (float(motion.T_base_tool(first_s)[0, 3]), float(motion.T_base_tool(last_s)[0, 3]))


def _draw_seam(draw: Generator) -> Departure:
    return Departure(draw.uniform(-1.0, 1.0), draw.uniform(100.0, 200.0), draw.uniform(-0.01, 0.01))


def _draw_hard_seam(draw: Generator) -> Departure:
    """Draw a seam that sways and slopes as much as it may, or two thirds of that."""
    y_amp, slope = signed(draw, draw.uniform(0.8, 1.2)), signed(draw, draw.uniform(0.013, 0.02))
    return Departure(y_amp, draw.uniform(100.0, 200.0), slope)


def _draw_camera(draw: Generator, stated: Setup, tolerances: Tolerances) -> Float64:
    tolerance = stated.tolerance
    turn, move = tolerance.hand_eye_deg * tolerances(draw, 3), tolerance.hand_eye_mm * tolerances(draw, 3)
    return moved(stated.camera.T_tool_camera, turn, move)


def _within_tolerance(draw: Generator, count: int) -> Float64:
    """Draw so many normal numbers; what lies beyond `WITHIN` is a gap, and stays on it."""
    return np.clip(draw.standard_normal(count), -WITHIN, WITHIN)


def _in_tails(draw: Generator, count: int) -> Float64:
    """Draw so many normal numbers of a size from `TAIL_FROM` to `WITHIN`."""
    sizes = norm.ppf(draw.uniform(norm.cdf(TAIL_FROM), norm.cdf(WITHIN), count))
    return np.asarray(sizes * draw.choice([-1.0, 1.0], count))


def _draw_true(draw: Generator, stated: Setup, T_tool_camera: Float64, tolerances: Tolerances) -> Setup:
    tolerance, sensor = stated.tolerance, stated.sensor
    arc, laser, read, black = tolerances(draw, 4)
    return replace(
        stated,
        camera=replace(stated.camera, T_tool_camera=T_tool_camera),
        arc=replace(stated.arc, radiance_e=stated.arc.radiance_e * math.exp(tolerance.arc_level_rel * arc)),
        laser=replace(stated.laser, peak_e=stated.laser.peak_e * math.exp(tolerance.laser_level_rel * laser)),
        sensor=replace(
            sensor,
            black_level_dn=sensor.black_level_dn + tolerance.black_level_dn * float(black),
            read_noise_e=sensor.read_noise_e * math.exp(tolerance.read_noise_rel * read),
        ),
    )


def _draw_effects(
    draw: Generator,
    tier: str,
    stated: Setup,
    effects: Sequence[str] | None,
    form: str | None,
    strength: float | None,
) -> tuple[HiddenEffect, ...]:
    possible = [
        name for name, forms in FORMS.items() if is_possible(name, stated) and (tier != "C" or len(forms) > 1)
    ]
    drawn = [possible[n] for n in draw.permutation(len(possible))[: TIERS[tier]]]
    chosen = drawn if effects is None else list(effects)
    if len(chosen) != TIERS[tier]:
        raise ValueError(f"tier {tier} hides {TIERS[tier]} effects, not {len(chosen)}")
    hidden = []
    for name in chosen:
        if name not in possible:
            raise ValueError(f"{name} cannot be hidden in tier {tier} on a {stated.joint.type}")
        others = [other for other in FORMS[name] if other != CATALOGUE]
        drawn_form = FURTHER[name].name if tier == "G" else CATALOGUE
        if tier == "C":
            drawn_form = others[draw.integers(len(others))]
        chosen_form = form_of(HiddenEffect(name, drawn_form if form is None else form))
        drawn_strength = float(draw.random())
        values = chosen_form.draw(draw, drawn_strength if strength is None else strength, stated)
        hidden.append(HiddenEffect(name, chosen_form.name, values))
    return tuple(hidden)


def is_possible(effect: str, stated: Setup) -> bool:
    """Return True for an effect that can be seen: light bounces between bright faces that face each other."""
    if effect != "interreflection":
        return True
    return stated.joint.type not in UNBOUNCED and stated.material.kappa_diff > stated.material.kappa_spec


def _draw_switches(draw: Generator) -> tuple[StatedSwitches, ...]:
    """Return what is on in each frame: dark and laser alone at either end, the arc in between."""
    laser = StatedSwitches(True, False, 0.0, EXPOSURE_S)
    ends = [replace(laser, laser_on=False), laser, replace(laser, exposure_s=SHORT_S)]
    both = StatedSwitches(True, True, CURRENT_A, EXPOSURE_S)
    alone = replace(both, laser_on=False)
    middle = 6 * [both] + 3 * [replace(both, current_a=HIGH_A)] + 3 * [replace(both, exposure_s=SHORT_S)]
    middle += 3 * [alone] + 2 * [replace(alone, current_a=HIGH_A)] + [replace(alone, exposure_s=SHORT_S)]
    return (*ends, *(middle[n] for n in draw.permutation(len(middle))), *reversed(ends))


def _plain_switches(is_dry: bool) -> tuple[StatedSwitches, ...]:
    """Return frames with the laser, and the arc unless the run is a dry one, all alike."""
    return N_FRAMES * (StatedSwitches(True, not is_dry, 0.0 if is_dry else CURRENT_A, EXPOSURE_S),)


def _poses(scenario: Scenario) -> tuple[tuple[float, Float64], ...]:
    """Return what the controller stamps, jittered, from before the first frame to after the last."""
    last_s = scenario.time_s(len(scenario.switches) - 1)
    regular_s = np.arange(-POSE_LEAD_S, last_s + POSE_TAIL_S, POSE_PERIOD_S)
    jitter_s = POSE_JITTER_S * np.random.default_rng([scenario.seed, 5]).standard_normal(len(regular_s))
    limit_s = 0.4 * POSE_PERIOD_S
    times_s = np.round(regular_s + np.clip(jitter_s, -limit_s, limit_s), 6)
    return tuple((float(t), scenario.motion.T_base_tool(float(t))) for t in times_s)

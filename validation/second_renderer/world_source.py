"""Hidden effects of source and illumination: the arc, what it emits, and the laser."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    CATALOGUE,
    EffectForm,
    Generator,
    Moment,
    Values,
    WorldFrameLight,
    direction,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_light import TrueWorld

EDGE_NM, EDGE_OD = (680.0, 685.0, 690.0, 696.0, 697.0, 710.0), (0.9, 0.05, 0.011, 0.342, 1.008, 9.6)
"""Optical density of a real 690/10 nm filter at normal incidence: DIAGNOSIS.md, continued."""

ARGON_NM = 696.54


def filter_angle_shift(frame: WorldFrameLight, share: float = 1.0) -> Float64:
    """Return lambda_0 / lambda_theta (H, W) of the stated filter, `share` of the shift."""
    index = frame.studio.world.setup.stated_filter.effective_index
    return np.asarray(1.0 / np.sqrt(1.0 - share * (np.sin(frame.sight.theta) / index) ** 2))


def edge_transmission(wavelength_nm: Float64) -> Float64:
    """Return the real filter's transmission at normal incidence."""
    return np.asarray(10.0 ** -np.interp(wavelength_nm, EDGE_NM, EDGE_OD))


def _moved_arc(world: TrueWorld, x: float, y: float, z: float) -> TrueWorld:
    arc = world.setup.arc
    cx, cy, cz = arc.center_in_tool_mm
    moved = replace(arc, center_in_tool_mm=(cx + x, cy + y, cz + z))
    return replace(world, setup=replace(world.setup, arc=moved))


def _draw_arc_length(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"height_mm": magnitude(strength, 0.15, 2.0)}


def _arc_length(world: TrueWorld, p: Values) -> TrueWorld:
    return _moved_arc(world, 0.0, 0.0, p["height_mm"])


def _draw_arc_rides(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.1, 1.0)}


def _arc_rides(moment: Moment, p: Values) -> Moment:
    x, y, z = moment.arc_shift_mm
    return replace(moment, arc_shift_mm=(x, y, z + p["share"] * max(moment.tool_height_mm, 0.0)))


def _draw_deflection(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    x, y = direction(draw, magnitude(strength, 0.25, 2.5))
    return {"x_mm": x, "y_mm": y}


def _arc_deflection(world: TrueWorld, p: Values) -> TrueWorld:
    return _moved_arc(world, p["x_mm"], p["y_mm"], 0.0)


def _growing_deflection(moment: Moment, p: Values) -> Moment:
    x, y, z = moment.arc_shift_mm
    grown = 2.0 * moment.time_s / moment.duration_s
    return replace(moment, arc_shift_mm=(x + grown * p["x_mm"], y + grown * p["y_mm"], z))


def _draw_radius(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"radius_ratio": math.exp(signed(draw, magnitude(strength, 0.15, 0.5)))}


def scale_arc_radius(world: TrueWorld, p: Values) -> TrueWorld:
    """Return a world whose arc has another radius."""
    arc = world.setup.arc
    wider = replace(arc, radius_mm=arc.radius_mm * p["radius_ratio"])
    return replace(world, setup=replace(world.setup, arc=wider))


def _draw_flicker(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"sigma_rel": magnitude(strength, 0.015, 0.3), "seed": drawn_seed(draw)}


def _flicker(moment: Moment, p: Values) -> Moment:
    draw = np.random.default_rng([int(p["seed"]), moment.index])
    factor = math.exp(p["sigma_rel"] * draw.standard_normal())
    return replace(moment, arc_level=moment.arc_level * factor)


def _draw_wave(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    amplitude, hz = magnitude(strength, 0.025, 0.4), draw.uniform(1.0, 60.0)
    return {"amplitude": amplitude, "frequency_hz": hz, "phase_rad": draw.uniform(0.0, 2.0 * math.pi)}


def _sine_flicker(moment: Moment, p: Values) -> Moment:
    wave = math.sin(2.0 * math.pi * p["frequency_hz"] * moment.time_s + p["phase_rad"])
    return replace(moment, arc_level=moment.arc_level * (1.0 + p["amplitude"] * wave))


def _pulse_flicker(moment: Moment, p: Values) -> Moment:
    # Over the exposure a pulse train of half duty is up for part of the time.
    times = moment.time_s + moment.exposure_s * (np.arange(50) / 49.0 - 0.5)
    up = np.mean(np.mod(p["frequency_hz"] * times + p["phase_rad"] / (2.0 * math.pi), 1.0) < 0.5)
    return replace(moment, arc_level=moment.arc_level * (1.0 + p["amplitude"] * (2.0 * float(up) - 1.0)))


def _walking_flicker(moment: Moment, p: Values) -> Moment:
    steps = np.random.default_rng(int(p["seed"])).standard_normal(moment.index + 1)
    return replace(moment, arc_level=moment.arc_level * math.exp(0.5 * p["sigma_rel"] * float(steps.sum())))


def _draw_argon(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"on_axis": magnitude(strength, 0.06, 0.8)}


def _argon_edge(frame: WorldFrameLight, p: Values) -> None:
    passed = edge_transmission(ARGON_NM * filter_angle_shift(frame))
    frame.arc = frame.arc * (1.0 + p["on_axis"] * passed / edge_transmission(np.array(ARGON_NM)))


def _argon_gauss(frame: WorldFrameLight, p: Values) -> None:
    # As the stated filter passes the line: a Gaussian of its width.
    stated = frame.studio.world.setup.stated_filter
    off_nm = ARGON_NM * filter_angle_shift(frame) - stated.center_nm
    k = 4.0 * math.log(2.0) / stated.fwhm_nm**2
    passed = np.exp(-k * (off_nm**2 - (ARGON_NM - stated.center_nm) ** 2))
    frame.arc = frame.arc * (1.0 + p["on_axis"] * passed)


def _settled(p: Values, moment: Moment) -> float:
    """Return exp(rate settle (1 - exp(-t / settle)))."""
    return math.exp(p["rate_per_s"] * p["settle_s"] * -math.expm1(-moment.time_s / p["settle_s"]))


def _draw_settling(draw: Generator, change: float) -> dict[str, float]:
    """Draw a drift that has changed an output by a relative `change` after 2.3 s."""
    settle_s = magnitude(draw.random(), 0.5, 20.0)
    rate = signed(draw, math.log1p(change)) / (settle_s * -math.expm1(-2.3 / settle_s))
    return {"rate_per_s": rate, "settle_s": settle_s}


def _swinging(p: Values, moment: Moment) -> float:
    """Return 1 + amplitude sin(2 pi t / period + phase)."""
    turn = 2.0 * math.pi * moment.time_s / p["period_s"] + p["phase_rad"]
    return 1.0 + p["amplitude"] * math.sin(turn)


def _draw_swing(draw: Generator, amplitude: float) -> dict[str, float]:
    """Draw a slow swing."""
    period_s, phase = draw.uniform(1.0, 3.0), draw.uniform(0.0, 2.0 * math.pi)
    return {"amplitude": amplitude, "period_s": period_s, "phase_rad": phase}


def _hopped(p: Values, moment: Moment) -> float:
    """Return 1 + jump from `at_s` on, 1 before."""
    return 1.0 + p["jump"] * (moment.time_s >= p["at_s"])


def _draw_hop(draw: Generator, jump: float) -> dict[str, float]:
    """Draw a hop from one output to another, up or down."""
    return {"jump": signed(draw, jump), "at_s": draw.uniform(0.4, 1.0)}


def drift_forms(
    what: str,
    scaled: Callable[[Moment, float], Moment],
    settling: tuple[float, float],
    swing: tuple[float, float],
    hop: tuple[float, float],
) -> tuple[EffectForm, ...]:
    """Return the forms of a drift of an output, each with its magnitudes at strengths of 0 and 1."""

    def form(
        name: str,
        factor: str,
        draw_of: Callable[[Generator, float], dict[str, float]],
        sizes: tuple[float, float],
        factor_at: Callable[[Values, Moment], float],
    ) -> EffectForm:
        return EffectForm(
            name,
            f"{what} x {factor}",
            lambda draw, strength, setup: draw_of(draw, magnitude(strength, *sizes)),
            moment=lambda moment, p: scaled(moment, factor_at(p, moment)),
        )

    return (
        form(CATALOGUE, "exp(rate settle (1 - exp(-t / settle)))", _draw_settling, settling, _settled),
        form("swing", "(1 + amplitude sin(2 pi t / period + phase))", _draw_swing, swing, _swinging),
        form("hop", "(1 + jump) from a moment on", _draw_hop, hop, _hopped),
    )


def _scaled_laser(moment: Moment, factor: float) -> Moment:
    return replace(moment, laser_level=moment.laser_level * factor)


def _draw_speckle(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"contrast": magnitude(strength, 0.06, 0.35), "grain_px": draw.uniform(0.5, 1.5)}


def _grains(frame: WorldFrameLight, grain_px: float) -> Float64:
    """Return a field (H, W) of unit variance, white behind a Gaussian of 1 sigma `grain_px`."""
    field = gaussian_filter(frame.draw.standard_normal(frame.laser.shape), grain_px, mode="wrap")
    return np.asarray(field / field.std())


def _speckle(frame: WorldFrameLight, p: Values) -> None:
    spread = math.sqrt(math.log1p(p["contrast"] ** 2))
    frame.laser = frame.laser * np.exp(spread * _grains(frame, p["grain_px"]) - 0.5 * spread**2)


def _gamma_speckle(frame: WorldFrameLight, p: Values) -> None:
    # The sum of M independent exponentials, each the square of a complex field (Goodman, ch. 4).
    looks = max(1, round(1.0 / p["contrast"] ** 2))
    block = max(1, round(p["grain_px"]))
    height, width = frame.laser.shape
    coarse = frame.draw.gamma(looks, 1.0 / looks, (-(-height // block), -(-width // block)))
    frame.laser = frame.laser * np.kron(coarse, np.ones((block, block)))[:height, :width]


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "arc_length": (
        EffectForm(CATALOGUE, "center_z + height_mm", _draw_arc_length, world=_arc_length),
        EffectForm(
            "rides", "center_z + share x the tool's height over the seam", _draw_arc_rides, moment=_arc_rides
        ),
    ),
    "arc_deflection": (
        EffectForm(CATALOGUE, "center + (x_mm, y_mm), tool's frame", _draw_deflection, world=_arc_deflection),
        EffectForm(
            "growing",
            "center + 2 t / T (x_mm, y_mm): blow grows along the weld",
            _draw_deflection,
            moment=_growing_deflection,
        ),
    ),
    "arc_radius": (EffectForm(CATALOGUE, "R x radius_ratio", _draw_radius, world=scale_arc_radius),),
    "arc_flicker": (
        EffectForm(
            CATALOGUE, "arc x exp(sigma_rel n), n normal in each frame", _draw_flicker, moment=_flicker
        ),
        EffectForm("sine", "arc x (1 + amplitude sin(2 pi f t + phase))", _draw_wave, moment=_sine_flicker),
        EffectForm(
            "pulses",
            "arc x (1 +- amplitude), a square wave over the exposure",
            _draw_wave,
            moment=_pulse_flicker,
        ),
        EffectForm(
            "walk",
            "ln arc is a sum of normal steps, sigma_rel / 2 each",
            _draw_flicker,
            moment=_walking_flicker,
        ),
    ),
    "argon_line_leak": (
        EffectForm(
            CATALOGUE,
            "arc x (1 + on_axis T(696.54 nm, theta) / T(696.54 nm, 0)), T a real filter's",
            _draw_argon,
            image=_argon_edge,
        ),
        EffectForm(
            "gauss", "the same with a Gaussian passband of the stated width", _draw_argon, image=_argon_gauss
        ),
    ),
    "laser_power_drift": drift_forms(
        "laser", _scaled_laser, settling=(0.08, 0.4), swing=(0.04, 0.2), hop=(0.06, 0.3)
    ),
    "laser_speckle": (
        EffectForm(
            CATALOGUE, "laser x log-normal grains of a Gaussian correlation", _draw_speckle, image=_speckle
        ),
        EffectForm(
            "gamma",
            "laser x gamma-distributed grains, square and independent",
            _draw_speckle,
            image=_gamma_speckle,
        ),
    ),
}

"""The sensor of a made recording, and its hidden effects: charge to digital numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.instrument.sensor import Sensor
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    CATALOGUE,
    EffectForm,
    Generator,
    Moment,
    Values,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_light import TrueWorld
from validation.second_renderer.world_source import drift_forms


def stated_response(charge_e: Float64, sensor: Sensor) -> Float64:
    """Return the DN over black of a charge: (full_well / gain) sign(e) (|e| / full_well)^gamma."""
    share = np.abs(charge_e) / sensor.full_well_e
    return np.asarray(np.sign(charge_e) * share**sensor.gamma * (sensor.full_well_e / sensor.gain_e_per_dn))


def digitised(over_black_dn: Float64, black_dn: Float64, sensor: Sensor) -> Integers:
    """Return whole codes within the sensor's range."""
    codes = np.rint(over_black_dn + black_dn).clip(0, 2**sensor.bits - 1)
    return codes.astype(np.uint8 if sensor.bits == 8 else np.uint16)


def _scaled_exposure(moment: Moment, factor: float) -> Moment:
    return replace(moment, exposure_s=moment.exposure_s * factor)


def _draw_pattern(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"sigma_rel": magnitude(strength, 0.015, 0.08), "seed": drawn_seed(draw)}


def _even_pattern(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    pattern = np.random.default_rng(int(p["seed"])).standard_normal(charge.shape)
    return np.asarray(charge * (1.0 + p["sigma_rel"] * pattern))


def _column_pattern(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    draw = np.random.default_rng(int(p["seed"]))
    pixels, columns = draw.standard_normal(charge.shape), draw.standard_normal(charge.shape[1])
    return np.asarray(charge * np.exp(p["sigma_rel"] * (0.8 * pixels + 0.6 * columns)))


def _draw_blooming(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"spill": magnitude(strength, 0.1, 0.9), "reach_px": draw.uniform(8.0, 50.0)}


def _falling_blooming(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    over = np.maximum(charge - world.setup.sensor.full_well_e, 0.0)
    rows = np.arange(charge.shape[0])
    apart = np.abs(rows[:, np.newaxis] - rows)
    spread = np.where(apart > 0, np.exp(-apart / p["reach_px"]), 0.0)
    # What goes up and what goes down is half of the spill each.
    spread *= 0.5 * p["spill"] / np.exp(-np.arange(1, 2000) / p["reach_px"]).sum()
    return np.asarray(charge + spread @ over)


def _draw_leak(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"leak": magnitude(strength, 0.03, 0.4)}


def _constant_leak(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    over = np.maximum(charge - world.setup.sensor.full_well_e, 0.0)
    return np.asarray(charge + p["leak"] * over.sum(axis=0) / charge.shape[0])


def _draw_gamma(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"gamma": math.exp(signed(draw, magnitude(strength, 0.05, 0.4)))}


def _power(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    sensor = world.setup.sensor
    return stated_response(charge, replace(sensor, gamma=sensor.gamma * p["gamma"]))


def _draw_knee(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"knee": draw.uniform(0.12, 0.3), "slope": 1.0 - magnitude(strength, 0.08, 0.6)}


def _knee(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    knee_e = p["knee"] * world.setup.sensor.full_well_e
    return stated_response(
        np.where(charge > knee_e, knee_e + p["slope"] * (charge - knee_e), charge), world.setup.sensor
    )


def _draw_s_curve(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"bend": signed(draw, magnitude(strength, 0.1, 0.6))}


def _s_curve(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    well = world.setup.sensor.full_well_e
    x = np.clip(charge / well, 0.0, 1.0)
    return stated_response(charge + p["bend"] * well * x * (1.0 - x) * (2.0 * x - 1.0), world.setup.sensor)


def _draw_black(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # Downwards the code ends at zero.
    size = magnitude(strength, 1.0, 10.0)
    return {"offset_dn": -size if size < 2.5 and draw.random() < 0.5 else size}


def _even_black(moment: Moment, shape: tuple[int, int], p: Values) -> Float64:
    return np.full(shape, p["offset_dn"])


def _draw_sloping_black(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"offset_dn": magnitude(strength, 1.0, 10.0), "slope": draw.uniform(-0.5, 0.5)}


def _sloping_black(moment: Moment, shape: tuple[int, int], p: Values) -> Float64:
    along = np.linspace(-1.0, 1.0, shape[0])[:, np.newaxis]
    return np.broadcast_to(p["offset_dn"] * (1.0 + p["slope"] * along), shape)


def _draw_read_noise(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"noise_ratio": magnitude(strength, 1.2, 4.0)}


def _gaussian_noise(draw: Generator, shape: tuple[int, int], sigma_e: float, p: Values) -> Float64:
    return p["noise_ratio"] * sigma_e * draw.standard_normal(shape)


def _heavy_noise(draw: Generator, shape: tuple[int, int], sigma_e: float, p: Values) -> Float64:
    # Student's t of five degrees of freedom has the variance 5/3.
    return p["noise_ratio"] * sigma_e * draw.standard_t(5.0, shape) / math.sqrt(5.0 / 3.0)


def _draw_jpeg(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"quality": float(round(100.0 - magnitude(strength, 5.0, 60.0)))}


def _jpeg(codes: Integers, p: Values) -> Integers:
    _, kept = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, int(p["quality"])])
    return np.asarray(cv2.imdecode(kept, cv2.IMREAD_UNCHANGED), dtype=codes.dtype)


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "exposure_drift": drift_forms(
        "exposure", _scaled_exposure, settling=(0.03, 0.4), swing=(0.02, 0.2), hop=(0.03, 0.3)
    ),
    "fixed_pattern": (
        EffectForm(CATALOGUE, "charge x (1 + sigma_rel n), n normal", _draw_pattern, charge=_even_pattern),
        EffectForm(
            "columns", "log-normal gains of pixels and columns", _draw_pattern, charge=_column_pattern
        ),
    ),
    "blooming": (
        EffectForm(
            CATALOGUE,
            "the share spill of what exceeds full well, along its column, exp(-distance / reach_px)",
            _draw_blooming,
            charge=_falling_blooming,
        ),
        EffectForm(
            "leak", "a column's excess times leak, evenly all along it", _draw_leak, charge=_constant_leak
        ),
    ),
    "gamma": (
        EffectForm(CATALOGUE, "DN ~ e^(gamma_stated x gamma)", _draw_gamma, response=_power),
        EffectForm("knee", "linear, beyond knee x full well with another slope", _draw_knee, response=_knee),
        EffectForm(
            "s_curve", "x + bend x (1 - x) (2 x - 1), x = e / full well", _draw_s_curve, response=_s_curve
        ),
    ),
    "black_level": (
        EffectForm(CATALOGUE, "black level + offset_dn", _draw_black, offset=_even_black),
        EffectForm(
            "sloping",
            "an offset that changes from the top row to the bottom",
            _draw_sloping_black,
            offset=_sloping_black,
        ),
    ),
    "read_noise": (
        EffectForm(CATALOGUE, "Gaussian, noise_ratio x the stated", _draw_read_noise, noise=_gaussian_noise),
        EffectForm(
            "heavy",
            "Student's t of 5 degrees of freedom, noise_ratio x the stated",
            _draw_read_noise,
            noise=_heavy_noise,
        ),
    ),
    "image_compression": (
        EffectForm(CATALOGUE, "JPEG of a quality, as libjpeg writes it", _draw_jpeg, codes=_jpeg),
    ),
}

"""Further forms of effects of the sensor, which no judgement was tuned on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from noise_model.compiled.arrays import Float64, Integers
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    EffectForm,
    Generator,
    Moment,
    Values,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_light import TrueWorld
from validation.second_renderer.world_sensor import stated_response
from validation.second_renderer.world_stated import EXPOSURE_S


def _draw_ramp(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    size = magnitude(strength, 0.03, 0.35)
    return {
        "ramp": signed(draw, size),
        "wobble": size * draw.uniform(0.15, 0.4),
        "frequency_hz": draw.uniform(0.7, 4.0),
        "phase_rad": draw.uniform(0.0, 2.0 * math.pi),
    }


def _ramp(moment: Moment, p: Values) -> Moment:
    wobble = math.sin(2.0 * math.pi * p["frequency_hz"] * moment.time_s + p["phase_rad"])
    factor = 1.0 + p["ramp"] * moment.time_s / moment.duration_s + p["wobble"] * wobble
    return replace(moment, exposure_s=moment.exposure_s * factor)


def _draw_three_parts(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"sigma_rel": magnitude(strength, 0.015, 0.08), "seed": drawn_seed(draw)}


def _three_parts(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    draw, (height, width) = np.random.default_rng(int(p["seed"])), charge.shape
    rows, columns = draw.standard_normal((height, 1)), draw.standard_normal((1, width))
    gains = 0.8 * draw.standard_normal(charge.shape) + 0.45 * rows + 0.4 * columns
    return np.asarray(charge * np.maximum(1.0 + p["sigma_rel"] * gains, 0.0))


def _draw_wells(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"spill": magnitude(strength, 0.05, 0.4)}


def _filled_wells(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    """Let half of what spills go up and half down, each into the next wells that have room."""
    well = world.setup.sensor.full_well_e
    spilled = 0.5 * p["spill"] * np.maximum(charge - well, 0.0)
    filled = charge.copy()
    for rows in (range(charge.shape[0]), range(charge.shape[0] - 1, -1, -1)):
        carried = np.zeros(charge.shape[1])
        for row in rows:
            taken = np.minimum(carried, np.maximum(well - filled[row], 0.0))
            filled[row] += taken
            carried += spilled[row] - taken
    return filled


def _draw_saturation(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"bend": magnitude(strength, 0.12, 1.5)}


def _saturating(charge: Float64, world: TrueWorld, p: Values) -> Float64:
    sensor = world.setup.sensor
    share = charge / sensor.full_well_e
    return stated_response(charge * (1.0 + p["bend"]) / (1.0 + p["bend"] * share), sensor)


def _draw_dark_current(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"offset_dn": magnitude(strength, 1.1, 10.0), "slope": draw.uniform(-0.5, 0.5)}


def _dark_current(moment: Moment, shape: tuple[int, int], p: Values) -> Float64:
    along = np.linspace(-1.0, 1.0, shape[1])
    offset_dn = p["offset_dn"] * moment.exposure_s / EXPOSURE_S
    return np.broadcast_to(offset_dn * (1.0 + p["slope"] * along), shape)


ROW_SHARE = 0.3
"""Share of the further noise's variance that a row has in common."""


def _draw_row_noise(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"noise_ratio": magnitude(strength, 1.2, 4.0)}


def _row_noise(draw: Generator, shape: tuple[int, int], sigma_e: float, p: Values) -> Float64:
    more = p["noise_ratio"] ** 2 - 1.0
    pixels = math.sqrt(1.0 + (1.0 - ROW_SHARE) * more) * draw.standard_normal(shape)
    return sigma_e * (pixels + math.sqrt(ROW_SHARE * more) * draw.standard_normal((shape[0], 1)))


def _draw_wavelets(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"ratio": float(round(magnitude(strength, 6.0, 40.0)))}


def _wavelets(codes: Integers, p: Values) -> Integers:
    kept_per_1000 = [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, round(1000.0 / p["ratio"])]
    _, kept = cv2.imencode(".jp2", codes, kept_per_1000)
    return np.asarray(cv2.imdecode(kept, cv2.IMREAD_UNCHANGED), dtype=codes.dtype)


FORMS: Mapping[str, EffectForm] = {
    "exposure_drift": EffectForm(
        "ramp",
        "exposure x (1 + ramp t / T + wobble sin(2 pi f t + phase)): a gain that follows a temperature and "
        "its control (Janesick 2001, Scientific Charge-Coupled Devices)",
        _draw_ramp,
        moment=_ramp,
    ),
    "fixed_pattern": EffectForm(
        "three_parts",
        "charge x (1 + sigma_rel (0.8 pixels + 0.45 rows + 0.4 columns)), all normal (EMVA 1288, release "
        "4.0: nonuniformity split by rows, columns and pixels)",
        _draw_three_parts,
        charge=_three_parts,
    ),
    "blooming": EffectForm(
        "wells",
        "the share spill of what exceeds full well fills the next wells of its column, half up and half down "
        "(Janesick 2001, Scientific Charge-Coupled Devices)",
        _draw_wells,
        charge=_filled_wells,
    ),
    "gamma": EffectForm(
        "saturating",
        "x (1 + bend) / (1 + bend x), x = e / full well: a hyperbola (Naka and Rushton 1966, J. Physiol. "
        "185, 536)",
        _draw_saturation,
        response=_saturating,
    ),
    "black_level": EffectForm(
        "dark_current",
        "black level + offset_dn (1 + slope column) x exposure / nominal: dark current (EMVA 1288)",
        _draw_dark_current,
        offset=_dark_current,
    ),
    "read_noise": EffectForm(
        "rows",
        "Gaussian, noise_ratio x the stated, 0.3 of the further variance in common for a row (D'Agostino and "
        "Webb 1991, Proc. SPIE 1488, 110: 3-D noise)",
        _draw_row_noise,
        noise=_row_noise,
    ),
    "image_compression": EffectForm(
        "wavelets", "JPEG 2000, ratio times smaller (ISO/IEC 15444-1)", _draw_wavelets, codes=_wavelets
    ),
}

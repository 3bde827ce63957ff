"""Illumination: the laser's power and its granularity."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.arrays import Float32
from noise_model.condition import Condition
from noise_model.effects import drift
from noise_model.effects.effect import Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.instrument.camera import blur
from noise_model.view import View


def _laser_power_drift(condition: Condition, values: Values) -> Condition:
    factor = drift.drifted(values, condition.timestamp_s)
    return replace(condition, laser_level=condition.laser_level * factor)


def _laser_speckle(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    contrast = np.float32(values["contrast"])
    if draw is None:
        light.variance_e2 = light.variance_e2 + (contrast * light.laser) ** 2
    else:
        light.laser = light.laser * _granularity(view.shape, float(contrast), values["grain_px"], draw)


def _granularity(
    shape: tuple[int, ...], contrast: float, grain_px: float, draw: np.random.Generator
) -> Float32:
    """Return a field (H, W) of mean 1 and standard deviation `contrast`, never negative.

    Log-normal; its logarithm is white noise behind a Gaussian of 1 sigma `grain_px`.
    """
    # Beyond the rim there is speckle too: a reflected rim would count its own grains twice.
    rim = max(1, math.ceil(4.0 * grain_px))
    wide = draw.standard_normal((shape[0] + 2 * rim, shape[1] + 2 * rim)).astype(np.float32)
    field = blur(wide, grain_px)[rim : rim + shape[0], rim : rim + shape[1]]
    grain = np.zeros((4 * rim + 1, 4 * rim + 1), dtype=np.float32)
    grain[2 * rim, 2 * rim] = 1.0
    unit = field / np.linalg.norm(blur(grain, grain_px))
    spread = math.sqrt(math.log1p(contrast**2))
    return np.asarray(np.exp(np.float32(spread) * unit - np.float32(0.5 * spread**2)), dtype=np.float32)


EFFECTS = (
    Effect(
        id="laser_power_drift",
        stage=Stage.ILLUMINATION,
        summary="the stripe's power changes over the recording",
        equation="laser' = laser " + drift.EQUATION,
        source="a diode's threshold current rises as exp(T / T_0), T_0 some 100 K: at a steady current its "
        "power falls while it warms up, and rests when it is warm",
        parameters=drift.PARAMETERS,
        typical={"rate_per_s": -0.2},
        condition=_laser_power_drift,
    ),
    Effect(
        id="laser_speckle",
        stage=Stage.ILLUMINATION,
        summary="coherent granularity of the stripe",
        equation="variance += (contrast laser)^2 in the image behind lens and pixel; a realisation is "
        "log-normal, correlated over grain_px",
        source="Goodman, Speckle Phenomena in Optics; Dorsch, Haeusler, Herrmann 1994, Appl. Opt. 33, 1306",
        parameters=(
            Parameter("contrast", "", 0.0, 0.2, 0.0, 1.0, 0.005),
            Parameter("grain_px", "px", 1.0, 0.5, 0.3, 10.0, 0.05),
        ),
        typical={"contrast": 0.3, "grain_px": 1.0},
        image=_laser_speckle,
    ),
)

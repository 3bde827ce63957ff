"""Illumination: the laser's power and its granularity."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.condition import Condition
from noise_model.effects import drift
from noise_model.effects.effect import Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.effects.pattern import in_image_px, normal_field, part_seed
from noise_model.fit import Parameter
from noise_model.view import View


def _laser_power_drift(condition: Condition, values: Values) -> Condition:
    factor = drift.drifted(values, condition.timestamp_s)
    return replace(condition, laser_level=condition.laser_level * factor)


def _laser_speckle(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    contrast = np.float32(values["contrast"])
    if draw is None:
        light.variance_e2 = light.variance_e2 + (contrast * light.laser) ** 2
        return
    if contrast == 0.0:
        return
    lit = light.laser > 0.0
    normal = normal_field(in_image_px(view, lit), values["grain_px"], part_seed(view, draw))
    # ln(1 + C^2) makes mean 1 and standard deviation C of light that cannot be negative.
    spread = math.sqrt(math.log1p(float(contrast) ** 2))
    light.laser = light.laser.copy()
    light.laser[lit] *= np.exp(spread * normal - 0.5 * spread**2).astype(np.float32)


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
        "log-normal, its logarithm correlated as exp(-d^2 / 4 grain_px^2), d between two points of the part "
        "as the level camera sees them: the pattern moves with the part",
        source="Goodman, Speckle Phenomena in Optics; Dorsch, Haeusler, Herrmann 1994, Appl. Opt. 33, 1306. "
        "The optics say how large both are: `noise_model.plan.noise.expected_speckle`",
        parameters=(
            Parameter("contrast", "", 0.0, 0.2, 0.0, 1.0, 0.005),
            Parameter("grain_px", "px", 1.0, 0.5, 0.25, 10.0, 0.05),
        ),
        typical={"contrast": 0.3, "grain_px": 1.0},
        image=_laser_speckle,
    ),
)

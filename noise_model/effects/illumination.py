"""Illumination: the laser's power, its granularity, its fan and profile, and the light of the hall."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from noise_model.compiled.arrays import Float32
from noise_model.condition import Condition
from noise_model.effects import drift
from noise_model.effects.effect import ANY_SCENE, UNSTATED, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.effects.pattern import in_image_px, normal_field, part_seed
from noise_model.fit import Parameter
from noise_model.setup import Setup
from noise_model.stripe import stripe_depth_mm
from noise_model.transforms import invert, transform
from noise_model.view import View

GAUSSIAN = 2.0
"""The exponent of a Gaussian's profile."""


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


def _uneven_fan(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    angle_deg = view.cached("fan_angle_deg", lambda: _fan_angle_deg(view))
    tens = angle_deg / np.float32(10.0)
    power = 1.0 + np.float32(values["slope"]) * tens + np.float32(values["curvature"]) * tens**2
    # 1 sigma of the angle over which an uneven fan ends.
    inside = ndtr((values["half_angle_deg"] - np.abs(angle_deg)) / 0.2)
    light.laser = light.laser * (np.maximum(power, 0.0) * inside).astype(np.float32)


def _fan_angle_deg(view: View) -> Float32:
    """Return at which angle to the fan's axis, in the sheet, what a pixel sees lies (...,), deg.

    It is positive to the left where the sheet stands ahead of the tool. Past the workpiece it is 0: there is
    no stripe.
    """
    axis, side, _ = view.setup.laser.fan
    points = transform(invert(view.scene.T_joint_tool), view.surface[0]) - view.setup.laser.origin_mm
    return np.nan_to_num(np.degrees(np.arctan2(points @ side, points @ axis))).astype(np.float32)


def _stripe_profile(setup: Setup, values: Values) -> Setup:
    laser = setup.laser
    other = replace(
        laser,
        stripe_sigma_mm=laser.stripe_sigma_mm * values["width_ratio"],
        profile_exponent=values["exponent"],
    )
    return replace(setup, laser=other)


def _ambient_light(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    level_e, texture = values["level_e"], values["texture"]
    if level_e == 0.0:
        return
    normals = view.surface[1].astype(np.float32)
    facing = 1.0 + np.float32(values["from_left"]) * normals[..., 1] + 0.5 * (normals[..., 2] - 1.0)
    # What lies past the workpiece is as bright as a level plate.
    seen = np.float32(level_e) * view.rays.cos4 * np.maximum(np.nan_to_num(facing, nan=1.0), 0.0)
    if draw is None:
        light.variance_e2 = light.variance_e2 + (np.float32(texture) * seen) ** 2
    elif texture > 0.0:
        everywhere = np.ones(view.shape, dtype=np.bool_)
        # 1 sigma of the grain of a scene's texture, as the level camera sees it.
        grain_px = 1.0 * view.setup.camera.fx / stripe_depth_mm(view.setup)
        normal = normal_field(in_image_px(view, everywhere), grain_px, part_seed(view, draw))
        spread = math.sqrt(math.log1p(texture**2))
        seen = seen * np.exp(spread * normal - 0.5 * spread**2).reshape(view.shape).astype(np.float32)
    light.other = light.other + seen


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
        form_rel=UNSTATED,
    ),
    Effect(
        id="laser_speckle",
        stage=Stage.ILLUMINATION,
        summary="coherent granularity of the stripe",
        equation="variance += (contrast laser)^2 in the image behind lens and pixel. A realisation is "
        "log-normal. Its logarithm is correlated as exp(-d^2 / 4 grain_px^2), d the distance of two points "
        "of the part as the level camera sees them. The pattern moves with the part",
        source="Goodman, Speckle Phenomena in Optics; Dorsch, Haeusler, Herrmann 1994, Appl. Opt. 33, 1306. "
        "The optics say how large both are: `noise_model.plan.noise.expected_speckle`",
        parameters=(
            Parameter("contrast", "", 0.0, 0.5, 0.0, 1.0, 0.005),
            Parameter("grain_px", "px", 1.0, 0.5, 0.25, 10.0, 0.05),
        ),
        typical={"contrast": 0.3, "grain_px": 1.0},
        image=_laser_speckle,
    ),
    Effect(
        id="uneven_fan",
        stage=Stage.ILLUMINATION,
        summary="the sheet's power varies along it, or ends",
        equation="laser' = laser max(1 + slope a + curvature a^2, 0) Phi((half_angle_deg - |phi|) / "
        "0.2 deg), phi the angle to the fan's axis in the sheet, deg, a = phi / 10 deg",
        source="Powell 1989 (US 4826299): a cylinder lens leaves a Gaussian along the line, a Powell lens an "
        "even one that ends; the first terms of any such profile. [laser] fan_half_angle_deg states an end",
        parameters=(
            Parameter("slope", "", 0.0, 0.3, -3.0, 3.0, 0.002),
            Parameter("curvature", "", 0.0, 0.3, -3.0, 3.0, 0.002),
            Parameter("half_angle_deg", "deg", 90.0, 45.0, 0.5, 90.0, 0.02),
        ),
        typical={"slope": 0.4, "half_angle_deg": 6.0},
        light=_uneven_fan,
    ),
    Effect(
        id="stripe_profile",
        stage=Stage.ILLUMINATION,
        summary="the stripe has another profile or width than stated",
        equation="irradiance ~ exp(-1/2 |x' / (width_ratio sigma)|^exponent) across the sheet, at the same "
        "peak; 2 is a Gaussian, more a flat top, less long tails",
        source="Parent, Morin and Lavigne 1992, Opt. Quantum Electron. 24, S1071: super-Gaussian beams; "
        "stripes of line lasers on steel were measured at exponents of 2.3 to 2.6",
        parameters=(
            Parameter("width_ratio", "", 1.0, 0.3, 0.2, 4.0, 0.002),
            Parameter("exponent", "", GAUSSIAN, 0.5, 1.2, 12.0, 0.005),
        ),
        typical={"width_ratio": 1.5, "exponent": 3.0},
        setup=_stripe_profile,
    ),
    Effect(
        id="ambient_light",
        stage=Stage.ILLUMINATION,
        summary="light of the hall, with the scene's texture, whether laser and arc are on or off",
        equation="other += level_e cos^4 max(1 + from_left n_y + (n_z - 1) / 2, 0), n the surface's normal, "
        "joint frame; past the workpiece as on a level plate. Texture is log-normal, of contrast texture "
        "and a grain of 1 mm, fixed to the part: variance += (texture ambient)^2",
        source="Ramamoorthi and Hanrahan 2001 (J. Opt. Soc. Am. A 18, 2448): a dull surface shows distant "
        "light by a constant and a term linear in the normal, nearly; 1/2 is an even sky's",
        parameters=(
            Parameter("level_e", "e-", 0.0, 2000.0, 0.0, 1e6, 10.0),
            Parameter("from_left", "", 0.0, 0.3, -1.0, 1.0, 0.01),
            Parameter("texture", "", 0.0, 0.3, 0.0, 2.0, 0.01),
        ),
        typical={"level_e": 3000.0, "texture": 0.2},
        light=_ambient_light,
        form_rel=ANY_SCENE,
        is_textured=True,
    ),
)

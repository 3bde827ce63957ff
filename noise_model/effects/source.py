"""Source: where the arc stands, how large it is, how steadily it burns, what else it emits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.effects.effect import ANOTHER_VALUE, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.instrument.argon import REFERENCE_NM
from noise_model.instrument.spectrum import ArcSpectrum, angle_shift, line_to_continuum, over_field
from noise_model.setup import Setup
from noise_model.view import View


def _moved_arc(setup: Setup, x_mm: float, y_mm: float, z_mm: float) -> Setup:
    x, y, z = setup.arc.center_in_tool_mm
    return replace(setup, arc=replace(setup.arc, center_in_tool_mm=(x + x_mm, y + y_mm, z + z_mm)))


def _arc_length(setup: Setup, values: Values) -> Setup:
    return _moved_arc(setup, 0.0, 0.0, values["height_mm"])


def _arc_deflection(setup: Setup, values: Values) -> Setup:
    return _moved_arc(setup, values["x_mm"], values["y_mm"], 0.0)


def _arc_radius(setup: Setup, values: Values) -> Setup:
    return replace(setup, arc=replace(setup.arc, radius_mm=setup.arc.radius_mm * values["radius_ratio"]))


def _arc_flicker(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    # Behind the lens, where all of the arc's light is together: what lies before takes it by its factors.
    sigma = values["sigma_rel"]
    if draw is None:
        light.modes["arc_flicker"] = np.float32(sigma) * light.arc
    else:
        # ln(1 + s^2) makes mean 1 and standard deviation s of a level that cannot be negative.
        spread = np.sqrt(np.log1p(sigma**2))
        light.arc = light.arc * np.float32(np.exp(spread * draw.standard_normal() - 0.5 * spread**2))


def _argon_line_leak(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    # Behind the lens as well: what bounces, and what fume scatters, goes through the same filter.
    spectrum, of_filter = ArcSpectrum(line_width_nm=values["line_width_nm"]), view.setup.stated_filter

    def over_continuum(theta: Float64) -> Float64:
        moved_nm = REFERENCE_NM * (1.0 / angle_shift(theta, of_filter.effective_index) - 1.0)
        steeper = 10.0 ** (-values["edge_od_per_nm"] * moved_nm)
        return np.asarray(line_to_continuum(of_filter, spectrum, theta) * steeper)

    light.scale_arc((1.0 + over_field(over_continuum, view.theta)).astype(np.float32))


EFFECTS = (
    Effect(
        id="arc_length",
        stage=Stage.SOURCE,
        summary="the arc's centre stands higher than stated",
        equation="center_z' = center_z + height_mm, along the tool's axis",
        source="the plasma is hottest, and so brightest, near the cathode (Hsu, Etemadi and Pfender 1983, "
        "J. Appl. Phys. 54, 1293): the light's height goes with the arc gap",
        parameters=(Parameter("height_mm", "mm", 0.0, 1.0, -3.0, 8.0, 0.02),),
        typical={"height_mm": 1.5},
        setup=_arc_length,
        form_rel=ANOTHER_VALUE,
        needs=("arc",),
    ),
    Effect(
        id="arc_deflection",
        stage=Stage.SOURCE,
        summary="arc blow: the centre is displaced sideways",
        equation="(center_x', center_y') = (center_x + x_mm, center_y + y_mm), in the tool's frame",
        source="magnetic arc blow displaces the column by millimetres (AWS Welding Handbook, vol. 1)",
        parameters=(
            Parameter("x_mm", "mm", 0.0, 1.0, -8.0, 8.0, 0.02),
            Parameter("y_mm", "mm", 0.0, 1.0, -8.0, 8.0, 0.02),
        ),
        typical={"x_mm": 1.0, "y_mm": 1.5},
        setup=_arc_deflection,
        form_rel=ANOTHER_VALUE,
        needs=("arc",),
    ),
    Effect(
        id="arc_radius",
        stage=Stage.SOURCE,
        summary="the luminous hemisphere has another radius",
        equation="R' = radius_ratio R at the same radiance",
        source="Yu, Kim and Na take R from the arc's picture; it grows with current and gap",
        parameters=(Parameter("radius_ratio", "", 1.0, 0.3, 0.2, 4.0, 0.01),),
        typical={"radius_ratio": 1.5},
        setup=_arc_radius,
        form_rel=ANOTHER_VALUE,
        needs=("arc",),
    ),
    Effect(
        id="arc_flicker",
        stage=Stage.SOURCE,
        summary="the arc's output varies from frame to frame (pulsed or unsteady current)",
        equation="arc' = arc (1 + sigma_rel n), n one number of unit variance a frame: a mode of the frame's "
        "covariance, not noise of each pixel",
        source="ripple and pulsing of the current pass into the light (Eq. 15: L ~ I^n)",
        parameters=(Parameter("sigma_rel", "", 0.0, 0.2, 0.0, 1.0, 0.005),),
        typical={"sigma_rel": 0.2},
        image=_arc_flicker,
        needs=("arc",),
    ),
    Effect(
        id="argon_line_leak",
        stage=Stage.SOURCE,
        summary="Ar I 696.54 nm passes the filter's edge, more on axis than off",
        equation="arc' = arc (1 + sum_lines W T_theta(lambda) / integral B T_theta d lambda / B), W the "
        "line's equivalent width; T_theta shifts to shorter wavelengths off axis, and falls more steeply "
        "than stated: times 10^(-edge_od_per_nm (696.54 nm / s(theta) - 696.54 nm)), s the filter's shift",
        source="spectrum.line_to_continuum; NIST ASD for the lines; filter shift after Smith, Modern Optical "
        "Engineering, ch. 11; a real 690/10 nm filter has densities of 0.342 at 696 nm and 1.008 at 697 nm, "
        "0.5 per nm steeper there than a Gaussian of its width",
        parameters=(
            Parameter("line_width_nm", "nm", 0.0, 20.0, 0.0, 300.0, 0.2),
            Parameter("edge_od_per_nm", "", 0.0, 0.5, 0.0, 3.0, 0.02),
        ),
        typical={"line_width_nm": 20.0},
        image=_argon_line_leak,
        needs=("arc", "filter"),
    ),
)

"""Surface: what the metal does that the stated reflectance does not say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from noise_model.condition import Condition
from noise_model.effects.effect import ANOTHER_VALUE, UNSTATED, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.interreflection.mirrored import mirrored_stripe_e
from noise_model.interreflection.model import bounced_light, is_followed
from noise_model.setup import Setup
from noise_model.stripe import stripe_reference
from noise_model.view import View

OUTLINE_MM = 0.1
"""1 sigma of the way over which light ends at a plate's edge."""


def _wrong_material(setup: Setup, values: Values) -> Setup:
    material = setup.material
    other = replace(
        material,
        kappa_diff=material.kappa_diff * math.exp(values["kappa_diff_ln"]),
        kappa_spec=material.kappa_spec * math.exp(values["kappa_spec_ln"]),
    )
    true = replace(setup, material=other)
    if values["stripe_share"] == 0.0:
        return true
    brighter = stripe_reference(true) / stripe_reference(setup)
    peak_e = setup.laser.peak_e * brighter ** values["stripe_share"]
    return replace(true, laser=replace(setup.laser, peak_e=peak_e))


def _roughness_change(setup: Setup, values: Values) -> Setup:
    material = setup.material
    return replace(setup, material=replace(material, c2=material.c2 * math.exp(values["c2_ln"])))


def _brdf_tail(setup: Setup, values: Values) -> Setup:
    material = setup.material
    return replace(setup, material=replace(material, lobe=replace(material.lobe, tail=values["tail"])))


def _rolling_marks(setup: Setup, values: Values) -> Setup:
    material = setup.material
    lobe = replace(material.lobe, anisotropy=values["anisotropy"], marks_deg=values["marks_deg"])
    return replace(setup, material=replace(material, lobe=lobe))


def _plate_outline(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    y_mm = np.nan_to_num(view.surface[0][..., 1])
    on_left = ndtr((values["left_mm"] - y_mm) / OUTLINE_MM)
    on_right = ndtr((values["right_mm"] + y_mm) / OUTLINE_MM)
    on_plate = (on_left * on_right).astype(np.float32)
    light.scale_arc(on_plate)
    light.laser = light.laser * on_plate


def _interreflection(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if values["albedo"] == 0.0:
        return
    scale = values["albedo"] / view.setup.material.relative_albedo
    bounced = bounced_light(view)
    if condition.arc_level > 0.0:
        light.arc = light.arc + np.float32(condition.arc_level) * bounced.arc_e(scale)
    if condition.laser_level > 0.0:
        light.laser = light.laser + np.float32(condition.laser_level) * bounced.laser_e(scale)


def _groove_glare(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if condition.arc_level == 0.0:
        return
    x_mm, y_mm = np.moveaxis(np.nan_to_num(view.surface[0][..., :2], nan=np.inf), -1, 0)
    far = np.abs(x_mm - view.scene.center_mm[0]) / values["length_mm"]
    shape = np.exp(-far - 0.5 * (y_mm / values["width_mm"]) ** 2).astype(np.float32)
    light.arc = light.arc + np.float32(condition.arc_level * values["peak_e"]) * view.rays.cos4 * shape


def _mirrored_stripe(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if values["strength"] == 0.0 or condition.laser_level == 0.0:
        return
    unit_e = np.float32(condition.laser_level * values["strength"])
    light.laser = light.laser + unit_e * view.cached("mirrored_stripe", lambda: mirrored_stripe_e(view))


EFFECTS = (
    Effect(
        id="wrong_material",
        stage=Stage.SURFACE,
        summary="kappa_diff and kappa_spec are another material's",
        equation="kappa_diff' = kappa_diff exp(kappa_diff_ln), kappa_spec' = kappa_spec exp(kappa_spec_ln); "
        "peak_e' = peak_e (f_r' / f_r)^stripe_share at the stripe's peak: 0 where peak_e is what is seen on "
        "the real plate, 1 where it was stated for the other metal",
        source="Table 1: mild steel and Zn-coated steel differ by a factor of 24 and 1/2",
        parameters=(
            Parameter("kappa_diff_ln", "", 0.0, 1.0, -5.0, 5.0, 0.01),
            Parameter("kappa_spec_ln", "", 0.0, 1.0, -5.0, 5.0, 0.01),
            Parameter("stripe_share", "", 0.0, 0.5, 0.0, 1.0, 0.01),
        ),
        typical={"kappa_diff_ln": 1.5, "kappa_spec_ln": -0.7},
        setup=_wrong_material,
        form_rel=ANOTHER_VALUE,
        needs=("material",),
    ),
    Effect(
        id="roughness_change",
        stage=Stage.SURFACE,
        summary="another c2: the lobe is wider or narrower",
        equation="c2' = c2 exp(c2_ln); c2 = 1 / (2 s^2), s the facets' slope",
        source="Torrance and Sparrow 1967; Table 1 spans 8 to 112",
        parameters=(Parameter("c2_ln", "", 0.0, 0.7, -4.0, 4.0, 0.01),),
        typical={"c2_ln": -0.9},
        setup=_roughness_change,
        form_rel=ANOTHER_VALUE,
        needs=("material",),
    ),
    Effect(
        id="brdf_tail",
        stage=Stage.SURFACE,
        summary="the lobe's tail is not Gaussian",
        equation="exp(-c2 alpha^2) becomes (1 + tail c2 alpha^2)^(-1 / tail)",
        source="Student's t of the facets' slopes: Ribardiere et al. 2017, Comput. Graph. Forum 36(2), 421",
        parameters=(Parameter("tail", "", 0.0, 0.5, 0.0, 4.0, 0.01),),
        typical={"tail": 0.6},
        setup=_brdf_tail,
        needs=("material",),
    ),
    Effect(
        id="rolling_marks",
        stage=Stage.SURFACE,
        summary="the lobe is anisotropic, fixed to the part",
        equation="c2' = c2 (exp(a) cos^2 psi + exp(-a) sin^2 psi), psi the half vector's azimuth from the "
        "marks, which lie marks_deg to the left of travel",
        source="Ward 1992, SIGGRAPH Comput. Graph. 26(2), 265",
        parameters=(
            Parameter("anisotropy", "", 0.0, 0.5, -3.0, 3.0, 0.01),
            Parameter("marks_deg", "deg", 0.0, 60.0, -90.0, 90.0, 0.5),
        ),
        typical={"anisotropy": 0.8, "marks_deg": 0.0},
        setup=_rolling_marks,
        needs=("material",),
    ),
    Effect(
        id="plate_outline",
        stage=Stage.SURFACE,
        summary="the plates end within the view: neither laser nor arc is seen on what lies beyond",
        equation="laser' = laser Phi((left_mm - y) / 0.1 mm) Phi((right_mm + y) / 0.1 mm), y to the left of "
        "the seam; arc' alike",
        source="an edge that is lit from above shows as a step; what lies below it is out of the sensor's "
        "depth and is taken to be dark",
        parameters=(
            Parameter("left_mm", "mm", 500.0, 300.0, 0.5, 500.0, 0.01),
            Parameter("right_mm", "mm", 500.0, 300.0, 0.5, 500.0, 0.01),
        ),
        typical={"right_mm": 12.0},
        light=_plate_outline,
    ),
    Effect(
        id="interreflection",
        stage=Stage.SURFACE,
        summary="light bounces between the faces of the joint",
        equation="the Neumann series of the rendering equation: light that has met n faces before goes with "
        "scale^n, the absolute reflectance being scale f_r with scale = albedo / A, A the integral of "
        "f_r cos(theta_r) over the directions out for light that falls straight on",
        source="Kajiya 1986, SIGGRAPH Comput. Graph. 20(4), 143; `noise_model.interreflection.model`",
        parameters=(Parameter("albedo", "", 0.0, 0.5, 0.0, 0.95, 0.01),),
        typical={"albedo": 0.7},
        light=_interreflection,
        is_followed=is_followed,
        form_rel=UNSTATED,
        spreads=True,
    ),
    Effect(
        id="groove_glare",
        stage=Stage.SURFACE,
        summary="the arc's reflection runs along the seam: a groove or a root that shines",
        equation="arc += peak_e cos^4 exp(-|x - x_arc| / length_mm - y^2 / (2 width_mm^2)), x along the "
        "seam, y across it from its middle",
        source="pictures of gas metal arc welding: Li et al. 2017, IEEE Trans. Ind. Electron. (doi "
        "10.1109/TIE.2017.2694399). Ground and milled faces mirror the arc at grazing angles, which no lobe "
        "about a flat face's normal holds; the shape is that of the pictures",
        parameters=(
            Parameter("peak_e", "e-", 0.0, 10_000.0, 0.0, 1e7, 50.0),
            Parameter("width_mm", "mm", 1.0, 1.0, 0.05, 20.0, 0.02),
            Parameter("length_mm", "mm", 20.0, 10.0, 1.0, 300.0, 0.2),
        ),
        typical={"peak_e": 20_000.0},
        light=_groove_glare,
        needs=("arc",),
        form_rel=UNSTATED,
    ),
    Effect(
        id="mirrored_stripe",
        stage=Stage.SURFACE,
        summary="the stripe mirrored between a joint's faces: seen in the opposite one, and thrown there",
        equation="laser += strength (stripe seen along the ray mirrored in the face + stripe of the sheet "
        "mirrored in each other face), both where their ways are free; a corrugation mirrors none",
        source="the law of reflection; pictures of V-grooves in Li et al. 2017 (doi "
        "10.1109/TIE.2017.2694399) show both. `interreflection` has this light by the stated lobe, smeared",
        parameters=(Parameter("strength", "", 0.0, 0.2, 0.0, 1.0, 0.002),),
        typical={"strength": 0.3},
        light=_mirrored_stripe,
        form_rel=UNSTATED,
        spreads=True,
    ),
)

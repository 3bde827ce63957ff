"""Optics: filter, lens and window."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.arc_map import Float32
from noise_model.condition import Condition
from noise_model.effects.effect import Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.frames import Float64
from noise_model.setup import Setup
from noise_model.spectrum import ArcSpectrum, laser_transmission, passed_continuum
from noise_model.view import View

CONTINUUM = ArcSpectrum(line_width_nm=0.0)

PROFILE_ANGLES = 64
"""Angles between which a filter's transmission is interpolated over the field."""


def half_diagonals(view: View) -> tuple[Float64, Float64]:
    """Return the pixels' places (...,) right of and below the image's middle, in half diagonals."""
    camera = view.setup.camera
    half = 0.5 * math.hypot(camera.width, camera.height)
    u = (view.uv_px[..., 0].astype(np.float64) - 0.5 * (camera.width - 1)) / half
    v = (view.uv_px[..., 1].astype(np.float64) - 0.5 * (camera.height - 1)) / half
    return u, v


def _veiling_glare(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    share = np.float32(values["share"])
    light.pass_through(lambda image: (1 - share) * image + share * view.mean(image))


def _defocus(setup: Setup, values: Values) -> Setup:
    camera = setup.camera
    return replace(
        setup, camera=replace(camera, psf_sigma_px=math.hypot(camera.psf_sigma_px, values["sigma_px"]))
    )


def _vignetting(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    u, v = half_diagonals(view)
    light.scale((1.0 - values["loss"] * (u**2 + v**2)).astype(np.float32))


def _dirty_window(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    u, v = half_diagonals(view)
    square = ((u - values["u"]) ** 2 + (v - values["v"]) ** 2) / values["radius"] ** 2
    patch = np.exp(-0.5 * square).astype(np.float32)
    dim, scatter = np.float32(values["dimming"]) * patch, np.float32(values["scatter"]) * patch

    def through(image: Float32) -> Float32:
        return (1 - dim) * image + scatter * view.mean(image)

    light.pass_through(through)


def _filter_shift(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    of_filter = view.setup.filter
    # lambda_theta depends on sin^2(theta) / n_eff^2 alone: a share of the shift is another index.
    share = values["shift_share"]
    if share == 0.0:
        return
    shifted = replace(of_filter, effective_index=1.0)
    sin = math.sqrt(share) / of_filter.effective_index * np.sin(view.theta)
    angle = np.arcsin(np.minimum(sin, 0.99))
    laser = laser_transmission(shifted, view.setup.laser.wavelength_nm, angle)
    light.laser = light.laser * laser.astype(np.float32)
    profile = np.linspace(0.0, float(angle.max(initial=0.0)), PROFILE_ANGLES)
    continuum = passed_continuum(shifted, CONTINUUM, profile)
    light.arc = light.arc * np.interp(angle, profile, continuum / continuum[0]).astype(np.float32)


EFFECTS = (
    Effect(
        id="filter_shift",
        stage=Stage.OPTICS,
        summary="the passband moves to shorter wavelengths off axis: the laser line dims towards the rim, "
        "the arc's continuum hardly",
        equation="laser' = laser T(lambda / s) / T(lambda), s = sqrt(1 - shift_share sin^2 theta / n_eff^2)",
        source="Smith, Modern Optical Engineering, ch. 11; 1 is the whole shift of the stated filter",
        parameters=(Parameter("shift_share", "", 0.0, 0.5, 0.0, 6.0, 0.01),),
        typical={"shift_share": 1.0},
        light=_filter_shift,
    ),
    Effect(
        id="vignetting",
        stage=Stage.OPTICS,
        summary="more fall-off than cos^4",
        equation="all light x (1 - loss rho^2), rho the distance from the image's middle in half diagonals",
        source="Kang and Weiss 2000 (ECCV): the geometric factor beside cos^4",
        parameters=(Parameter("loss", "", 0.0, 0.1, 0.0, 0.95, 0.002),),
        typical={"loss": 0.4},
        light=_vignetting,
    ),
    Effect(
        id="dirty_window",
        stage=Stage.OPTICS,
        summary="patches fixed in the image that dim and scatter",
        equation="all light x (1 - dimming g) + scatter g mean, g a Gaussian patch at (u, v) of 1 sigma "
        "radius, all in half diagonals from the image's middle",
        source="Gu, Ramamoorthi, Belhumeur and Nayar 2009 (ACM TOG 28(5), 144): attenuation and scatter maps "
        "of dirty lenses",
        parameters=(
            Parameter("u", "", 0.0, 0.5, -1.0, 1.0, 0.01),
            Parameter("v", "", 0.0, 0.4, -1.0, 1.0, 0.01),
            Parameter("radius", "", 0.2, 0.1, 0.02, 2.0, 0.01),
            Parameter("dimming", "", 0.0, 0.3, 0.0, 1.0, 0.005),
            Parameter("scatter", "", 0.0, 0.2, 0.0, 2.0, 0.005),
        ),
        typical={"u": -0.3, "v": 0.2, "radius": 0.15, "dimming": 0.5, "scatter": 0.1},
        light=_dirty_window,
    ),
    Effect(
        id="defocus",
        stage=Stage.OPTICS,
        summary="a wider point-spread function",
        equation="psf_sigma' = sqrt(psf_sigma^2 + sigma_px^2)",
        source="the blur disc of radius c has the variance c^2 / 4 along each axis; variances add",
        parameters=(Parameter("sigma_px", "px", 0.0, 1.0, 0.0, 20.0, 0.02),),
        typical={"sigma_px": 4.0},
        setup=_defocus,
    ),
    Effect(
        id="veiling_glare",
        stage=Stage.OPTICS,
        summary="a share of the scene's light spreads over the whole image",
        equation="E' = (1 - share) E + share mean(E)",
        source="ISO 9358: the veiling glare index; an even spread is its simplest form",
        parameters=(Parameter("share", "", 0.0, 0.05, 0.0, 0.9, 0.002),),
        typical={"share": 0.15},
        light=_veiling_glare,
    ),
)

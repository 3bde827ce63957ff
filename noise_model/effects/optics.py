"""Optics: filter, lens and window."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from noise_model.compiled.arrays import Float32, Float64
from noise_model.condition import Condition
from noise_model.effects.effect import UNSTATED, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.instrument.spectrum import (
    MIN_TRANSMISSION,
    ArcSpectrum,
    laser_transmission,
    over_field,
    passed_continuum,
)
from noise_model.setup import Setup
from noise_model.stripe import stripe_runs_along_rows
from noise_model.view import View

EVEN_SPREAD = 3.0
"""1 sigma, in half diagonals, from which glare is uniform."""

CONTINUUM = ArcSpectrum(line_width_nm=0.0)

PATCHES = (1, 2, 3)
"""Numbers of a window's patches."""


def half_diagonals(view: View, u_px: float, v_px: float) -> tuple[Float32, Float32]:
    """Return the pixels' places (...,) right of and below (u, v), px, in halves of the image's diagonal."""
    camera = view.setup.camera
    half = np.float32(0.5 * math.hypot(camera.width, camera.height))
    return (view.rays.uv_px[..., 0] - np.float32(u_px)) / half, (
        view.rays.uv_px[..., 1] - np.float32(v_px)
    ) / half


def _dirty_window(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    camera = view.setup.camera
    u, v = half_diagonals(view, 0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
    if view.is_frame:
        # A patch is a product of a row's and a column's factors.
        u, v = u[:1], v[:, :1]
    passed: Float32 = np.ones(1, dtype=np.float32)
    scattered: Float32 = np.zeros(1, dtype=np.float32)
    for n in PATCHES:
        dimming, scatter = np.float32(values[f"dimming_{n}"]), np.float32(values[f"scatter_{n}"])
        if dimming == 0.0 and scatter == 0.0:
            continue
        per_square = np.float32(-0.5 / values[f"radius_{n}"] ** 2)
        along_u, along_v = (u - np.float32(values[f"u_{n}"])) ** 2, (v - np.float32(values[f"v_{n}"])) ** 2
        patch = np.exp(per_square * along_u) * np.exp(per_square * along_v)
        # Most patches do but one of both.
        if dimming != 0.0:
            passed = np.asarray(passed * (1 - dimming * patch), dtype=np.float32)
        if scatter != 0.0:
            scattered = np.asarray(scattered + scatter * patch, dtype=np.float32)
    light.spread(passed, scattered, view.mean)


def incidence_on_filter(xy: Float32 | Float64, values: Values) -> Float64:
    """Return sin(theta) (...,) of rays (..., 2), (x, y, 1), on a filter that leans by `filter_shift`'s tilts.

    The filter's normal is the optical axis, leant to the right and down in the image.
    """
    right, down = (math.tan(math.radians(values[name])) for name in ("tilt_right_deg", "tilt_down_deg"))
    x, y = np.moveaxis(np.asarray(xy, dtype=np.float64), -1, 0)
    # |ray x normal|: a cosine would lose small angles.
    across = np.hypot(np.hypot(x - right, y - down), x * down - y * right)
    return np.asarray(across / np.sqrt((1.0 + x**2 + y**2) * (1.0 + right**2 + down**2)))


def _filter_shift(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    of_filter = view.setup.stated_filter
    # lambda_theta depends on sin^2(theta) / n_eff^2 alone: a share of the shift is another index.
    shifted = replace(of_filter, effective_index=1.0)
    per_sin = math.sqrt(values["shift_share"]) / of_filter.effective_index
    # The largest sin(theta) / n_eff: beyond no share of the shift goes.
    angle, on_axis = (
        np.arcsin(np.minimum(per_sin * incidence_on_filter(xy, values), 0.99))
        for xy in (view.rays.xy, np.zeros(2))
    )
    line_nm = view.setup.laser.wavelength_nm
    # A fit may try a filter that leans so far that no laser passes on the axis.
    laser_on_axis = np.maximum(laser_transmission(shifted, line_nm, on_axis), MIN_TRANSMISSION)
    laser = laser_transmission(shifted, line_nm, angle) / laser_on_axis
    # What is neither the laser's nor the arc's glows: a continuum like the arc's.
    of_continuum = over_field(lambda theta: passed_continuum(shifted, CONTINUUM, theta), angle)
    of_continuum /= passed_continuum(shifted, CONTINUUM, on_axis)
    light.scale(of_continuum.astype(np.float32))
    light.laser = light.laser * (laser / of_continuum).astype(np.float32)


def _vignetting(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    # About the optical axis, as cos^4 is.
    u, v = half_diagonals(view, view.setup.camera.cx, view.setup.camera.cy)
    square = u**2 + v**2
    lost = np.float32(values["loss"]) * square + np.float32(values["corner_loss"]) * square**2
    light.scale(np.maximum(1 - lost, 0))


def _defocus(setup: Setup, values: Values) -> Setup:
    camera = setup.camera
    return replace(
        setup, camera=replace(camera, psf_sigma_px=math.hypot(camera.psf_sigma_px, values["sigma_px"]))
    )


def wide_blur(image: Float32, sigma_px: float) -> Float32:
    """Convolve an image (H, W) with a wide Gaussian, the rim reflected: shrunk, convolved and enlarged."""
    # Pixels to a wide Gaussian's sigma after an image is shrunk for it.
    shrink = max(1.0, sigma_px / 8.0)
    height, width = image.shape
    size = max(1, round(width / shrink)), max(1, round(height / shrink))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    sigma_x, sigma_y = sigma_px * size[0] / width, sigma_px * size[1] / height
    for axis, sigma in ((1, sigma_x), (0, sigma_y)):
        small = gaussian_filter1d(small, sigma, axis=axis, mode="reflect")
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _veiling_glare(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    share = np.float32(values["share"])
    spread_px = values["spread"] * 0.5 * math.hypot(view.setup.camera.width, view.setup.camera.height)
    if values["spread"] >= EVEN_SPREAD or not view.is_frame:
        light.spread(np.float32(1) - share, share, view.mean)
    else:
        light.spread(np.float32(1) - share, share, lambda image: wide_blur(image, spread_px))


def _ghost_stripe(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if values["strength"] == 0.0 or not view.is_frame:
        return
    camera = view.setup.camera
    half_px = 0.5 * math.hypot(camera.width, camera.height)
    shift = [half_px * values["along"], half_px * values["across"]]
    u_px, v_px = shift if stripe_runs_along_rows(view.setup) else shift[::-1]
    moved = cv2.warpAffine(
        light.laser,
        np.array([[1.0, 0.0, u_px], [0.0, 1.0, v_px]]),
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0.0,
    )
    light.laser = light.laser + np.float32(values["strength"]) * moved.astype(np.float32)


EFFECTS = (
    Effect(
        id="dirty_window",
        stage=Stage.OPTICS,
        summary="patches fixed in the image that dim and scatter",
        equation="all light x product (1 - dimming g) + mean x sum scatter g over up to three patches, g a "
        "Gaussian of 1 sigma radius about (u, v): right of and below the image's middle, in half diagonals",
        source="Gu, Ramamoorthi, Belhumeur and Nayar 2009 (ACM TOG 28(5), 144): attenuation and scatter maps "
        "of dirty lenses, smooth because out of focus",
        parameters=tuple(
            parameter
            for n, (u, v) in zip(PATCHES, ((-0.4, -0.3), (0.4, -0.3), (0.0, 0.3)), strict=True)
            for parameter in (
                Parameter(f"u_{n}", "", u, 0.5, -1.0, 1.0, 0.01),
                Parameter(f"v_{n}", "", v, 0.4, -1.0, 1.0, 0.01),
                Parameter(f"radius_{n}", "", 0.2, 0.1, 0.02, 0.4, 0.01),
                Parameter(f"dimming_{n}", "", 0.0, 0.3, 0.0, 1.0, 0.005),
                Parameter(f"scatter_{n}", "", 0.0, 0.2, 0.0, 2.0, 0.005),
            )
        ),
        typical={"dimming_1": 0.5, "scatter_1": 0.1, "dimming_2": 0.3},
        light=_dirty_window,
        spreads=True,
    ),
    Effect(
        id="ghost_stripe",
        stage=Stage.OPTICS,
        summary="a second image of the stripe, from a window or a filter; or the laser on torch and fixture",
        equation="laser' = laser + strength laser displaced by (along, across) in the image, in half "
        "diagonals: along the axis that the stripe runs along, to the right or down, and across it",
        source="Murty 1964 (Appl. Opt. 3, 535): the two faces of a plane plate send two images, displaced. "
        "What mirrors the laser onto fixtures can make the second one the brighter",
        parameters=(
            Parameter("strength", "", 0.0, 0.3, 0.0, 10.0, 0.002),
            Parameter("along", "", 0.0, 0.3, -1.5, 1.5, 0.001),
            Parameter("across", "", 0.15, 0.3, -1.5, 1.5, 0.001),
        ),
        typical={"strength": 0.3, "along": 0.05, "across": 0.2},
        light=_ghost_stripe,
        form_rel=UNSTATED,
        spreads=True,
    ),
    Effect(
        id="filter_shift",
        stage=Stage.OPTICS,
        summary="the passband moves to shorter wavelengths off axis: the laser line dims towards the rim, "
        "the arc's continuum hardly",
        equation="laser' = laser T(lambda / s) over that on the axis, s = sqrt(1 - shift_share sin^2 theta / "
        "n_eff^2), theta from the filter's normal; arc' = arc integral B(lambda) T(lambda / s) d lambda over "
        "that on the axis",
        source="Smith, Modern Optical Engineering, ch. 11; 1 is the whole shift of the stated filter, which "
        "a mount holds within some degrees",
        parameters=(
            Parameter("shift_share", "", 0.0, 1.0, 0.0, 6.0, 0.01),
            Parameter("tilt_right_deg", "deg", 0.0, 3.0, -15.0, 15.0, 0.05),
            Parameter("tilt_down_deg", "deg", 0.0, 3.0, -15.0, 15.0, 0.05),
        ),
        typical={"shift_share": 1.0},
        light=_filter_shift,
        needs=("filter",),
    ),
    Effect(
        id="vignetting",
        stage=Stage.OPTICS,
        summary="more fall-off than cos^4",
        equation="all light x (1 - loss rho^2 - corner_loss rho^4), at least 0; rho the distance from the "
        "principal point in half diagonals",
        source="Goldman and Chen 2005 (ICCV): even powers of the radius; Kang and Weiss 2000 (ECCV) take "
        "1 - alpha r beside cos^4",
        parameters=(
            Parameter("loss", "", 0.0, 0.3, -0.5, 0.95, 0.002),
            Parameter("corner_loss", "", 0.0, 0.3, -0.5, 0.95, 0.002),
        ),
        typical={"loss": 0.4},
        light=_vignetting,
    ),
    Effect(
        id="defocus",
        stage=Stage.OPTICS,
        summary="a wider point-spread function",
        equation="psf_sigma' = sqrt(psf_sigma^2 + sigma_px^2)",
        source="the blur disc of radius c has the variance c^2 / 4 along each axis; variances add",
        parameters=(Parameter("sigma_px", "px", 0.0, 2.0, 0.0, 20.0, 0.1),),
        typical={"sigma_px": 4.0},
        setup=_defocus,
    ),
    Effect(
        id="veiling_glare",
        stage=Stage.OPTICS,
        summary="a share of the scene's light spreads over the whole image",
        equation="E' = (1 - share) E + share (E convolved with a Gaussian of 1 sigma spread, in half "
        "diagonals, the rim reflected); from spread 3 on share mean(E)",
        source="ISO 9358: the veiling glare index; McCann and Rizzi 2007 (J. SID 15(9), 721): glare falls "
        "off from its source. Some pixels alone take their even mean",
        parameters=(
            Parameter("share", "", 0.0, 0.1, 0.0, 0.9, 0.002),
            Parameter("spread", "", EVEN_SPREAD, 2.0, 0.1, 5.0, 0.02),
        ),
        typical={"share": 0.15},
        light=_veiling_glare,
        spreads=True,
    ),
)

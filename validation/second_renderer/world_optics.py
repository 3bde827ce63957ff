"""Hidden effects of the optics: window, filter, lens."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.constants import Boltzmann, Planck, speed_of_light
from scipy.ndimage import affine_transform, gaussian_filter
from scipy.signal import fftconvolve

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    CATALOGUE,
    EffectForm,
    Generator,
    Values,
    WorldFrameLight,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_light import pixel_grid
from validation.second_renderer.world_source import EDGE_NM, edge_transmission, filter_angle_shift

MAX_PATCHES = 3

ARC_K = 12_000.0
"""The temperature whose black body the arc's continuum is like."""


def point_spread(image: Float64, sigma_px: float) -> Float64:
    """Convolve an image (H, W) with the stated Gaussian, the rim continued evenly."""
    return np.asarray(gaussian_filter(image, sigma_px, mode="nearest", truncate=6.0))


def half_diagonals(frame: WorldFrameLight) -> tuple[Float64, Float64]:
    """Return pixels' places right of and below the image's middle, both (H, W), in half diagonals."""
    u, v = pixel_grid(frame.sight.camera)
    height, width = frame.sight.shape
    half = 0.5 * math.hypot(width, height)
    return (u - 0.5 * (width - 1.0)) / half, (v - 0.5 * (height - 1.0)) / half


def _draw_glare(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.02, 0.2)}


def _even_glare(frame: WorldFrameLight, p: Values) -> None:
    frame.through(lambda image: (1.0 - p["share"]) * image + p["share"] * image.mean())


def _draw_falling_glare(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.04, 0.25), "core_px": draw.uniform(20.0, 120.0)}


def _falling_glare(frame: WorldFrameLight, p: Values) -> None:
    height, width = frame.sight.shape
    v, u = np.mgrid[1 - height : height, 1 - width : width]
    tail = 1.0 / (1.0 + (u**2 + v**2) / p["core_px"] ** 2)
    tail /= tail.sum()
    frame.through(
        lambda image: (
            (1.0 - p["share"]) * image
            + (p["share"] * fftconvolve(image, tail, mode="same") if image.any() else 0.0)
        )
    )


def _draw_defocus(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"sigma_px": magnitude(strength, 1.0, 4.0)}


def _gaussian_defocus(frame: WorldFrameLight, p: Values) -> None:
    frame.through(lambda image: point_spread(image, p["sigma_px"]))


def _draw_disc(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"radius_px": magnitude(strength, 2.0, 8.0)}


def _disc_defocus(frame: WorldFrameLight, p: Values) -> None:
    reach = math.ceil(p["radius_px"]) + 1
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    # The rim pixel by pixel: a disc cut to whole pixels would have steps in its radius.
    disc = np.clip(p["radius_px"] + 0.5 - np.hypot(u, v), 0.0, 1.0)
    disc /= disc.sum()

    def blurred(image: Float64) -> Float64:
        return np.asarray(fftconvolve(np.pad(image, reach, mode="edge"), disc, mode="valid"))

    frame.through(blurred)


def _draw_vignetting(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"loss": magnitude(strength, 0.06, 0.5)}


def _round_vignetting(frame: WorldFrameLight, p: Values) -> None:
    frame.scale(1.0 - p["loss"] * frame.sight.radius**2)


def _cosine_vignetting(frame: WorldFrameLight, p: Values) -> None:
    cos_corner = float(np.cos(frame.sight.theta).min())
    power = math.log(1.0 - p["loss"]) / math.log(cos_corner)
    frame.scale(np.cos(frame.sight.theta) ** power)


def _hard_vignetting(frame: WorldFrameLight, p: Values) -> None:
    # A stop beyond the lens cuts the corners: nothing is lost up to 0.6, then evenly more.
    frame.scale(1.0 - p["loss"] * np.clip((frame.sight.radius - 0.6) / 0.4, 0.0, 1.0))


def _draw_dirt(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "patches": float(draw.integers(1, MAX_PATCHES + 1)),
        "dimming": magnitude(strength, 0.05, 0.5),
        "scatter": magnitude(strength, 0.005, 0.1),
        "radius": draw.uniform(0.12, 0.28),
        "seed": drawn_seed(draw),
    }


def _smears(frame: WorldFrameLight, p: Values) -> list[Float64]:
    u, v = half_diagonals(frame)
    draw = np.random.default_rng(int(p["seed"]))
    places = draw.uniform([-0.6, -0.45, 0.7], [0.6, 0.45, 1.4], (int(p["patches"]), 3))
    return [np.hypot(u - x, v - y) / (size * p["radius"]) for x, y, size in places]


def dim_and_scatter(frame: WorldFrameLight, p: Values, patches: list[Float64]) -> None:
    """Let patches (H, W) of the window, 1 at their thickest, dim the light and scatter its mean."""
    passed, veil = np.ones(frame.sight.shape), np.zeros(frame.sight.shape)
    for patch in patches:
        passed *= 1.0 - p["dimming"] * patch
        veil += p["scatter"] * patch
    frame.through(lambda image: passed * image + veil * image.mean())


def _round_dirt(frame: WorldFrameLight, p: Values) -> None:
    dim_and_scatter(frame, p, [np.exp(-0.5 * r**2) for r in _smears(frame, p)])


def _droplets(frame: WorldFrameLight, p: Values) -> None:
    dim_and_scatter(frame, p, [0.5 - 0.5 * np.tanh((r - 1.0) / 0.15) for r in _smears(frame, p)])


def _fingerprint(frame: WorldFrameLight, p: Values) -> None:
    # Ridges of a finger within a soft disc.
    dim_and_scatter(
        frame,
        p,
        [(0.6 + 0.4 * np.cos(18.0 * r)) / (1.0 + np.exp((r - 1.2) / 0.12)) for r in _smears(frame, p)],
    )


def _draw_shift(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.8, 3.0)}


def shift_passband(
    frame: WorldFrameLight, shift: Float64, passed: Callable[[Float64], Float64], band_nm: Float64
) -> None:
    """Let the laser's line, and a continuum like the arc's, through a passband that shifts off the axis.

    `shift` (H, W) is lambda_0 / lambda_theta, `passed` the transmission at normal incidence, `band_nm` (n,)
    even wavelengths over all that passes.
    """
    line_nm = frame.studio.world.setup.laser.wavelength_nm
    frame.laser = frame.laser * passed(line_nm * shift) / passed(np.array(line_nm))

    def through(s: float) -> float:
        # What is seen at u off the axis is u / s of the light.
        return float(np.sum(_black_body(band_nm / s) * passed(band_nm)) / s)

    shifts = np.linspace(1.0, float(shift.max()), 33)
    of_continuum = np.interp(shift, shifts, [through(float(s)) / through(1.0) for s in shifts])
    frame.arc, frame.other = frame.arc * of_continuum, frame.other * of_continuum


def _black_body(wavelength_nm: Float64) -> Float64:
    """Return Planck's radiance at ARC_K over wavelength, up to a factor."""
    scale_nm = 1e9 * Planck * speed_of_light / (Boltzmann * ARC_K)
    return np.asarray(wavelength_nm**-5.0 / np.expm1(scale_nm / wavelength_nm))


def _gaussian_shift(frame: WorldFrameLight, p: Values) -> None:
    stated = frame.studio.world.setup.stated_filter
    per_nm2 = 4.0 * math.log(2.0) / stated.fwhm_nm**2
    band_nm = stated.center_nm + stated.fwhm_nm * np.linspace(-3.0, 3.0, 601)
    shift = filter_angle_shift(frame, p["share"])
    shift_passband(frame, shift, lambda nm: np.exp(-per_nm2 * (nm - stated.center_nm) ** 2), band_nm)


def _draw_edge_shift(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.8, 3.0)}


def _edge_shift(frame: WorldFrameLight, p: Values) -> None:
    shift = filter_angle_shift(frame, p["share"])
    shift_passband(frame, shift, edge_transmission, np.linspace(EDGE_NM[0], EDGE_NM[-1], 601))


def _draw_ghost(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "share": magnitude(strength, 0.03, 0.8),
        "down_px": setup.camera.height * signed(draw, draw.uniform(0.07, 0.23)),
        "right_px": setup.camera.width * draw.uniform(-0.05, 0.05),
    }


def _draw_blurred_ghost(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        **_draw_ghost(draw, strength, setup),
        "share": magnitude(strength, 0.06, 2.0),
        "blur_px": draw.uniform(1.0, 6.0),
        "turn_deg": draw.uniform(-2.0, 2.0),
    }


def _displaced(image: Float64, p: Values, turn_deg: float = 0.0) -> Float64:
    """Return an image moved right and down, and turned about its middle; dark beyond its rim."""
    middle, move = 0.5 * (np.array(image.shape) - 1.0), np.array([p["down_px"], p["right_px"]])
    angle = math.radians(turn_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    offset = middle - turn @ (middle + move)
    return np.asarray(affine_transform(image, turn, offset, order=3, mode="constant", prefilter=True))


def _ghost(frame: WorldFrameLight, p: Values) -> None:
    frame.laser = frame.laser + p["share"] * np.maximum(_displaced(frame.laser, p), 0.0)


def _blurred_ghost(frame: WorldFrameLight, p: Values) -> None:
    ghost = point_spread(np.maximum(_displaced(frame.laser, p, p["turn_deg"]), 0.0), p["blur_px"])
    frame.laser = frame.laser + p["share"] * ghost


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "dirty_window": (
        EffectForm(
            CATALOGUE, "Gaussian patches that dim and scatter the mean", _draw_dirt, light=_round_dirt
        ),
        EffectForm("droplets", "discs with soft edges", _draw_dirt, light=_droplets),
        EffectForm("fingerprint", "ridges within a soft disc", _draw_dirt, light=_fingerprint),
    ),
    "ghost_stripe": (
        EffectForm(CATALOGUE, "laser + share laser, moved by (right_px, down_px)", _draw_ghost, light=_ghost),
        EffectForm(
            "blurred",
            "the same turned by turn_deg and blurred by blur_px",
            _draw_blurred_ghost,
            light=_blurred_ghost,
        ),
    ),
    "filter_shift": (
        EffectForm(
            CATALOGUE,
            "laser x T(690 nm s) / T(690 nm), continuum x int B(l) T(l s) dl over that on axis, a Gaussian "
            "passband, share of the shift",
            _draw_shift,
            light=_gaussian_shift,
        ),
        EffectForm(
            "edge", "the same with a real filter's flat top and edge", _draw_edge_shift, light=_edge_shift
        ),
    ),
    "vignetting": (
        EffectForm(CATALOGUE, "all x (1 - loss rho^2)", _draw_vignetting, light=_round_vignetting),
        EffectForm(
            "cosine", "all x cos^n(theta), 1 - loss in the corner", _draw_vignetting, light=_cosine_vignetting
        ),
        EffectForm(
            "hard", "1 up to rho = 0.6, then falling evenly by loss", _draw_vignetting, light=_hard_vignetting
        ),
    ),
    "veiling_glare": (
        EffectForm(CATALOGUE, "(1 - share) E + share mean(E)", _draw_glare, light=_even_glare),
        EffectForm(
            "falling",
            "share E convolved with 1 / (1 + r^2 / core^2)",
            _draw_falling_glare,
            light=_falling_glare,
        ),
    ),
    "defocus": (
        EffectForm(CATALOGUE, "a Gaussian of sigma_px more", _draw_defocus, light=_gaussian_defocus),
        EffectForm("disc", "an evenly lit disc of radius_px", _draw_disc, light=_disc_defocus),
    ),
}

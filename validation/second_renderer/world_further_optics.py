"""Further forms of effects of medium and optics, which no judgement was tuned on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy.ndimage import affine_transform
from scipy.optimize import brentq
from scipy.signal import fftconvolve

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
from validation.second_renderer.world_effect import (
    EffectForm,
    Generator,
    Values,
    WorldFrameLight,
    direction,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_further_source import two_cavity
from validation.second_renderer.world_light import pixel_grid
from validation.second_renderer.world_medium import (
    add_dots,
    add_glow,
    draw_fume,
    draw_spatter,
    fill_with_fume,
)
from validation.second_renderer.world_optics import (
    dim_and_scatter,
    half_diagonals,
    point_spread,
    shift_passband,
)


def _draw_layer(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"scale_mm": draw.uniform(15.0, 40.0), **draw_fume(draw, strength, setup)}


def _layer(frame: WorldFrameLight, p: Values) -> None:
    # As much of it in all as even fume has up to 100 mm.
    fill_with_fume(
        frame,
        p,
        lambda points, r: 100.0 / p["scale_mm"] * np.exp(-np.maximum(points[:, 2], 0.0) / p["scale_mm"]),
    )


def _radial_spatter(frame: WorldFrameLight, p: Values) -> None:
    """Draw streaks that fly away from the arc and cool."""
    if frame.moment.arc_level == 0.0:
        return
    height, width = frame.sight.shape
    camera, image = frame.sight.camera, np.zeros((height, width))
    eye = invert(frame.sight.T_joint_tool @ camera.T_tool_camera)
    x, y, z = transform(eye, frame.body.center_mm)
    arc_u, arc_v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    t = np.arange(0.0, p["length_px"])
    fading = (1.0 + t / p["length_px"]) ** -4.0
    for _ in range(frame.draw.poisson(p["rate_per_frame"])):
        u, v = frame.draw.uniform(0.0, width), frame.draw.uniform(0.0, height)
        angle = math.atan2(v - arc_v, u - arc_u)
        bright = 2.0 * frame.draw.exponential(p["peak_e"]) * fading
        add_dots(image, u + math.cos(angle) * t, v + math.sin(angle) * t, bright, p["width_px"])
    frame.other = frame.other + image


def _draw_two_zones(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "brightest_e": magnitude(strength, 350.0, 5000.0),
        "length_mm": draw.uniform(3.0, 8.0),
        "outer_share": draw.uniform(0.15, 0.5),
        "outer_length_mm": draw.uniform(15.0, 40.0),
    }


def _two_zones(frame: WorldFrameLight, p: Values) -> None:
    # The shares are those where the image comes nearest to the arc, about 15 mm from it.
    def fall(rho: Float64) -> Float64:
        beyond = rho - 15.0
        inner = (1.0 - p["outer_share"]) * np.exp(-beyond / p["length_mm"])
        return np.asarray(inner + p["outer_share"] * np.exp(-beyond / p["outer_length_mm"]))

    add_glow(frame, p, fall)


def _draw_scratches(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "scratches": float(draw.integers(2, 6)),
        "dimming": magnitude(strength, 0.1, 0.7),
        "scatter": magnitude(strength, 0.01, 0.15),
        "width": draw.uniform(0.012, 0.035),
        "seed": drawn_seed(draw),
    }


def _scratches(frame: WorldFrameLight, p: Values) -> None:
    u, v = half_diagonals(frame)
    draw = np.random.default_rng(int(p["seed"]))
    lines = []
    for _ in range(int(p["scratches"])):
        x, y, angle = draw.uniform(-0.6, 0.6), draw.uniform(-0.4, 0.4), draw.uniform(0.0, math.pi)
        half_length = draw.uniform(0.15, 0.5)
        along = (u - x) * math.cos(angle) + (v - y) * math.sin(angle)
        across = (v - y) * math.cos(angle) - (u - x) * math.sin(angle)
        past = np.maximum(np.abs(along) - half_length, 0.0)
        lines.append(np.exp(-0.5 * (across**2 + past**2) / p["width"] ** 2))
    dim_and_scatter(frame, p, lines)


def _draw_scaled_ghost(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "share": magnitude(strength, 0.04, 1.0),
        "magnification": signed(
            draw, draw.uniform(0.6, 0.85) if draw.random() < 0.5 else draw.uniform(1.2, 1.6)
        ),
        "down_px": setup.camera.height * signed(draw, draw.uniform(0.1, 0.25)),
        "blur_px": draw.uniform(0.5, 3.0),
    }


def _scaled_ghost(frame: WorldFrameLight, p: Values) -> None:
    camera, scale = frame.sight.camera, 1.0 / p["magnification"]
    axis, move = np.array([camera.cy, camera.cx]), np.array([p["down_px"], 0.0])
    offset = axis - scale * (axis + move)
    image = affine_transform(frame.laser, np.diag([scale, scale]), offset, order=1, mode="constant")
    frame.laser = frame.laser + p["share"] * point_spread(np.maximum(image, 0.0), p["blur_px"])


def _draw_tilted_filter(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    right, down = direction(draw, draw.uniform(1.0, 3.0))
    return {"share": magnitude(strength, 1.0, 3.0), "right_deg": right, "down_deg": down}


def _tilted_filter(frame: WorldFrameLight, p: Values) -> None:
    camera, stated = frame.sight.camera, frame.studio.world.setup.stated_filter
    u, v = pixel_grid(camera)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)])
    normal = np.array([math.tan(math.radians(p["right_deg"])), math.tan(math.radians(p["down_deg"])), 1.0])
    cosine = np.tensordot(normal / np.linalg.norm(normal), rays / np.linalg.norm(rays, axis=0), 1)
    sin2 = np.maximum(1.0 - cosine**2, 0.0)
    shift = 1.0 / np.sqrt(1.0 - p["share"] * sin2 / stated.effective_index**2)
    band_nm = stated.center_nm + stated.fwhm_nm * np.linspace(-4.0, 4.0, 801)
    shift_passband(frame, shift, partial(two_cavity, stated), band_nm)


def _draw_vignetting(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"loss": magnitude(strength, 0.06, 0.5)}


def _overlap(apart: Float64) -> Float64:
    """Return the share that two discs have in common whose middles are `apart` (...,) in their radii."""
    half = np.clip(0.5 * apart, 0.0, 1.0)
    return np.asarray(2.0 / math.pi * (np.arccos(half) - half * np.sqrt(1.0 - half**2)))


def _cats_eye(frame: WorldFrameLight, p: Values) -> None:
    lost = brentq(lambda apart: float(_overlap(np.array(apart))) - (1.0 - p["loss"]), 0.0, 2.0)
    slope = np.tan(frame.sight.theta)
    frame.scale(_overlap(lost * slope / slope.max()))


def _draw_two_exponentials(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    near = draw.uniform(0.03, 0.08) * setup.camera.width
    return {
        "share": magnitude(strength, 0.03, 0.25),
        "near_px": near,
        "far_px": near * draw.uniform(4.0, 8.0),
        "far_share": draw.uniform(0.4, 0.8),
    }


def _two_exponentials(frame: WorldFrameLight, p: Values) -> None:
    height, width = frame.sight.shape
    v, u = np.mgrid[1 - height : height, 1 - width : width]
    r = np.hypot(u, v)
    near, far = np.exp(-r / p["near_px"]), np.exp(-r / p["far_px"])
    tail = (1.0 - p["far_share"]) * near / near.sum() + p["far_share"] * far / far.sum()

    def scattered(image: Float64) -> Float64:
        if not image.any():
            return image
        spread = np.maximum(fftconvolve(image, tail, mode="same"), 0.0)
        return np.asarray((1.0 - p["share"]) * image + p["share"] * spread)

    frame.through(scattered)


def _draw_ring(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"radius_px": magnitude(strength, 1.6, 6.5), "inner": draw.uniform(0.4, 0.7)}


def _ring(frame: WorldFrameLight, p: Values) -> None:
    reach = math.ceil(p["radius_px"]) + 1
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    r = np.hypot(u, v)
    ring = np.clip(p["radius_px"] + 0.5 - r, 0.0, 1.0) - np.clip(
        p["inner"] * p["radius_px"] + 0.5 - r, 0.0, 1.0
    )
    ring /= ring.sum()

    def blurred(image: Float64) -> Float64:
        return np.asarray(fftconvolve(np.pad(image, reach, mode="edge"), ring, mode="valid"))

    frame.through(blurred)


FORMS: Mapping[str, EffectForm] = {
    "fume": EffectForm(
        "layer",
        "even fume's with beta 100 mm / scale_mm exp(-z / scale_mm): a layer that lies on the plate "
        "(the barometric law's shape)",
        _draw_layer,
        light=_layer,
    ),
    "spatter": EffectForm(
        "radial",
        "streaks away from the arc, fading with the fourth power of their temperature (Stefan 1879)",
        draw_spatter,
        light=_radial_spatter,
    ),
    "hot_metal_glow": EffectForm(
        "two_zones",
        "(1 - outer_share) exp(-rho / length_mm) + outer_share exp(-rho / outer_length_mm): a pool's rim and "
        "the zone that it heats (Rosenthal 1946, Trans. ASME 68, 849)",
        _draw_two_zones,
        light=_two_zones,
    ),
    "dirty_window": EffectForm(
        "scratches",
        "scratches of a width, half diagonals, that dim and scatter the mean (ISO 10110-7)",
        _draw_scratches,
        light=_scratches,
    ),
    "ghost_stripe": EffectForm(
        "scaled",
        "laser + share laser, magnified about the axis, moved by down_px and blurred by blur_px: reflected "
        "between two lenses (Smith, Modern Optical Engineering)",
        _draw_scaled_ghost,
        light=_scaled_ghost,
    ),
    "filter_shift": EffectForm(
        "tilted",
        "the same with the angle to a filter tilted by (right_deg, down_deg), T = 1 / (1 + (2 (l - l0) / "
        "fwhm)^4): two cavities (Macleod, Thin-Film Optical Filters)",
        _draw_tilted_filter,
        light=_tilted_filter,
    ),
    "vignetting": EffectForm(
        "cats_eye",
        "all x the overlap of two discs, apart as tan(theta), 1 - loss in the corner (Kingslake, Optics in "
        "Photography: mechanical vignetting)",
        _draw_vignetting,
        light=_cats_eye,
    ),
    "veiling_glare": EffectForm(
        "two_exponentials",
        "(1 - share) E + share E convolved with two exponentials (Talvala et al. 2007, SIGGRAPH, 37: glare "
        "spread functions)",
        _draw_two_exponentials,
        light=_two_exponentials,
    ),
    "defocus": EffectForm(
        "ring",
        "a ring from inner radius_px to radius_px: a focus with spherical aberration (Smith, Modern Optical "
        "Engineering)",
        _draw_ring,
        light=_ring,
    ),
}

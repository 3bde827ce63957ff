"""Medium: what is in the air between part and camera, and what glows by itself."""

from __future__ import annotations

import math

import numpy as np
from scipy import constants
from scipy.special import ndtr

from noise_model.arc_map import Float32
from noise_model.condition import Condition
from noise_model.effects.effect import Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.frames import Float64
from noise_model.view import View

MELTING_K = 1800.0
"""Where the glow's radius is taken: steel melts between 1670 and 1810 K."""


def airlight_integral(
    origin_mm: Float64, direction: Float64, length_mm: Float64, source_mm: Float64
) -> Float64:
    """Return integral dt / r^2 (...,), 1/mm, along rays from `origin_mm` (3,) over `length_mm` (...,).

    r is the distance of the ray's point from `source_mm` (3,); `direction` (..., 3) are unit vectors. With D
    the ray's closest distance and t_0 where, it is (atan((l - t_0) / D) + atan(t_0 / D)) / D: single
    scattering of a point source in thin haze (Sun, Ramamoorthi, Narasimhan and Nayar 2005, without the
    attenuation along the way).
    """
    towards = source_mm - origin_mm
    t_0 = direction @ towards
    D = np.sqrt(np.maximum(towards @ towards - t_0**2, 1e-12))
    return np.asarray((np.arctan((length_mm - t_0) / D) + np.arctan(t_0 / D)) / D)


def _fume(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    beta = values["extinction_per_m"] * 1e-3
    where, arc = view.scene, view.setup.arc
    # Where nothing is met the air goes on as far as the camera's working distance.
    camera = where.T_joint_camera[:3, 3]
    length = np.nan_to_num(view.distance_mm, nan=float(np.linalg.norm(camera)))
    passed = np.exp(-beta * length)
    light.laser = light.laser * passed.astype(np.float32)
    light.other = light.other * passed.astype(np.float32)
    arc_e = light.arc * passed
    if condition.arc_level > 0.0:
        rays = np.concatenate([view.xy, np.ones((*view.shape, 1), dtype=np.float32)], axis=-1)
        direction = rays.astype(np.float64) @ where.T_joint_camera[:3, :3].T
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        to_camera = (camera - where.center_mm) / np.linalg.norm(camera - where.center_mm)
        # The luminous half's projected area towards the air before the camera, as in arc.apparent_area.
        area = 0.5 * math.pi * arc.radius_mm**2 * (1.0 + to_camera[2])
        along = airlight_integral(camera, direction, length, where.center_mm)
        scattered = values["scatter"] * beta / (4.0 * math.pi) * area * along
        arc_e = arc_e + condition.arc_level * arc.radiance_e * view.cos4 * scattered
    light.arc = arc_e.astype(np.float32)


def streak_moments(length_px: float, width_px: float) -> tuple[float, float]:
    """Return the integrals of g and of g^2, px^2, of a streak of peak 1.

    g is a Gaussian of 1 sigma `width_px` across, and the same Gaussian drawn over `length_px` along:
    g = exp(-y^2 / 2 w^2) * (Phi((x + l/2) / w) - Phi((x - l/2) / w)).
    """
    w, length = width_px, length_px
    # The box of length l convolved with a Gaussian has the integral l; its square the one below.
    along = length * math.erf(length / (2.0 * w)) - 2.0 * w / math.sqrt(math.pi) * (
        1.0 - math.exp(-(length**2) / (4.0 * w**2))
    )
    return length * w * math.sqrt(2.0 * math.pi), along * w * math.sqrt(math.pi)


def _spatter(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if condition.arc_level == 0.0:
        return
    camera = view.setup.camera
    rate, peak_e = values["rate_per_frame"], values["peak_e"]
    length, width = values["length_px"], values["width_px"]
    if draw is None:
        first, second = streak_moments(length, width)
        density = rate / (camera.width * camera.height)
        # Campbell's theorem; the peaks are exponential, so their mean square is 2 peak_e^2.
        light.other = light.other + np.float32(density * peak_e * first)
        light.variance_e2 = light.variance_e2 + np.float32(density * 2.0 * peak_e**2 * second)
        return
    for _ in range(int(draw.poisson(rate))):
        u, v = draw.uniform(0.0, camera.width), draw.uniform(0.0, camera.height)
        angle, peak = draw.uniform(0.0, math.pi), draw.exponential(peak_e)
        light.other = light.other + np.float32(peak) * _streak(view.uv_px, u, v, angle, length, width)


def _streak(uv_px: Float32, u: float, v: float, angle: float, length: float, width: float) -> Float32:
    along = (uv_px[..., 0] - u) * math.cos(angle) + (uv_px[..., 1] - v) * math.sin(angle)
    across = (uv_px[..., 1] - v) * math.cos(angle) - (uv_px[..., 0] - u) * math.sin(angle)
    box = ndtr((along + 0.5 * length) / width) - ndtr((along - 0.5 * length) / width)
    return np.asarray(box * np.exp(-0.5 * (across / width) ** 2), dtype=np.float32)


def _hot_metal_glow(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if condition.arc_level == 0.0:
        return
    points, _, _ = view.surface
    rho = np.linalg.norm((points - view.scene.center_mm)[..., :2], axis=-1)
    lift = second_radiation_nm_k() / (view.setup.laser.wavelength_nm * MELTING_K)
    hot = np.exp(-lift * np.maximum(rho / values["radius_mm"] - 1.0, 0.0))
    light.other = light.other + (values["peak_e"] * view.cos4 * np.nan_to_num(hot)).astype(np.float32)


def second_radiation_nm_k() -> float:
    """Return h c / k, nm K."""
    return float(1e9 * constants.h * constants.c / constants.k)


EFFECTS = (
    Effect(
        id="fume",
        stage=Stage.MEDIUM,
        summary="welding fume dims what passes it and scatters the arc's light",
        equation="all light x exp(-beta d), d from part to camera; arc += radiance scatter beta / (4 pi) "
        "A_eff integral dt / r^2 along the ray, scatter the fume's albedo in the relative units of kappa",
        source="Sun, Ramamoorthi, Narasimhan and Nayar 2005 (ACM TOG 24(3), 1040): single scattering, here "
        "thin; A_eff as in Eq. 15",
        parameters=(
            Parameter("extinction_per_m", "1/m", 0.0, 1.0, 0.0, 20.0, 0.01),
            Parameter("scatter", "", 0.05, 0.05, 0.0, 3.0, 0.001),
        ),
        typical={"extinction_per_m": 2.0, "scatter": 0.05},
        light=_fume,
    ),
    Effect(
        id="spatter",
        stage=Stage.MEDIUM,
        summary="bright streaks in single frames",
        equation="a Poisson number of streaks a frame, uniform in place and direction, exponential in peak: "
        "mean and variance by Campbell's theorem",
        source="Campbell 1909; Rice 1944, Bell Syst. Tech. J. 23, 282",
        parameters=(
            Parameter("rate_per_frame", "", 0.0, 5.0, 0.0, 200.0, 0.1),
            Parameter("peak_e", "e-", 10_000.0, 10_000.0, 0.0, 1e6, 100.0),
            Parameter("length_px", "px", 40.0, 30.0, 0.1, 600.0, 1.0),
            Parameter("width_px", "px", 2.0, 1.0, 0.5, 20.0, 0.1),
        ),
        typical={"rate_per_frame": 8.0},
        light=_spatter,
    ),
    Effect(
        id="hot_metal_glow",
        stage=Stage.MEDIUM,
        summary="thermal emission near the arc, whatever the current and the viewing angle",
        equation="other += peak_e cos^4 exp(-h c / (lambda k T_m) (rho / radius_mm - 1)) beyond radius_mm "
        "from the arc, T = T_m radius_mm / rho; peak_e within",
        source="Rosenthal 1946: T ~ 1 / rho round a point source at rest on a plate; Wien's law at the "
        "laser's wavelength, T_m = 1800 K",
        parameters=(
            Parameter("peak_e", "e-", 0.0, 5000.0, 0.0, 1e6, 20.0),
            Parameter("radius_mm", "mm", 15.0, 10.0, 1.0, 80.0, 0.1),
        ),
        typical={"peak_e": 6000.0, "radius_mm": 25.0},
        light=_hot_metal_glow,
    ),
)

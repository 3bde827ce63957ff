"""Medium: what glows by itself, and what is in the air between part and camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from noise_model.compiled.arrays import Float32, Float64
from noise_model.condition import Condition
from noise_model.effects.effect import UNSTATED, Draw, Effect, Stage, Values
from noise_model.effects.light import Light
from noise_model.fit import Parameter
from noise_model.transforms import invert, transform
from noise_model.view import View

STREAK_REACH = 5.0
"""Half-width of a drawn streak, in its widths: it has fallen to 4e-6 there."""


def airlight_integral(
    origin_mm: Float64, direction: Float64, length_mm: Float64, source_mm: Float64, radius_mm: float
) -> Float64:
    """Return integral dt / r^2 (...,), 1/mm, along rays from `origin_mm` (3,) over `length_mm` (...,).

    r is the distance of the ray's point from `source_mm` (3,); `direction` (..., 3) are unit vectors. With D
    the ray's closest distance and t_0 where, it is (atan((l - t_0) / D) + atan(t_0 / D)) / D: single
    scattering of a point source in thin haze (Sun, Ramamoorthi, Narasimhan and Nayar 2005, without the
    attenuation along the way). D is held at the source's `radius_mm`: there is no haze within.
    """
    t_0, square = _nearest(origin_mm, direction, source_mm)
    return _fall_off(length_mm, t_0, np.sqrt(np.maximum(square, radius_mm**2)))


def _nearest(origin_mm: Float64, direction: Float64, source_mm: Float64) -> tuple[Float64, Float64]:
    """Return the place along rays (..., 3) nearest to a source, mm, and the square of its distance there."""
    towards = source_mm - origin_mm
    t_0 = direction @ towards
    return t_0, towards @ towards - t_0**2


def _fall_off(length_mm: Float64, t_0: Float64, a: Float64) -> Float64:
    """Return integral dt / (a^2 + (t - t_0)^2) (...,), 1/mm, from 0 to a length."""
    return np.asarray((np.arctan((length_mm - t_0) / a) + np.arctan(t_0 / a)) / a)


def gathered_depth_mm(
    origin_mm: Float64,
    direction: Float64,
    length_mm: Float64,
    source_mm: Float64,
    gathered_per_mm: float,
    radius_mm: float = 0.0,
) -> Float64:
    """Return integral dt / (1 + g^2 r^2) (...,), mm, along the rays of `airlight_integral`.

    So fume thins out that is gathered about the arc, r from it. With a^2 = 1/g^2 + D^2 it is
    (atan((l - t_0) / a) + atan(t_0 / a)) / (g^2 a), and the length itself for even fume, g = 0. D is held at
    a `radius_mm`.
    """
    if gathered_per_mm == 0.0:
        return length_mm
    t_0, square = _nearest(origin_mm, direction, source_mm)
    a = np.sqrt(1.0 / gathered_per_mm**2 + np.maximum(square, radius_mm**2))
    return _fall_off(length_mm, t_0, a) / gathered_per_mm**2


def _fume(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    beta, gathered = values["extinction_per_m"] * 1e-3, values["gathered_per_mm"]
    light.scale(np.exp(-beta * _fume_depth_mm(view, gathered, 0.0)).astype(np.float32))
    if condition.arc_level > 0.0:
        # What one unit of albedo and of extinction, 1/mm, scatters into the pixels of a unit of radiance.
        even = view.cached("fume_airlight", lambda: _airlight(view))
        # 1 / (r^2 (1 + g^2 r^2)) = 1 / r^2 - g^2 / (1 + g^2 r^2), both of the same r.
        along = even - gathered**2 * _fume_depth_mm(view, gathered, view.setup.arc.radius_mm)
        unit = view.rays.cos4 * (_seen_area_mm2(view) / (4.0 * math.pi) * along).astype(np.float32)
        scattered = condition.arc_level * view.setup.arc.radiance_e * values["scatter"] * beta
        light.arc = light.arc + np.float32(scattered) * unit


def _fume_depth_mm(view: View, gathered_per_mm: float, radius_mm: float) -> Float64:
    where = view.scene
    camera = where.T_joint_camera[:3, 3]
    return gathered_depth_mm(
        camera, view.directions, _air_mm(view), where.center_mm, gathered_per_mm, radius_mm
    )


def _air_mm(view: View) -> Float64:
    return view.cached("air", lambda: _way_mm(view))


def _way_mm(view: View) -> Float64:
    # Where nothing is met the air goes on as far as the arc is from the camera.
    where = view.scene
    to_arc = float(np.linalg.norm(where.center_mm - where.T_joint_camera[:3, 3]))
    return np.nan_to_num(view.distance_mm, nan=to_arc)


def _airlight(view: View) -> Float64:
    where = view.scene
    camera, radius = where.T_joint_camera[:3, 3], view.setup.arc.radius_mm
    return airlight_integral(camera, view.directions, _air_mm(view), where.center_mm, radius)


def _seen_area_mm2(view: View) -> float:
    """Return the luminous half's projected area towards the air before the camera, see `apparent_area`."""
    where = view.scene
    to_camera = where.T_joint_camera[:3, 3] - where.center_mm
    upwards = float(to_camera[2] / np.linalg.norm(to_camera))
    return 0.5 * math.pi * view.setup.arc.radius_mm**2 * (1.0 + upwards)


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


@dataclass(frozen=True)
class Streaks:
    """A Poisson number of streaks a frame, uniform in place: `peak_e` is an exponential's mean.

    `angle` gives the direction of a streak about (u, v), px, rad from the rows.
    """

    rate_per_frame: float
    peak_e: float
    length_px: float
    width_px: float
    angle: Callable[[float, float], float]


def _add_streaks(light: Light, view: View, streaks: Streaks, draw: Draw) -> None:
    camera, rate, peak_e = view.setup.camera, streaks.rate_per_frame, streaks.peak_e
    length, width = streaks.length_px, streaks.width_px
    if draw is None:
        # The lens widens a streak and keeps its light; the mean square is that behind it.
        seen = math.hypot(width, camera.psf_sigma_px) if view.is_frame else width
        first, _ = streak_moments(length, width)
        _, second = streak_moments(length, seen)
        density = rate / (camera.width * camera.height)
        # Campbell's theorem; the peaks are exponential, so their mean square is 2 peak_e^2.
        light.other = light.other + np.float32(density * peak_e * first)
        light.variance_e2 = light.variance_e2 + np.float32(
            density * 2.0 * (peak_e * width / seen) ** 2 * second
        )
        return
    # Streaks whose middle lies outside the image reach into it.
    rim = 0.5 * length + STREAK_REACH * width
    wide, high = camera.width + 2.0 * rim, camera.height + 2.0 * rim
    light.other = light.other.copy()
    for _ in range(int(draw.poisson(rate * wide * high / (camera.width * camera.height)))):
        u, v = draw.uniform(0.0, wide) - rim, draw.uniform(0.0, high) - rim
        angle, peak = streaks.angle(u, v), draw.exponential(peak_e)
        across, down = (
            slice(max(0, math.floor(middle - rim)), max(0, math.ceil(middle + rim) + 1)) for middle in (u, v)
        )
        uv = view.rays.uv_px[down, across]
        light.other[down, across] += np.float32(peak) * _streak(uv, u, v, angle, length, width)


def _spatter(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if condition.arc_level > 0.0:
        any_way = Streaks(**values, angle=lambda u, v: 0.0 if draw is None else draw.uniform(0.0, math.pi))
        _add_streaks(light, view, any_way, draw)


def _spatter_streaks(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    if condition.arc_level == 0.0:
        return
    setup, arc_camera = view.setup, transform(invert(view.scene.T_joint_camera), view.scene.center_mm)
    arc_u, arc_v = setup.camera.project(arc_camera[np.newaxis])[0].tolist()
    flown_mm = 1e3 * values["speed_mm_per_ms"] * condition.exposure_s
    # A longer exposure makes a streak longer, not brighter.
    per_exposure = setup.camera.exposure_s / condition.exposure_s
    from_arc = Streaks(
        rate_per_frame=values["rate_per_frame"],
        peak_e=values["brightness"] * setup.laser.peak_e * per_exposure,
        length_px=max(setup.camera.fx * flown_mm / float(arc_camera[2]), values["width_px"]),
        width_px=values["width_px"],
        angle=lambda u, v: math.atan2(v - arc_v, u - arc_u),
    )
    _add_streaks(light, view, from_arc, draw)


def _streak(uv_px: Float32, u: float, v: float, angle: float, length: float, width: float) -> Float32:
    along = (uv_px[..., 0] - u) * math.cos(angle) + (uv_px[..., 1] - v) * math.sin(angle)
    across = (uv_px[..., 1] - v) * math.cos(angle) - (uv_px[..., 0] - u) * math.sin(angle)
    box = ndtr((along + 0.5 * length) / width) - ndtr((along - 0.5 * length) / width)
    return np.asarray(box * np.exp(-0.5 * (across / width) ** 2), dtype=np.float32)


def _hot_metal_glow(light: Light, view: View, condition: Condition, values: Values, draw: Draw) -> None:
    peak_e = values["peak_e"] * (1.0 if condition.arc_level > 0.0 else values["arc_off_share"])
    if peak_e == 0.0:
        return
    rho = view.cached("rho_from_arc", lambda: _rho_mm(view))
    hot = np.exp(rho / np.float32(-values["length_mm"]))
    light.other = light.other + np.float32(peak_e) * view.rays.cos4 * hot


def _rho_mm(view: View) -> Float32:
    """Return the distance along the plate from the arc (...,), mm; inf past the workpiece: no glow."""
    offset = (view.surface[0] - view.scene.center_mm)[..., :2]
    rho = np.linalg.norm(offset, axis=-1).astype(np.float32)
    return np.where(np.isnan(rho), np.float32(np.inf), rho)


EFFECTS = (
    Effect(
        id="hot_metal_glow",
        stage=Stage.MEDIUM,
        summary="thermal emission near the arc, whatever the current and the viewing angle",
        equation="other += peak_e cos^4 exp(-rho / length_mm), rho the distance along the plate from the "
        "arc; arc_off_share of it while the arc is off",
        source="Wien's law, exp(-h c / (lambda k T)), where 1 / T grows evenly away from the pool, by "
        "lambda k / (h c length_mm); the plate radiates as Lambert's law says",
        parameters=(
            Parameter("peak_e", "e-", 0.0, 20_000.0, 0.0, 1e7, 50.0),
            Parameter("length_mm", "mm", 10.0, 10.0, 0.5, 100.0, 0.05),
            Parameter("arc_off_share", "", 0.0, 0.5, 0.0, 1.0, 0.01),
        ),
        typical={"peak_e": 30_000.0, "length_mm": 15.0},
        light=_hot_metal_glow,
        needs=("arc",),
    ),
    Effect(
        id="spatter",
        stage=Stage.MEDIUM,
        summary="bright streaks in single frames",
        equation="a Poisson number of streaks a frame, uniform in place and direction, exponential in peak: "
        "mean and variance by Campbell's theorem",
        source="Campbell 1909, Proc. Camb. Phil. Soc. 15, 117; Rice 1944, Bell Syst. Tech. J. 23, 282",
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
        id="spatter_streaks",
        stage=Stage.MEDIUM,
        summary="bright streaks that point away from the arc: spatter that flies while the shutter is open",
        equation="as spatter, in the direction from the arc's image; length = fx speed exposure / depth, the "
        "arc's, peak = brightness laser.peak_e whatever the exposure: what moves on gets no brighter",
        source="Campbell 1909, Proc. Camb. Phil. Soc. 15, 117. Pictures of gas metal arc welding (Li et al. "
        "2017, IEEE Trans. Ind. Electron., doi 10.1109/TIE.2017.2694399) show 3 to 30 streaks, some brighter "
        "than the stripe, up to 10 px wide",
        parameters=(
            Parameter("rate_per_frame", "", 0.0, 10.0, 0.0, 200.0, 0.1),
            Parameter("brightness", "", 1.0, 1.0, 0.0, 100.0, 0.01),
            Parameter("speed_mm_per_ms", "mm/ms", 2.0, 1.0, 0.05, 50.0, 0.02),
            Parameter("width_px", "px", 2.0, 1.0, 0.5, 20.0, 0.1),
        ),
        typical={"rate_per_frame": 12.0},
        light=_spatter_streaks,
        needs=("arc",),
    ),
    Effect(
        id="fume",
        stage=Stage.MEDIUM,
        summary="welding fume dims what passes it and scatters the arc's light",
        equation="beta thins out as 1 / (1 + gathered^2 r^2), r from the arc; all light x exp(-integral beta "
        "dt) from part to camera; arc += radiance scatter / (4 pi) A_eff integral beta dt / r^2 along the "
        "ray, scatter the fume's albedo in the relative units of kappa; on the ways to the part the fume is "
        "left out",
        source="Beer and Lambert; Sun, Ramamoorthi, Narasimhan and Nayar 2005 (ACM TOG 24(3), 1040): single "
        "scattering, here thin; A_eff as in Eq. 15",
        parameters=(
            Parameter("extinction_per_m", "1/m", 0.0, 1.0, 0.0, 20.0, 0.01),
            Parameter("scatter", "", 0.05, 2.0, 0.0, 50.0, 0.001),
            Parameter("gathered_per_mm", "1/mm", 0.0, 0.03, 0.0, 0.3, 0.001),
        ),
        typical={"extinction_per_m": 2.0, "scatter": 0.05},
        light=_fume,
        needs=("arc",),
        form_rel=UNSTATED,
    ),
)

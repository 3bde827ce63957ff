"""Hidden effects of the medium: fume, spatter and the glow of hot metal."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from validation.second_renderer.world_effect import (
    CATALOGUE,
    EffectForm,
    Generator,
    Values,
    WorldFrameLight,
    direction,
    magnitude,
)

Density = Callable[[Float64, Float64], Float64]
"""The fume's density (n,) over the even one's, at points (n, 3) and their distances (n,) from the arc, mm."""

STEPS = 24
"""Points along a ray at which fume is summed."""


def draw_fume(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    """Draw how much fume dims and how bright it is."""
    return {
        "extinction_per_m": magnitude(strength, 0.5, 3.0),
        "airlight_share": magnitude(strength, 0.006, 0.12),
    }


def _draw_plume(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"width_mm": draw.uniform(20.0, 45.0), **draw_fume(draw, strength, setup)}


def even_fume(frame: WorldFrameLight, p: Values) -> None:
    """Let fume that is as dense everywhere dim the light, and shine."""
    fill_with_fume(frame, p, lambda points, r: np.ones_like(r))


def _plume(frame: WorldFrameLight, p: Values) -> None:
    fill_with_fume(frame, p, lambda points, r: 3.0 * np.exp(-0.5 * (r / p["width_mm"]) ** 2))


def fill_with_fume(frame: WorldFrameLight, p: Values, density: Density) -> None:
    """Dim and scatter by the fume along every ray.

    From a level pose at nominal height the airlight in the middle of the image is `airlight_share` of full
    well at the nominal current: how much the fume scatters does not change with the pose.
    """
    sight, body, setup = frame.sight, frame.body, frame.studio.world.setup
    far = float(np.linalg.norm(body.center_mm - sight.eye_mm))
    length = np.nan_to_num(sight.distance_mm.ravel(), nan=far)
    optical, air = fume_along(sight.eye_mm, sight.directions, length, body.center_mm, body.radius_mm, density)
    optical, air = optical.reshape(sight.shape), sight.cos4.reshape(sight.shape) * air.reshape(sight.shape)

    eye, axis = setup.camera.T_tool_camera[:3, 3], setup.camera.T_tool_camera[:3, 2]
    to_plate = np.array([-eye[2] / axis[2]])
    center = np.asarray(setup.arc.center_in_tool_mm)
    _, middle = fume_along(eye, axis[np.newaxis], to_plate, center, setup.arc.radius_mm, density)
    frame.scale(np.exp(-1e-3 * p["extinction_per_m"] * optical))
    scattered_e = p["airlight_share"] * setup.sensor.full_well_e / float(middle[0])
    frame.arc = frame.arc + frame.moment.arc_level * scattered_e * air


def fume_along(
    eye_mm: Float64,
    directions: Float64,
    length_mm: Float64,
    arc_mm: Float64,
    arc_radius_mm: float,
    density: Density,
) -> tuple[Float64, Float64]:
    """Return sums of the fume's density, mm, and of density / r^2, 1/mm, along rays (n, 3) of lengths (n,).

    r is the distance from the arc, within whose radius there is no fume.
    """
    optical, air = np.zeros(len(length_mm)), np.zeros(len(length_mm))
    for step in (np.arange(STEPS) + 0.5) / STEPS:
        point_mm = eye_mm + (step * length_mm)[:, np.newaxis] * directions
        r = np.linalg.norm(point_mm - arc_mm, axis=1)
        rho = density(point_mm, r) * length_mm / STEPS
        optical += rho
        air += rho / np.maximum(r, arc_radius_mm) ** 2
    return optical, air


def draw_spatter(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    """Draw how many streaks there are, and their size."""
    return {
        "rate_per_frame": magnitude(strength, 1.0, 10.0),
        "peak_e": magnitude(strength, 800.0, 15000.0),
        "length_px": draw.uniform(20.0, 80.0),
        "width_px": draw.uniform(1.0, 2.5),
    }


def _straight_spatter(frame: WorldFrameLight, p: Values) -> None:
    _spatter(frame, p, bend=0.0, peak=lambda: frame.draw.exponential(p["peak_e"]))


def _curved_spatter(frame: WorldFrameLight, p: Values) -> None:
    # A heavy tail of the same mean: few drops are large.
    _spatter(frame, p, bend=0.5, peak=lambda: 0.5 * p["peak_e"] * (1.0 + frame.draw.pareto(2.0)))


def _spatter(frame: WorldFrameLight, p: Values, bend: float, peak: Callable[[], float]) -> None:
    """Draw streaks as chains of dots along a line or a parabola, each dot a Gaussian."""
    if frame.moment.arc_level == 0.0:
        return
    height, width = frame.sight.shape
    image = np.zeros((height, width))
    for _ in range(frame.draw.poisson(p["rate_per_frame"])):
        u, v = frame.draw.uniform(0.0, width), frame.draw.uniform(0.0, height)
        du, dv = direction(frame.draw, 1.0)
        curve, bright = bend * frame.draw.uniform(-1.0, 1.0), peak()
        t = np.arange(-0.5 * p["length_px"], 0.5 * p["length_px"])
        off = curve * t**2 / p["length_px"]
        add_dots(image, u + du * t - dv * off, v + dv * t + du * off, np.full(len(t), bright), p["width_px"])
    frame.other = frame.other + image


def add_dots(image: Float64, x_px: Float64, y_px: Float64, bright_e: Float64, width_px: float) -> None:
    """Add a chain of dots (n,) to an image, e-, each a Gaussian of 1 sigma `width_px`."""
    height, width = image.shape
    reach = math.ceil(4.0 * width_px)
    for x, y, bright in zip(x_px, y_px, bright_e, strict=True):
        rows = np.arange(max(0, int(y) - reach), min(height, int(y) + reach + 1))
        columns = np.arange(max(0, int(x) - reach), min(width, int(x) + reach + 1))
        across, down = (
            np.exp(-0.5 * ((n - middle) / width_px) ** 2) for n, middle in ((columns, x), (rows, y))
        )
        # A chain of unit steps adds up to sqrt(2 pi) width at its middle.
        image[np.ix_(rows, columns)] += (
            bright * np.outer(down, across) / (math.sqrt(2.0 * math.pi) * width_px)
        )


def _draw_glow(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"brightest_e": magnitude(strength, 350.0, 5000.0), "length_mm": draw.uniform(7.0, 20.0)}


def _from_arc_mm(frame: WorldFrameLight) -> Float64:
    aside = frame.sight.points[:, :2] - frame.body.center_mm[:2]
    return np.asarray(np.linalg.norm(aside, axis=1)).reshape(frame.sight.shape)


def _nearest_mm(setup: Setup) -> float:
    """Return how near to the arc the image comes, mm, along a plate, from a level pose at nominal height."""
    camera = setup.camera
    places = np.meshgrid(np.linspace(0.0, camera.width - 1.0, 9), np.linspace(0.0, camera.height - 1.0, 9))
    u, v = (axis.ravel() for axis in places)
    rays = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    d, eye = rays @ camera.T_tool_camera[:3, :3].T, camera.T_tool_camera[:3, 3]
    on_plate = eye - eye[2] / d[:, 2:] * d
    aside = on_plate[:, :2] - np.asarray(setup.arc.center_in_tool_mm)[:2]
    return float(np.linalg.norm(aside, axis=1).min())


def add_glow(frame: WorldFrameLight, p: Values, fall: Callable[[Float64], Float64]) -> None:
    """Add the glow, whatever the current: `brightest_e` where the image comes nearest to the arc.

    That is from a level pose at nominal height: how much the metal glows does not change with the pose.
    """
    if frame.moment.arc_level == 0.0:
        return
    nearest = np.asarray(_nearest_mm(frame.studio.world.setup))
    hot = np.nan_to_num(fall(_from_arc_mm(frame)) / fall(nearest))
    frame.other = frame.other + p["brightest_e"] * hot * frame.sight.cos4.reshape(frame.sight.shape)


def exponential_glow(frame: WorldFrameLight, p: Values) -> None:
    """Add hot metal's glow, which falls off exponentially about the arc."""
    add_glow(frame, p, lambda rho: np.exp(-rho / p["length_mm"]))


def _disc_glow(frame: WorldFrameLight, p: Values) -> None:
    add_glow(frame, p, lambda rho: np.exp(-0.5 * (rho / (1.5 * p["length_mm"])) ** 2))


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "hot_metal_glow": (
        EffectForm(CATALOGUE, "exp(-rho / length_mm) about the arc", _draw_glow, light=exponential_glow),
        EffectForm("disc", "a Gaussian of 1 sigma 1.5 length_mm about the arc", _draw_glow, light=_disc_glow),
    ),
    "spatter": (
        EffectForm(
            CATALOGUE, "straight streaks, exponential in their peaks", draw_spatter, light=_straight_spatter
        ),
        EffectForm("curved", "parabolas, their peaks of a power law", draw_spatter, light=_curved_spatter),
    ),
    "fume": (
        EffectForm(
            CATALOGUE, "even fume: exp(-beta d); airlight ~ integral dt / r^2", draw_fume, light=even_fume
        ),
        EffectForm(
            "plume", "the same with a Gaussian plume about the arc, 3 beta in it", _draw_plume, light=_plume
        ),
    ),
}

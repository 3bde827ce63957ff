"""Hidden effects of the illumination: the laser's fan and profile, and lamps of the hall."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import invert, transform
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
from validation.second_renderer.world_light import TrueWorld

N_WAVES = 24
"""Plane waves that a scene's texture is the sum of."""


def _draw_tilted_fan(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"slope": signed(draw, magnitude(strength, 0.06, 0.7))}


def _draw_cylinder(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"width_deg": magnitude(strength, 14.0, 4.0), "aside_deg": draw.uniform(-2.0, 2.0)}


def _draw_fan_end(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"half_deg": magnitude(strength, 6.0, 3.0)}


def fan_deg(frame: WorldFrameLight) -> Float64:
    """Return the fan's angle (H, W), deg, at what each pixel sees: to the left of travel is positive."""
    laser = frame.studio.world.setup.laser
    rays = transform(invert(frame.sight.T_joint_tool), frame.sight.points) - laser.origin_mm
    angle = np.arctan2(rays @ np.cross([0.0, 0.0, 1.0], laser.plane[:3]), -rays[:, 2])
    return np.asarray(np.nan_to_num(np.degrees(angle))).reshape(frame.sight.shape)


def _tilted_fan(frame: WorldFrameLight, p: Values) -> None:
    frame.laser = frame.laser * np.exp(p["slope"] * fan_deg(frame) / 10.0)


def _cylinder(frame: WorldFrameLight, p: Values) -> None:
    frame.laser = frame.laser * np.exp(-0.5 * ((fan_deg(frame) - p["aside_deg"]) / p["width_deg"]) ** 2)


def _fan_end(frame: WorldFrameLight, p: Values) -> None:
    # The beam's rim dims over a tenth of the half angle.
    past = (np.abs(fan_deg(frame)) / p["half_deg"] - 0.95) / 0.1
    frame.laser = frame.laser * (0.5 + 0.5 * np.cos(math.pi * np.clip(past, 0.0, 1.0)))


def _draw_profile(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "width_ratio": math.exp(signed(draw, magnitude(strength, 0.08, 0.5))),
        "exponent": draw.uniform(1.8, 3.0),
    }


def _profile(world: TrueWorld, p: Values) -> TrueWorld:
    laser = world.setup.laser
    other = replace(laser, stripe_sigma_mm=laser.stripe_sigma_mm * p["width_ratio"])
    shaped = replace(world.profile, exponent=p["exponent"])
    return replace(world, setup=replace(world.setup, laser=other), profile=shaped)


def _draw_pedestal(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.04, 0.4), "ratio": draw.uniform(1.8, 3.0)}


def _pedestal(world: TrueWorld, p: Values) -> TrueWorld:
    return replace(world, profile=replace(world.profile, pedestal=p["share"], pedestal_ratio=p["ratio"]))


def _draw_sky(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"level_e": magnitude(strength, 200.0, 5000.0), "texture": draw.uniform(0.0, 0.05)}


def _draw_lamp(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "level_e": magnitude(strength, 300.0, 5000.0),
        "elevation_deg": draw.uniform(35.0, 75.0),
        "azimuth_deg": draw.uniform(-180.0, 180.0),
        "texture": draw.uniform(0.0, 0.1),
        "seed": drawn_seed(draw),
    }


def _sky(frame: WorldFrameLight, p: Values) -> None:
    up = np.nan_to_num(frame.sight.normals[:, 2], nan=1.0)
    lit_by_hall(frame, p["level_e"] * 0.5 * (1.0 + up), p["texture"], 0)


def _lamp(frame: WorldFrameLight, p: Values) -> None:
    elevation, azimuth = math.radians(p["elevation_deg"]), math.radians(p["azimuth_deg"])
    flat = math.cos(elevation)
    towards = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    facing = np.maximum(frame.sight.normals @ towards, 0.0)
    # A third comes from walls and ceiling.
    lit = 2.0 / 3.0 * np.nan_to_num(facing, nan=0.0) / towards[2] + 1.0 / 3.0
    lit_by_hall(frame, p["level_e"] * lit, p["texture"], int(p["seed"]))


def lit_by_hall(frame: WorldFrameLight, even_e: Float64, texture: float, seed: int) -> None:
    """Add light (n,), e-, that the metal's blotches, fixed to the part, reflect more or less of."""
    draw = np.random.default_rng(seed)
    waves = draw.standard_normal((2, N_WAVES)) * (2.0 * math.pi / 6.0)
    phases = draw.uniform(0.0, 2.0 * math.pi, N_WAVES)
    points = np.nan_to_num(frame.sight.points[:, :2])
    blotches = np.cos(points @ waves + phases).sum(axis=1) * math.sqrt(2.0 / N_WAVES)
    seen = even_e * np.maximum(1.0 + texture * blotches, 0.0) * frame.sight.cos4
    frame.other = frame.other + seen.reshape(frame.sight.shape)


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "uneven_fan": (
        EffectForm(CATALOGUE, "laser x exp(slope phi / 10 deg)", _draw_tilted_fan, light=_tilted_fan),
        EffectForm(
            "cylinder",
            "laser x exp(-(phi - aside)^2 / 2 width^2): a cylinder lens",
            _draw_cylinder,
            light=_cylinder,
        ),
        EffectForm(
            "ends",
            "laser x a raised cosine that falls about half_deg from the axis",
            _draw_fan_end,
            light=_fan_end,
        ),
    ),
    "stripe_profile": (
        EffectForm(
            CATALOGUE, "exp(-1/2 abs(x' / (width_ratio sigma))^exponent)", _draw_profile, world=_profile
        ),
        EffectForm(
            "pedestal",
            "(1 - share) of the stated Gaussian and share of one ratio times as wide",
            _draw_pedestal,
            world=_pedestal,
        ),
    ),
    "ambient_light": (
        EffectForm(
            CATALOGUE,
            "other + level_e cos^4 (1 + n_z) / 2 x (1 + texture blotches)",
            _draw_sky,
            light=_sky,
            in_dark=True,
        ),
        EffectForm(
            "lamp",
            "other + level_e cos^4 (2/3 n.l / l_z + 1/3) x (1 + texture blotches), l towards a lamp",
            _draw_lamp,
            light=_lamp,
            in_dark=True,
        ),
    ),
}

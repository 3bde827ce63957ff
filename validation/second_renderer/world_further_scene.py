"""Further forms of effects of surface, geometry and timing, which no judgement was tuned on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Bool
from noise_model.setup import Setup
from noise_model.surface.brdf import Material
from validation.second_renderer.world_bounce import Bounces
from validation.second_renderer.world_effect import (
    EffectForm,
    Generator,
    Moment,
    Values,
    WorldFrameLight,
    direction,
    drawn_seed,
    magnitude,
    signed,
)
from validation.second_renderer.world_light import TrueWorld, WorldLens
from validation.second_renderer.world_metal import LobeShape
from validation.second_renderer.world_scene import bounced, cut_plate
from validation.second_renderer.world_surface import OnePlateTilted


def _of_metal(frame: WorldFrameLight, material: Material, there: Bool) -> None:
    """Show what pixels (H, W) see as another metal, the sources' power unchanged."""
    studio, moment = frame.studio.of_metal(material), frame.moment
    if moment.arc_level > 0.0:
        arc = moment.arc_level * studio.arc_light(frame.sight, frame.body)
        frame.arc = np.where(there, arc, frame.arc)
    if moment.laser_level > 0.0:
        frame.laser = np.where(there, moment.laser_level * studio.stripe(frame.sight), frame.laser)


def _draw_one_plate_metal(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # The two parts go opposite ways, as in the catalogue's form.
    diff = signed(draw, magnitude(strength, 0.2, 1.2))
    return {"kappa_diff_ln": diff, "kappa_spec_ln": -0.5 * diff, "side": signed(draw, 1.0)}


def _one_plate_metal(frame: WorldFrameLight, p: Values) -> None:
    metal, faces = frame.studio.world.setup.material, frame.sight.faces.reshape(frame.sight.shape)
    other = replace(
        metal,
        kappa_diff=metal.kappa_diff * math.exp(p["kappa_diff_ln"]),
        kappa_spec=metal.kappa_spec * math.exp(p["kappa_spec_ln"]),
    )
    # Faces count from y < 0 to y > 0: beyond the middle one is the other plate.
    beyond = 2 * faces + 2 - len(frame.studio.surface.outline_mm())
    _of_metal(frame, other, (faces >= 0) & (p["side"] * beyond > 0.0))


def _draw_ground(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"c2_ln": signed(draw, magnitude(strength, 0.25, 1.2)), "half_width_mm": draw.uniform(8.0, 14.0)}


def _ground(frame: WorldFrameLight, p: Values) -> None:
    metal, y = frame.studio.world.setup.material, frame.sight.points[:, 1].reshape(frame.sight.shape)
    near = np.abs(np.nan_to_num(y, nan=np.inf)) < p["half_width_mm"]
    _of_metal(frame, replace(metal, c2=metal.c2 * math.exp(p["c2_ln"])), near)


def _draw_exponential_power(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"exponent": 1.0 - magnitude(strength, 0.12, 0.65)}


def _draw_grooves(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.08, 0.7), "marks_deg": draw.uniform(-90.0, 90.0)}


def _draw_bounces(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"scale": magnitude(strength, 0.12, 0.45)}


def _draw_curved_outline(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {
        "reach_mm": magnitude(strength, 17.0, 7.0),
        "side": signed(draw, 1.0),
        "radius_mm": signed(draw, draw.uniform(120.0, 400.0)),
        "middle_mm": draw.uniform(25.0, 55.0),
    }


def _curved_outline(frame: WorldFrameLight, p: Values) -> None:
    x = np.nan_to_num(frame.sight.points[:, 0]) - p["middle_mm"]
    cut_plate(frame, p["side"], p["reach_mm"] + 0.5 * x**2 / p["radius_mm"])


def _draw_warming(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    turn, move = draw.standard_normal(3), draw.standard_normal(3)
    turn *= magnitude(strength, 0.25, 2.0) / np.linalg.norm(turn)
    move *= magnitude(strength, 0.25, 2.0) / np.linalg.norm(move)
    values = {f"rot_{axis}_deg": float(value) for axis, value in zip("xyz", turn, strict=True)}
    values |= {f"move_{axis}_mm": float(value) for axis, value in zip("xyz", move, strict=True)}
    return {**values, "settle_s": draw.uniform(0.5, 4.0)}


def _warming(moment: Moment, p: Values) -> Moment:
    share = math.expm1(-moment.time_s / p["settle_s"]) / math.expm1(-moment.duration_s / p["settle_s"])
    turn, move = ([share * p[f"{what}_{a}_{unit}"] for a in "xyz"] for what, unit in _CAMERA)
    return replace(
        moment, camera_turn_deg=(turn[0], turn[1], turn[2]), camera_move_mm=(move[0], move[1], move[2])
    )


_CAMERA = ("rot", "deg"), ("move", "mm")


def _draw_one_plate_tilt(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"roll_deg": signed(draw, magnitude(strength, 0.7, 6.0)), "side": signed(draw, 1.0)}


def _one_plate_tilted(world: TrueWorld, p: Values) -> TrueWorld:
    seam = world.departure
    tilted = OnePlateTilted(seam.y_amp_mm, seam.y_period_mm, seam.z_slope, p["roll_deg"], p["side"])
    return replace(world, departure=tilted)


def _draw_decentring(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # At 0.18 focal lengths, the image's corner, 0.01 moves a point by about 2 px.
    p1, p2 = direction(draw, magnitude(strength, 0.01, 0.08))
    return {"p1": p1, "p2": p2}


def _draw_queue(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    delay_s = signed(draw, magnitude(strength, 0.008, 0.08))
    return {"delay_s": delay_s, "queued_share": draw.uniform(0.2, 0.5), "seed": drawn_seed(draw)}


def _queue(moment: Moment, p: Values) -> Moment:
    wait = np.random.default_rng([int(p["seed"]), moment.index]).exponential()
    late_s = p["delay_s"] * (1.0 - p["queued_share"] + p["queued_share"] * min(wait, MAX_WAIT))
    return replace(moment, pose_time_s=moment.pose_time_s + late_s)


MAX_WAIT = 4.0
"""Longest wait in a queue, in its mean: poses are recorded for half a second beyond the run."""

FORMS: Mapping[str, EffectForm] = {
    "wrong_material": EffectForm(
        "one_plate",
        "kappa_diff x exp(kappa_diff_ln), kappa_spec x exp(kappa_spec_ln) of one of the two plates: "
        "a joint of dissimilar metals (AWS Welding Handbook)",
        _draw_one_plate_metal,
        light=_one_plate_metal,
    ),
    "roughness_change": EffectForm(
        "ground",
        "c2 x exp(c2_ln) within half_width_mm of the seam: edges are ground before welding (AWS D1.1)",
        _draw_ground,
        light=_ground,
    ),
    "brdf_tail": EffectForm(
        "exponential_power",
        "exp(-(c2 tan^2 alpha)^exponent) (Holzschuch and Pacanowski 2017, ACM Trans. Graph. 36, 66)",
        _draw_exponential_power,
        world=lambda world, p: replace(world, lobe=LobeShape("exponential_power", p["exponent"])),
    ),
    "rolling_marks": EffectForm(
        "grooves",
        "a share of the lobe is of grooves at marks_deg, cylinders (Poulin and Fournier 1990, SIGGRAPH, 273)",
        _draw_grooves,
        world=lambda world, p: replace(world, lobe=LobeShape("grooves", p["share"], p["marks_deg"])),
    ),
    "plate_outline": EffectForm(
        "curved",
        "dark from reach_mm + (x - middle_mm)^2 / (2 radius_mm) beside the seam on: a flame-cut edge's bow "
        "(ISO 9013, straightness)",
        _draw_curved_outline,
        light=_curved_outline,
    ),
    "interreflection": EffectForm(
        "radiosity",
        "up to six bounces, all even: radiosity of scale kappa_diff (Goral et al. 1984, SIGGRAPH, 213)",
        _draw_bounces,
        light=lambda frame, p: bounced(frame, Bounces(p["scale"], glossy=False)),
    ),
    "hand_eye": EffectForm(
        "warming",
        "T_tool_camera turned and moved by the share (1 - exp(-t / settle_s)) / (1 - exp(-T / settle_s)): a "
        "bracket that warms (Newton's law; Handel 2008, Proc. SPIE 6805)",
        _draw_warming,
        moment=_warming,
    ),
    "surface_tilt": EffectForm(
        "one_plate",
        "one plate turned about the seam by roll_deg: angular distortion beside a clamped plate (Masubuchi "
        "1980, Analysis of Welded Structures)",
        _draw_one_plate_tilt,
        world=_one_plate_tilted,
    ),
    "lens_distortion": EffectForm(
        "decentred",
        "p1 and p2 of a decentred lens (Brown 1966, Photogramm. Eng. 32, 444)",
        _draw_decentring,
        world=lambda world, p: replace(world, lens=WorldLens("decentred", p["p1"], p["p2"])),
    ),
    "pose_delay": EffectForm(
        "queue",
        "t + delay_s (1 - queued_share + queued_share w), w exponential in each frame: the wait in a queue "
        "(Kleinrock 1975, Queueing Systems 1)",
        _draw_queue,
        moment=_queue,
    ),
}

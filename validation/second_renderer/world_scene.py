"""Hidden effects of surface, geometry and timing: the metal, where camera and plate are, the poses' clock."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.setup import Setup
from noise_model.transforms import moved
from validation.second_renderer.world_bounce import Bounces, bounced_light
from validation.second_renderer.world_effect import (
    CATALOGUE,
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

TABLE_1 = ((0.021, 0.326), (0.495, 0.153))
"""kappa_diff and kappa_spec of mild steel and of Zn-coated steel (the paper's Table 1)."""


def _with_kappas(world: TrueWorld, kappa_diff: float, kappa_spec: float) -> TrueWorld:
    material = replace(world.setup.material, kappa_diff=kappa_diff, kappa_spec=kappa_spec)
    return replace(world, setup=replace(world.setup, material=material))


def _draw_material(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # The two parts go opposite ways: together they would be a level.
    diff = signed(draw, magnitude(strength, 0.25, 1.2))
    return {"kappa_diff_ln": diff, "kappa_spec_ln": -0.5 * diff}


def _wrong_material(world: TrueWorld, p: Values) -> TrueWorld:
    metal = world.setup.material
    diff, spec = math.exp(p["kappa_diff_ln"]), math.exp(p["kappa_spec_ln"])
    return _with_kappas(world, metal.kappa_diff * diff, metal.kappa_spec * spec)


def _draw_blend(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # A little zinc on steel says much, a little steel in zinc hardly anything.
    is_steel = setup.material.kappa_diff < setup.material.kappa_spec
    return {"share": magnitude(strength, 0.01, 0.1) if is_steel else magnitude(strength, 0.3, 0.9)}


def _blended_material(world: TrueWorld, p: Values) -> TrueWorld:
    metal, w = world.setup.material, p["share"]
    diff, spec = TABLE_1[1] if metal.kappa_diff < metal.kappa_spec else TABLE_1[0]
    return _with_kappas(
        world, (1.0 - w) * metal.kappa_diff + w * diff, (1.0 - w) * metal.kappa_spec + w * spec
    )


def _draw_roughness(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"c2_ln": signed(draw, magnitude(strength, 0.2, 1.0))}


def _roughness(world: TrueWorld, p: Values) -> TrueWorld:
    material = world.setup.material
    rougher = replace(material, c2=material.c2 * math.exp(p["c2_ln"]))
    return replace(world, setup=replace(world.setup, material=rougher))


def _draw_student(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"tail": magnitude(strength, 0.15, 1.2)}


def _draw_two_lobes(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.06, 0.4), "width_ratio": draw.uniform(1.8, 3.0)}


def _draw_ggx(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"share": magnitude(strength, 0.15, 1.0)}


def _draw_marks(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"anisotropy": magnitude(strength, 0.15, 1.3), "marks_deg": draw.uniform(-90.0, 90.0)}


def _draw_bounces(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"scale": magnitude(strength, 0.12, 0.45)}


def bounced(frame: WorldFrameLight, bounces: Bounces) -> None:
    """Add the light that bounces between the faces."""
    arc, laser = bounced_light(frame.studio, frame.sight, frame.body, bounces)
    frame.arc = frame.arc + frame.moment.arc_level * arc
    frame.laser = frame.laser + frame.moment.laser_level * laser


def _draw_hand_eye(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    turn, move = draw.standard_normal(3), draw.standard_normal(3)
    turn *= magnitude(strength, 0.15, 1.2) / np.linalg.norm(turn)
    move *= magnitude(strength, 0.15, 1.5) / np.linalg.norm(move)
    values = {f"rot_{axis}_deg": float(value) for axis, value in zip("xyz", turn, strict=True)}
    return values | {f"move_{axis}_mm": float(value) for axis, value in zip("xyz", move, strict=True)}


def _hand_eye(world: TrueWorld, p: Values) -> TrueWorld:
    camera = world.setup.camera
    turn, move = ([p[f"{what}_{a}_{unit}"] for a in "xyz"] for what, unit in (("rot", "deg"), ("move", "mm")))
    T_tool_camera = moved(camera.T_tool_camera, turn, move)
    return replace(world, setup=replace(world.setup, camera=replace(camera, T_tool_camera=T_tool_camera)))


def _draw_tilt(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    roll, pitch = direction(draw, magnitude(strength, 0.25, 4.0))
    return {"roll_deg": roll, "pitch_deg": pitch}


def _tilted(world: TrueWorld, p: Values) -> TrueWorld:
    return replace(
        world, T_base_joint=moved(world.T_base_joint, [p["roll_deg"], p["pitch_deg"], 0.0], np.zeros(3))
    )


def _draw_hinge(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"roll_deg": signed(draw, magnitude(strength, 0.25, 3.0)), "clamp_y_mm": signed(draw, 30.0)}


def _hinged(world: TrueWorld, p: Values) -> TrueWorld:
    to_clamp = moved(world.T_base_joint, np.zeros(3), [0.0, p["clamp_y_mm"], 0.0])
    rolled = moved(to_clamp, [p["roll_deg"], 0.0, 0.0], np.zeros(3))
    return replace(world, T_base_joint=moved(rolled, np.zeros(3), [0.0, -p["clamp_y_mm"], 0.0]))


def _draw_distortion(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # At 0.18 focal lengths, the image's corner, k1 = 0.1 moves a point by 1.3 px.
    return {"k1": signed(draw, magnitude(strength, 0.15, 1.2))}


def _draw_bent_distortion(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    # Of one sign: k2 must not undo at the corner what makes the distortion as strong as it is to be.
    k1 = signed(draw, magnitude(strength, 0.15, 1.2))
    return {"k1": k1, "k2": k1 * draw.uniform(0.0, 5.0)}


def _draw_delay(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"delay_s": signed(draw, magnitude(strength, 0.008, 0.08))}


def _delayed(moment: Moment, p: Values) -> Moment:
    return replace(moment, pose_time_s=moment.pose_time_s + p["delay_s"])


def _draw_wandering_clock(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    delay_s = signed(draw, magnitude(strength, 0.008, 0.08))
    skew = draw.uniform(-0.3, 0.3) * abs(delay_s)
    return {"delay_s": delay_s, "skew": skew, "jitter_s": 0.1 * abs(delay_s), "seed": drawn_seed(draw)}


def _wandering_clock(moment: Moment, p: Values) -> Moment:
    jitter_s = p["jitter_s"] * np.random.default_rng([int(p["seed"]), moment.index]).standard_normal()
    late_s = p["delay_s"] + p["skew"] * moment.time_s + float(jitter_s)
    return replace(moment, pose_time_s=moment.pose_time_s + late_s)


def _draw_outline(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {"reach_mm": magnitude(strength, 17.0, 7.0), "side": signed(draw, 1.0), "turn_deg": 0.0}


def _draw_slanted_outline(draw: Generator, strength: float, setup: Setup) -> dict[str, float]:
    return {**_draw_outline(draw, strength, setup), "turn_deg": draw.uniform(-3.0, 3.0)}


def _cut_straight(frame: WorldFrameLight, p: Values) -> None:
    x = np.nan_to_num(frame.sight.points[:, 0])
    cut_plate(frame, p["side"], p["reach_mm"] + math.tan(math.radians(p["turn_deg"])) * x)


def cut_plate(frame: WorldFrameLight, side: float, reach_mm: Float64) -> None:
    """Leave what lies at side y > reach (n,), mm, dark."""
    beyond = side * np.nan_to_num(frame.sight.points[:, 1]) > reach_mm
    frame.through(lambda image: np.where(beyond.reshape(image.shape), 0.0, image))


FORMS: dict[str, tuple[EffectForm, ...]] = {
    "wrong_material": (
        EffectForm(
            CATALOGUE,
            "kappa_diff x exp(kappa_diff_ln), kappa_spec x exp(kappa_spec_ln); the stripe peaks as stated",
            _draw_material,
            world=_wrong_material,
        ),
        EffectForm(
            "blend",
            "(1 - share) kappa + share kappa of Table 1's other metal",
            _draw_blend,
            world=_blended_material,
        ),
    ),
    "roughness_change": (EffectForm(CATALOGUE, "c2 x exp(c2_ln)", _draw_roughness, world=_roughness),),
    "brdf_tail": (
        EffectForm(
            CATALOGUE,
            "(1 + tail c2 alpha^2)^(-1/tail)",
            _draw_student,
            world=lambda world, p: replace(world, lobe=replace(world.lobe, tail=p["tail"])),
        ),
        EffectForm(
            "two_lobes",
            "two Gaussians, the second width_ratio as wide, of that share",
            _draw_two_lobes,
            world=lambda world, p: replace(world, lobe=LobeShape("two_lobes", p["share"], p["width_ratio"])),
        ),
        EffectForm(
            "ggx",
            "a share of Trowbridge and Reitz's (1 + c2 tan^2(alpha) / 2)^-2",
            _draw_ggx,
            world=lambda world, p: replace(world, lobe=LobeShape("ggx", p["share"])),
        ),
    ),
    "rolling_marks": (
        EffectForm(
            CATALOGUE,
            "c2 (e^a cos^2 psi + e^-a sin^2 psi), psi from marks at marks_deg",
            _draw_marks,
            world=lambda world, p: replace(
                world, lobe=replace(world.lobe, kind="ward", a=p["anisotropy"], b=p["marks_deg"])
            ),
        ),
        EffectForm(
            "slopes",
            "an elliptical Gaussian of the half vector's slopes",
            _draw_marks,
            world=lambda world, p: replace(world, lobe=LobeShape("slopes", p["anisotropy"], p["marks_deg"])),
        ),
    ),
    "plate_outline": (
        EffectForm(CATALOGUE, "dark from reach_mm beside the seam on", _draw_outline, light=_cut_straight),
        EffectForm(
            "slanted",
            "the same, the edge turned by turn_deg to the seam",
            _draw_slanted_outline,
            light=_cut_straight,
        ),
    ),
    "interreflection": (
        EffectForm(
            CATALOGUE,
            "up to six bounces, absolute reflectance scale f_r, by the metal's lobe first",
            _draw_bounces,
            light=lambda frame, p: bounced(frame, Bounces(p["scale"])),
        ),
        EffectForm(
            "one_diffuse",
            "one bounce, even in all directions: scale kappa_diff",
            _draw_bounces,
            light=lambda frame, p: bounced(frame, Bounces(p["scale"], most=1, glossy=False)),
        ),
    ),
    "hand_eye": (
        EffectForm(
            CATALOGUE, "T_tool_camera turned and moved in the camera's frame", _draw_hand_eye, world=_hand_eye
        ),
    ),
    "surface_tilt": (
        EffectForm(CATALOGUE, "joint turned by roll and pitch at its origin", _draw_tilt, world=_tilted),
        EffectForm("hinge", "joint rolled about a clamp line at y = clamp_y_mm", _draw_hinge, world=_hinged),
    ),
    "lens_distortion": (
        EffectForm(
            CATALOGUE,
            "x_d = x_u (1 + k1 r_u^2 + k2 r_u^4)",
            _draw_bent_distortion,
            world=lambda world, p: replace(world, lens=WorldLens("brown", p["k1"], p["k2"])),
        ),
        EffectForm(
            "division",
            "x_u = x_d / (1 + k1 r_d^2)",
            _draw_distortion,
            world=lambda world, p: replace(world, lens=WorldLens("division", p["k1"])),
        ),
    ),
    "pose_delay": (
        EffectForm(CATALOGUE, "the pose at t is stamped t + delay_s", _draw_delay, moment=_delayed),
        EffectForm(
            "wandering",
            "t + delay_s + skew t + normal jitter",
            _draw_wandering_clock,
            moment=_wandering_clock,
        ),
    ),
}

"""Small true worlds, and what a frame of them shows."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from noise_model.surface.joint import Joint
from validation.second_renderer.world import apply_moment_effects, apply_world_effects, expected_charge
from validation.second_renderer.world_effect import Moment
from validation.second_renderer.world_light import Studio, TrueWorld

RADIANCE_E = {"mild_steel": 2.0e8, "zn_coated": 6.0e6}
DARK, LASER, ARC, BOTH = (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)


def setup_of(joint="v_groove", material="zn_coated", width=160, radiance_e=None):
    setup = nominal_setup(
        "v_groove" if joint == "flat" else joint, material, width=width, height=width * 3 // 4
    )
    if joint == "flat":
        setup = dataclasses.replace(setup, joint=Joint("flat", {}, setup.joint.seam_in_base_mm))
    radiance_e = RADIANCE_E[material] if radiance_e is None else radiance_e
    return dataclasses.replace(setup, arc=dataclasses.replace(setup.arc, radiance_e=radiance_e))


def world_of(*args, **kwargs):
    return TrueWorld(setup_of(*args, **kwargs), np.eye(4))


def overfull_world():
    """A world whose stripe is beyond full well: blooming has something to spill."""
    world = world_of(width=80)
    laser = dataclasses.replace(world.setup.laser, peak_e=3.0e4)
    return dataclasses.replace(world, setup=dataclasses.replace(world.setup, laser=laser))


def pose(translation_mm=(2.0, 0.5, 1.0), turn_deg=(2.0, -3.0, 1.0)):
    T_base_tool = np.eye(4)
    T_base_tool[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T_base_tool[:3, 3] = translation_mm
    return T_base_tool


def moment_of(levels=BOTH, time_s=1.1, exposure_s=0.005):
    return Moment(
        index=round(10.0 * time_s),
        time_s=time_s,
        duration_s=2.3,
        pose_time_s=time_s,
        laser_level=levels[0],
        arc_level=levels[1],
        exposure_s=exposure_s,
        tool_height_mm=1.0,
    )


def studio_of(world, cache_dir=None):
    return Studio(world, (0.0, 10.0), cache_dir)


def charge_of(world, effects=(), levels=BOTH, T_base_tool=None, time_s=1.1, studio=None):
    """The expected charge of a frame with effects; `studio` is that of the world with its effects."""
    studio = studio_of(apply_world_effects(world, effects)) if studio is None else studio
    moment = apply_moment_effects(moment_of(levels, time_s), effects)
    # Without a pose the tool travels, and drifts to the left.
    travelled_mm = 8.0 * (moment.pose_time_s - 1.1)
    at = pose((2.0 + travelled_mm, 0.5 + 0.5 * travelled_mm, 1.0)) if T_base_tool is None else T_base_tool
    return expected_charge(studio, effects, moment, at, np.random.default_rng(5))

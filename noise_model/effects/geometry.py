"""Geometry: where camera and plate really are, and how the lens really projects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from noise_model.effects.effect import ANOTHER_VALUE, Effect, Stage, Values
from noise_model.fit import Parameter
from noise_model.setup import Setup
from noise_model.surface.joint import seam_frame
from noise_model.transforms import invert, moved, transform


def _hand_eye(setup: Setup, values: Values) -> Setup:
    turn_deg = [values[f"rot_{axis}_deg"] for axis in "xyz"]
    move_mm = [values[f"move_{axis}_mm"] for axis in "xyz"]
    T_tool_camera = moved(setup.camera.T_tool_camera, turn_deg, move_mm)
    return replace(setup, camera=replace(setup.camera, T_tool_camera=T_tool_camera))


def _surface_tilt(setup: Setup, values: Values) -> Setup:
    joint = setup.joint
    T_base_joint = seam_frame(joint, np.asarray(joint.seam_in_base_mm[0]))
    turn_deg = [values["roll_deg"], values["pitch_deg"], 0.0]
    T_base_tilted = moved(T_base_joint, turn_deg, np.zeros(3)) @ invert(T_base_joint)
    seam = transform(T_base_tilted, np.asarray(joint.seam_in_base_mm))
    R_base_tilted = T_base_tilted[:3, :3]
    nx, ny, nz = R_base_tilted @ np.asarray(joint.surface_normal_in_base)
    normals = None
    if joint.surface_normals_in_base is not None:
        turned = np.asarray(joint.surface_normals_in_base) @ R_base_tilted.T
        normals = tuple((float(x), float(y), float(z)) for x, y, z in turned)
    # Stations, and ridges with them, turn with the joint.
    x_0, y_0, z_0 = transform(T_base_tilted, np.asarray(joint.station_origin_mm))
    return replace(
        setup,
        joint=replace(
            joint,
            seam_in_base_mm=tuple((float(x), float(y), float(z)) for x, y, z in seam),
            surface_normal_in_base=(float(nx), float(ny), float(nz)),
            surface_normals_in_base=normals,
            station_origin_mm=(float(x_0), float(y_0), float(z_0)),
        ),
    )


def _lens_distortion(setup: Setup, values: Values) -> Setup:
    k1, k2, p1, p2, *more = setup.camera.distortion
    changed = (k1 + values["k1"], k2 + values["k2"], p1 + values["p1"], p2 + values["p2"], *more)
    return replace(setup, camera=replace(setup.camera, distortion=changed))


EFFECTS = (
    Effect(
        id="hand_eye",
        stage=Stage.GEOMETRY,
        summary="the camera's pose in the tool is off",
        equation="T_tool_camera' = T_tool_camera exp(turn, move), both in the camera's own frame",
        source="Tsai and Lenz 1989: hand-eye calibration. A stale one, of another bracket or tool, is off "
        "by degrees and centimetres",
        parameters=(
            *(Parameter(f"rot_{axis}_deg", "deg", 0.0, 0.5, -10.0, 10.0, 3e-4) for axis in "xyz"),
            *(Parameter(f"move_{axis}_mm", "mm", 0.0, 0.5, -20.0, 20.0, 5e-4) for axis in "xyz"),
        ),
        typical={"rot_x_deg": 0.5, "rot_z_deg": 0.5, "move_x_mm": 0.8},
        setup=_hand_eye,
        form_rel=ANOTHER_VALUE,
    ),
    Effect(
        id="surface_tilt",
        stage=Stage.GEOMETRY,
        summary="the plate is tilted",
        equation="the joint turned by roll about travel and pitch about the left, at the joint's origin",
        source="a rigid turn",
        parameters=(
            Parameter("roll_deg", "deg", 0.0, 2.0, -20.0, 20.0, 1e-3),
            Parameter("pitch_deg", "deg", 0.0, 2.0, -20.0, 20.0, 1e-3),
        ),
        typical={"roll_deg": 3.0, "pitch_deg": 2.0},
        setup=_surface_tilt,
        form_rel=ANOTHER_VALUE,
    ),
    Effect(
        id="lens_distortion",
        stage=Stage.GEOMETRY,
        summary="distortion is not the stated one",
        equation="OpenCV's k1, k2, p1, p2, added to the stated",
        source="Brown 1966; OpenCV's calib3d",
        parameters=(
            Parameter("k1", "", 0.0, 0.4, -3.0, 3.0, 1e-4),
            Parameter("k2", "", 0.0, 1.0, -30.0, 30.0, 1e-3),
            Parameter("p1", "", 0.0, 0.01, -0.2, 0.2, 1e-5),
            Parameter("p2", "", 0.0, 0.01, -0.2, 0.2, 1e-5),
        ),
        typical={"k1": -0.8},
        setup=_lens_distortion,
    ),
)

"""Small frames with effects: setups, conditions, and what light makes of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import scenes

from noise_model.condition import Condition
from noise_model.effects import apply_setup_effects, checked
from noise_model.effects.light import Light
from noise_model.forward import draw_frame, pass_on, predict
from noise_model.view import View

LEVEL = scenes.pose()
TURNED = scenes.pose((4.0, 0.5, 1.0), (3.0, -2.0, 4.0))
EXPOSURE_S = 0.005
LATE_S = 2.0

CONDITIONS = {
    "dark": Condition(0.0, 0.0, EXPOSURE_S, LATE_S),
    "laser": Condition(1.0, 0.0, EXPOSURE_S, LATE_S),
    "arc": Condition(0.0, 1.0, EXPOSURE_S, LATE_S),
    "both": Condition(1.0, 1.0, EXPOSURE_S, LATE_S),
}


def nominal(joint="v_groove", material="zn_coated", width=80, height=60, psf_sigma_px=0.7, **sensor):
    """A setup with a small camera; `sensor` changes the sensor."""
    of_camera = scenes.camera(width=width, height=height, psf_sigma_px=psf_sigma_px)
    setup = scenes.setup(joint, material, of_camera=of_camera)
    return dataclasses.replace(setup, sensor=dataclasses.replace(setup.sensor, **sensor))


def affected(setup, **effects):
    """The setup with effects."""
    return dataclasses.replace(setup, effects=checked(effects))


def charge(setup, condition, T_base_tool=LEVEL):
    """The frame's expected charge, float64."""
    return predict(setup, T_base_tool, condition).mean_e.astype(np.float64)


def draws(setup, condition, n, seed=1, T_base_tool=LEVEL, renderer=None):
    """n frames (n, H, W), DN, float64."""
    rng = np.random.default_rng(seed)
    frames = [draw_frame(setup, T_base_tool, condition, rng, renderer=renderer) for _ in range(n)]
    return np.array(frames, dtype=np.float64)


def passed(setup, light, condition=CONDITIONS["both"], rng=None, T_base_tool=LEVEL):
    """Light after the effects of a setup, the lens and the exposure; what comes in is changed."""
    true = apply_setup_effects(setup)
    pass_on(true, light, View.of(true, T_base_tool), condition, rng)
    return light


def light_of(arc, laser=None):
    """Light of images of the arc and the laser."""
    arc = np.asarray(arc, dtype=np.float32)
    return Light.of(arc, np.zeros_like(arc) if laser is None else np.asarray(laser, dtype=np.float32))


def rays(camera):
    """The pixels' rays (H, W, 3) of a pinhole camera, z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def on_the_plate(camera):
    """Where the rays of a camera on a level tool meet the plate: points and directions to the camera."""
    d = rays(camera) @ camera.T_tool_camera[:3, :3].T
    eye = camera.T_tool_camera[:3, 3]
    points = eye - eye[2] / d[..., 2:] * d
    return points, -d / np.linalg.norm(d, axis=-1, keepdims=True)


def cos4(camera):
    """cos^4 of the field angle (H, W)."""
    return np.sum(rays(camera) ** 2, axis=-1) ** -2.0

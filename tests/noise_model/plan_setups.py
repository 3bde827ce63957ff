"""Setups to plan with: every joint that has a seam, an arc as bright as the stripe, a small image."""

from __future__ import annotations

import math

import numpy as np

from noise_model.arc_source import Arc
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.sensor import Sensor
from noise_model.instrument.spectrum import Filter
from noise_model.setup import Setup
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import NOMINAL_SEAM, Joint, SeamLine

LINE = ((0.0, 0.0, 0.0), (300.0, 0.0, 0.0))
JOINTS = {
    "v_groove": Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0}, LINE),
    "lap": Joint("lap", {"thickness_mm": 2.0}, LINE),
    "corrugation": Joint(
        "corrugation", {"thickness_mm": 1.6, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0}, LINE
    ),
}


def plan_setup(joint: str, material: str, radiance_e: float = 1.5e8) -> Setup:
    """Return a camera ahead of the stripe that looks back at the torch, as wide as 400 px."""
    tilt = math.radians(24.0)
    T_tool_camera = np.eye(4)
    z_axis = np.array([-math.sin(tilt), 0.0, -math.cos(tilt)])
    x_axis = np.array([0.0, -1.0, 0.0])
    T_tool_camera[:3, :3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    T_tool_camera[:3, 3] = np.array([36.0, 0.0, 0.0]) - 145.0 * z_axis
    return Setup(
        camera=Camera(400, 300, 1400.0, 1400.0, 199.5, 149.5, T_tool_camera, exposure_s=0.005),
        sensor=Sensor(8, 80.0, 4.0, 45.0, 20400.0),
        filter=Filter(690.0, 10.0, 1.8),
        laser=Laser(690.0, (1.0, 0.0, 0.0, -35.0), (35.0, 0.0, 140.0), 0.45, 5000.0),
        arc=Arc(3.0, (0.0, 0.0, JOINTS[joint].dimensions.get("thickness_mm", 0.0)), radiance_e, 100.0, 1.3),
        material=TABLE_1[material],
        joint=JOINTS[joint],
    )


def steel_groove() -> Setup:
    """Return the V-groove in mild steel."""
    return plan_setup("v_groove", "mild_steel")


SETUPS = {joint: plan_setup(joint, "mild_steel") for joint in JOINTS}


def expected_e(
    setup: Setup, T_base_tool: Float64, laser: float = 0.0, arc: float = 0.0, seam: SeamLine = NOMINAL_SEAM
) -> Float64:
    """Return the rendered mean (H, W), e-, at the setup's own exposure."""
    condition = Condition(laser, arc, setup.camera.exposure_s)
    return predict(setup, T_base_tool, condition, seam=seam).mean_e.astype(np.float64)

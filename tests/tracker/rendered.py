"""Small frames rendered from the project's own forward model, and the setups and poses they are seen from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from noise_model.compiled.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import predict
from noise_model.instrument.sensor import expose
from noise_model.setup import Setup
from noise_model.surface.joint import NOMINAL_SEAM, SeamLine, seam_height_mm
from tracker.state import Frame, Pose

EXPOSURE_S, CURRENT_A, LASER_X_MM = 0.005, 100.0, 35.0
RADIANCE_E = {"corrugation": 2.0e6, "u_groove": 5.0e6}
USUAL_RADIANCE_E = 8.0e6
SEED = 20240607


def small_setup(joint: str, *, upright: bool = False, width: int = 320) -> Setup:
    """A zinc-coated joint before a camera of 320 x 240 px; `upright` rolls it by 90 deg: 240 x 320 px."""
    setup = nominal_setup(joint, "zn_coated", width=width, height=3 * width // 4)
    setup = replace(setup, arc=replace(setup.arc, radiance_e=RADIANCE_E.get(joint, USUAL_RADIANCE_E)))
    return rolled(setup) if upright else setup


def rolled(setup: Setup) -> Setup:
    """The same setup with its camera rolled by 90 deg: the stripe runs along the image's columns."""
    camera = setup.camera
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    return replace(
        setup,
        camera=replace(
            camera,
            width=camera.height,
            height=camera.width,
            cx=camera.cy,
            cy=camera.cx,
            T_tool_camera=camera.T_tool_camera @ roll,
        ),
    )


def pose_at(
    x_mm: float, y_mm: float = 0.0, z_mm: float = 0.0, turn_deg: tuple[float, ...] = (0, 0, 0)
) -> Pose:
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = x_mm, y_mm, z_mm
    T_base_tool[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    return Pose(T_base_tool)


def frame_of(
    setup: Setup,
    pose: Pose,
    seam: SeamLine = NOMINAL_SEAM,
    *,
    laser: float = 1.0,
    arc: float = 1.0,
    index: int = 0,
    of: Setup | None = None,
) -> Frame:
    """One frame as the sensor draws it; `of` is the true setup where it is not the one that is stated."""
    condition = Condition(laser_level=laser, arc_level=arc, exposure_s=EXPOSURE_S)
    mean = predict(of or setup, pose.T_base_tool, condition, seam=seam).mean_e
    image = expose(mean, setup.sensor, np.random.default_rng(SEED + index))
    return Frame(index, 0.1 * index, image, EXPOSURE_S, CURRENT_A, laser > 0.0, arc > 0.0)


def walk(
    setup: Setup,
    n: int,
    seam: SeamLine = NOMINAL_SEAM,
    step_mm: float = 10.0,
    start_mm: float = 0.0,
    **conditions: float,
) -> Iterator[tuple[Frame, Pose]]:
    """Frames along the seam and their poses."""
    for i in range(n):
        pose = pose_at(start_mm + step_mm * i)
        yield frame_of(setup, pose, seam, index=i, **conditions), pose


def true_seam_tool(setup: Setup, pose: Pose, seam: SeamLine = NOMINAL_SEAM) -> Float64:
    """The seam point in the laser plane for a plain joint along base's x axis, tool frame, mm."""
    direction = np.array([1.0, seam.slope_y, seam.slope_z])
    through = np.array([seam.station_mm, seam.y_mm, seam.z_mm + seam_height_mm(setup.joint)])
    R, t = pose.T_base_tool[:3, :3], pose.T_base_tool[:3, 3]
    start, along = R.T @ (through - t), R.T @ direction
    plane = np.asarray(setup.laser.plane_in_tool)
    return start - along * ((plane[:3] @ start + plane[3]) / (plane[:3] @ along))

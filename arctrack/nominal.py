"""Nominal setups to start from: one sensor, placed for each joint so that it sees the stripe.

A 690 nm sheet stands 35 mm ahead of the torch. All joints but a lap are seen from ahead, back towards the
arc; a lap from behind the torch, forward: there its upper sheet does not mirror the arc into the lens.
"""

from __future__ import annotations

import math

import numpy as np

from arctrack.errors import ArctrackError
from arctrack.limits import size_problem
from noise_model.arc_source import Arc
from noise_model.compiled.arrays import Float64
from noise_model.instrument.camera import Camera
from noise_model.instrument.laser import Laser
from noise_model.instrument.profiler import SENSOR, Profiler
from noise_model.instrument.sensor import Sensor
from noise_model.instrument.spectrum import Filter
from noise_model.setup import Setup
from noise_model.spelling import cure_for
from noise_model.surface.brdf import TABLE_1
from noise_model.surface.joint import Joint

DIMENSIONS: dict[str, dict[str, float]] = {
    "v_groove": {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": 1.0},
    "lap": {"thickness_mm": 2.0},
    "corrugation": {"thickness_mm": 1.6, "pitch_mm": 60.0, "height_mm": 8.0, "width_mm": 30.0},
    "butt": {"gap_mm": 1.0, "thickness_mm": 3.0},
    "fillet": {"included_angle_deg": 90.0},
    "half_v": {"bevel_angle_deg": 45.0, "depth_mm": 4.0, "root_gap_mm": 1.0},
    "u_groove": {"depth_mm": 6.0, "root_radius_mm": 3.0, "bevel_angle_deg": 20.0, "root_gap_mm": 1.0},
    "edge": {"gap_mm": 0.5, "thickness_mm": 4.0},
    "outside_corner": {"included_angle_deg": 90.0},
}
"""The dimensions, mm and deg, of the joints that a setup can be made for."""

PROFILE_AHEAD_MM, PROFILE_WIDTH_MM = 35.0, 38.4
"""Place of a nominal profiler's sheet ahead of the torch, and the width of its profiles."""

_ARC_HEIGHT_MM = {"lap": 2.0, "corrugation": 1.6, "fillet": 3.0}
"""The arc's height above the reference surface: on the upper sheet, between a fillet's plates."""


def nominal_setup(joint_type: str, material_name: str, *, width: int = 640, height: int = 480) -> Setup:
    """Return a setup to start from, for a joint and a material.

    `[arc] radiance_e` is 1 here: how bright the arc may be depends on aperture and filter, see
    `arctrack.simulation.simulate.balance`.

    Parameters
    ----------
    joint_type : str
        A joint of `arctrack.nominal.DIMENSIONS`, such as "v_groove".
    material_name : str
        A material of the paper's Table 1, "mild_steel" or "zn_coated".
    width, height : int
        The image's size, px; every size has the same field of view.

    Returns
    -------
    Setup
        The setup of a sensor that sees the stripe on this joint.

    Raises
    ------
    ArctrackError
        For a joint or a material that there is not, and for an image that is too large.
    """
    if joint_type not in DIMENSIONS:
        raise ArctrackError(f"there is no joint {joint_type!r}: {cure_for(joint_type, DIMENSIONS)}")
    if material_name not in TABLE_1:
        raise ArctrackError(f"there is no material {material_name!r}: {cure_for(material_name, TABLE_1)}")
    problem = size_problem(width, height)
    if problem is not None:
        raise ArctrackError(f"width, height: {problem}")
    focal_px = 2190.0 * width / 640.0
    camera = Camera(
        width=width,
        height=height,
        fx=focal_px,
        fy=focal_px,
        cx=(width - 1) / 2.0,
        cy=(height - 1) / 2.0,
        T_tool_camera=looking_at(
            (-20.0, 0.0, 135.0) if joint_type == "lap" else (95.0, 0.0, 130.0), (36.0, 0.0, 0.0)
        ),
        focal_length_mm=16.2,
    )
    return Setup(
        camera=camera,
        sensor=Sensor(bits=8, gain_e_per_dn=80.0, black_level_dn=4.0, read_noise_e=45.0, full_well_e=20400.0),
        filter=Filter(center_nm=690.0, fwhm_nm=10.0, effective_index=1.8),
        laser=Laser(
            wavelength_nm=690.0,
            plane_in_tool=(1.0, 0.0, 0.0, -35.0),
            origin_in_tool_mm=(35.0, 0.0, 140.0),
            stripe_sigma_mm=0.45,
            peak_e=5000.0,
        ),
        arc=Arc(
            radius_mm=3.0,
            center_in_tool_mm=(0.0, 0.0, _ARC_HEIGHT_MM.get(joint_type, 0.0)),
            radiance_e=1.0,
            current_a=100.0,
            current_exponent=1.3,
        ),
        material=TABLE_1[material_name],
        joint=Joint(
            type=joint_type,
            dimensions=dict(DIMENSIONS[joint_type]),
            seam_in_base_mm=((-100.0, 0.0, 0.0), (1000.0, 0.0, 0.0)),
        ),
    )


def with_profiler(setup: Setup, columns: int = 1280) -> Setup:
    """Return a setup with a laser profiler of so many columns in the place of its camera and laser.

    Its sheet is upright, where the nominal one is, and its profiles are as wide as the camera sees.
    """
    T_tool_profile = np.eye(4)
    T_tool_profile[0, 3] = PROFILE_AHEAD_MM
    profiler = Profiler(
        columns=columns,
        pitch_mm=PROFILE_WIDTH_MM / columns,
        range_mm=60.0,
        stand_off_mm=140.0,
        T_tool_profile=T_tool_profile,
        exposure_s=setup.camera.exposure_s,
    )
    return Setup(
        camera=profiler.camera,
        sensor=SENSOR,
        laser=profiler.laser,
        joint=setup.joint,
        tolerance=setup.tolerance,
        profiler=profiler,
    )


def looking_at(camera_mm: tuple[float, float, float], aim_mm: tuple[float, float, float]) -> Float64:
    """Return T_tool_camera, mm, of a camera that looks at a point; its x axis runs along -y."""
    z_axis = np.subtract(aim_mm, camera_mm) / math.dist(aim_mm, camera_mm)
    x_axis = np.array([0.0, -1.0, 0.0])
    T_tool_camera = np.eye(4)
    T_tool_camera[:3, :3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis])
    T_tool_camera[:3, 3] = camera_mm
    return T_tool_camera

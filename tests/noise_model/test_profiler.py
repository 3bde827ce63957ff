"""A profiler amounts to a pinhole camera before its sheet, without perspective within the sheet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.drawn_profile import trace_heights
from noise_model.instrument.profiler import SENSOR, Profiler
from noise_model.setup import Setup
from noise_model.surface.joint import Joint
from noise_model.transforms import invert, transform
from tracker.geometry import to_laser_plane

angles = st.floats(-20.0, 20.0)


def profiler(turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Profiler:
    T_tool_profile = np.eye(4)
    T_tool_profile[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    T_tool_profile[:3, 3] = 40.0, 3.0, -2.0
    return Profiler(800, 0.05, 60.0, 150.0, T_tool_profile)


def setup_of(sensor: Profiler, joint: Joint) -> Setup:
    return Setup(camera=sensor.camera, sensor=SENSOR, laser=sensor.laser, joint=joint, profiler=sensor)


def groove() -> Joint:
    return Joint(
        type="v_groove",
        dimensions={"included_angle_deg": 60.0, "depth_mm": 6.0, "root_gap_mm": 1.0},
        seam_in_base_mm=((0.0, 0.0, 0.0), (200.0, 0.0, 0.0)),
        surface_normal_in_base=(0.0, 0.0, 1.0),
    )


@given(st.tuples(angles, angles, angles))
def test_columns_and_heights_are_pixels_of_the_sheet(turn_deg: tuple[float, float, float]) -> None:
    sensor, rng = profiler(turn_deg), np.random.default_rng(0)
    z_mm = rng.uniform(-29.0, 29.0, sensor.columns)
    points_tool = transform(
        sensor.T_tool_profile, np.column_stack([np.zeros(sensor.columns), sensor.y_mm, z_mm])
    )
    image_px = sensor.camera.project(transform(invert(sensor.camera.T_tool_camera), points_tool))
    np.testing.assert_allclose(image_px[:, 0], np.arange(sensor.columns), atol=1e-6)
    np.testing.assert_allclose(image_px[:, 1], sensor.rows_px(z_mm), atol=1e-6)
    met, _ = to_laser_plane(setup_of(sensor, groove()), image_px)
    np.testing.assert_allclose(met, points_tool, atol=1e-6)


@given(st.lists(st.floats(-29.9, 29.9) | st.just(float("nan")), min_size=1, max_size=50))
def test_codes_give_heights_back(heights: list[float]) -> None:
    sensor, z_mm = profiler(), np.array(heights)
    back = sensor.z_mm(sensor.codes(z_mm))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(z_mm))
    assert np.nanmax(np.abs(back - z_mm), initial=0.0) <= 0.5 * sensor.step_mm + 1e-12


def test_what_lies_beyond_the_range_has_no_code() -> None:
    assert profiler().codes(np.array([-30.1, 30.1, np.inf])).tolist() == [0, 0, 0]


def test_errors_of_the_pose_move_camera_and_sheet_together() -> None:
    setup = setup_of(profiler(), groove())
    off = setup.with_errors({"move_z_mm": 0.5})
    middle_px = np.array([[400.0, 600.0]])
    moved_mm = to_laser_plane(off, middle_px)[0] - to_laser_plane(setup, middle_px)[0]
    np.testing.assert_allclose(moved_mm, [[0.0, 0.0, 0.5]], atol=1e-9)


def groove_heights(y_mm: Float64) -> Float64:
    """Heights of the groove's section: plates at 0, bevels of 30 deg from upright, a root of 1 mm."""
    return np.maximum(np.minimum(0.0, (np.abs(y_mm) - 0.5) / np.tan(np.radians(30.0)) - 6.0), -6.0)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (0.0, 0.0, 10.0), (0.0, 15.0, 0.0)])
def test_drawn_trace_is_the_section_where_the_sheet_cuts_it(turn_deg: tuple[float, float, float]) -> None:
    sensor = profiler(turn_deg)
    setup = setup_of(sensor, groove())
    T_base_tool = np.eye(4)
    T_base_tool[:3, 3] = 20.0, 0.0, 1.0
    z_mm = trace_heights(setup, make_scene(setup, T_base_tool))
    shown = np.flatnonzero(np.isfinite(z_mm))
    points = np.column_stack([np.zeros(len(shown)), sensor.y_mm[shown], z_mm[shown]])
    in_base = transform(T_base_tool @ sensor.T_tool_profile, points)
    assert len(shown) > 700
    np.testing.assert_allclose(in_base[:, 2], groove_heights(in_base[:, 1]), atol=1e-6)

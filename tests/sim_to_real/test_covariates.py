import numpy as np
import pytest

from noise_model.surface.joint import Joint, section
from sim_to_real.evidence.error_model import smooth_error
from sim_to_real.evidence.policy import POLICY
from sim_to_real.fit.covariates import concavity, covariates
from sim_to_real.fit.gauss_newton import refit
from tests.sim_to_real.small import small_recording


def nominal_fit(expected):
    """The model at its stated values."""
    return refit(expected, {}, expected.neutral, steps=0)


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    expected = small_recording(tmp_path_factory.mktemp("covariates") / "nominal", {})
    return expected, covariates(expected, nominal_fit(expected))


@pytest.mark.slow
def test_every_bin_that_counts_has_its_frame_light_and_noise(nominal):
    expected, values = nominal
    frames = expected.observed.frames
    assert len(values.frame) == sum(int(frame.keep.sum()) for frame in frames)
    recorded = np.concatenate([frame.kept_dn for frame in frames])
    r = nominal_fit(expected).residuals
    np.testing.assert_allclose(values.predicted_dn + r * values.sigma_dn, recorded, atol=1e-3)
    black = expected.observed.setup.sensor.black_level_dn
    np.testing.assert_allclose(black + values.light_dn, values.predicted_dn, atol=1e-3)
    frame = next(frame for frame in frames if frame.stratum == "both")
    assert np.array_equal(np.isfinite(values.image(frame.position, values.sigma_dn)), frame.keep)


def test_angles_and_distances_on_the_plate_are_those_of_rays_and_a_plane(nominal):
    expected, values = nominal
    setup = expected.observed.setup
    frame = next(frame for frame in expected.observed.frames if frame.stratum == "arc")
    chosen = np.flatnonzero((values.frame == frame.position) & (values.values["concavity"] == 0.0))[::7]
    T_base_tool = frame.T_base_tool_in(setup)
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera
    eye = T_base_camera[:3, 3]
    px = np.column_stack([values.values["column"][chosen], values.values["row"][chosen]])
    xy = (px - [setup.camera.cx, setup.camera.cy]) / [setup.camera.fx, setup.camera.fy]
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_base_camera[:3, :3].T
    points = eye - eye[2] / rays[:, 2:] * rays
    # The torch stands over the plate at the height that the setup states, wherever the tool is.
    center = T_base_tool[:3, :3] @ setup.arc.center_in_tool_mm + T_base_tool[:3, 3]
    center[2] = setup.arc.center_in_tool_mm[2]
    to_arc = center + np.array([0.0, 0.0, setup.arc.radius_mm / 2.0]) - points
    to_eye = eye - points
    *normal, offset_mm = setup.laser.plane_in_tool
    in_tool = (points - T_base_tool[:3, 3]) @ T_base_tool[:3, :3]

    def degrees(opposite, adjacent):
        return np.degrees(np.arctan2(opposite, adjacent))

    half = to_arc / np.linalg.norm(to_arc, axis=1)[:, None] + to_eye / np.linalg.norm(to_eye, axis=1)[:, None]
    azimuth = degrees(to_eye[:, 1], to_eye[:, 0]) - degrees(-to_arc[:, 1], -to_arc[:, 0])
    for name, should in {
        "distance": np.linalg.norm(center - points, axis=1),
        "theta_i": degrees(np.hypot(*to_arc[:, :2].T), to_arc[:, 2]),
        "theta_r": degrees(np.hypot(*to_eye[:, :2].T), to_eye[:, 2]),
        "half_angle": degrees(np.hypot(*half[:, :2].T), half[:, 2]),
        "phi_r": np.abs((azimuth + 180.0) % 360.0 - 180.0),
        "beside_sheet": in_tool @ normal + offset_mm,
        "field_angle": degrees(np.hypot(*xy.T), 1.0),
        "radius": np.hypot(px[:, 0] - setup.camera.cx, px[:, 1] - setup.camera.cy),
    }.items():
        np.testing.assert_allclose(values.values[name][chosen], should, atol=0.02, err_msg=name)


def test_what_a_frame_has_in_common(nominal):
    expected, values = nominal
    for frame in expected.observed.frames:
        chosen = values.frame == frame.position
        assert values.values["time"][chosen] == pytest.approx(frame.timestamp_s)
        assert values.values["exposure"][chosen] == pytest.approx(frame.condition.exposure_s)
        current_a = values.values["current"][chosen][0]
        level = (current_a / expected.observed.setup.arc.current_a) ** 1.3
        assert level == pytest.approx(frame.condition.arc_level, rel=1e-5)
        assert np.isnan(values.values["half_angle"][chosen]).all() == (frame.condition.arc_level == 0.0)
        moved_mm = (
            frame.pose_at(frame.timestamp_s + 0.02)[1, 3] - frame.pose_at(frame.timestamp_s - 0.02)[1, 3]
        )
        if abs(moved_mm) > 0.04 * 0.5:
            assert (values.values["velocity_sign"][chosen] == np.sign(moved_mm)).all()


def test_a_point_in_a_groove_loses_the_sky_that_its_faces_hide():
    groove = section(
        Joint(
            "v_groove",
            {"included_angle_deg": 70.0, "depth_mm": 4.0, "root_gap_mm": 0.0},
            ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        )
    )
    lean = np.radians(35.0)
    on_left_face = np.array([[5.0, -2.0 * np.tan(lean), -2.0]])
    normal = np.array([[0.0, np.cos(lean), np.sin(lean)]])
    # Crossed strings: the opposite face from root to mouth, seen from the point.
    mouth, root = np.array([4.0 * np.tan(lean), 0.0]), np.array([0.0, -4.0])

    def sine(end):
        to_end = end - on_left_face[0, 1:]
        return (to_end @ [np.sin(lean), -np.cos(lean)]) / np.linalg.norm(to_end)

    hidden = 0.5 * (sine(root) - sine(mouth))
    assert concavity(on_left_face, normal, groove) == pytest.approx([hidden], abs=1e-9)
    plate = concavity(np.array([[5.0, -9.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), groove)
    assert plate == pytest.approx([0.0], abs=1e-12)


def test_beside_a_lap_the_wall_hides_its_form_factor():
    lap = section(Joint("lap", {"thickness_mm": 2.0}, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))))
    below = concavity(np.array([[0.0, 3.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), lap)
    above = concavity(np.array([[0.0, -3.0, 2.0]]), np.array([[0.0, 0.0, 1.0]]), lap)
    # A wall h high beside a point d away: (1 - d / sqrt(d^2 + h^2)) / 2.
    assert below == pytest.approx([0.5 * (1.0 - 3.0 / np.hypot(3.0, 2.0))], abs=1e-6)
    assert above == pytest.approx([0.0], abs=1e-12)


@pytest.mark.slow
def test_a_face_that_reflects_more_than_stated_is_the_model_s_own_error(nominal):
    _, values = nominal
    columns = smooth_error(values, POLICY).astype(np.float64)
    for face in np.unique(values.face):
        brighter = POLICY.face_rel * np.where(values.face == face, values.arc_dn / values.sigma_dn, 0.0)
        size, *_ = np.linalg.lstsq(columns, brighter, rcond=None)
        np.testing.assert_allclose(columns @ size, brighter, atol=1e-3 * brighter.max(initial=1e-9))

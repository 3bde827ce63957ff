from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arctrack.recording import read_recording
from arctrack.recording.poses import pose_at
from arctrack.simulate import SimulationPlan, simulate_recording
from noise_model.fit import Parameter
from noise_model.surface import Joint, section
from sim_to_real.covariates import UNITS, Covariates, Start, concavity, covariates
from sim_to_real.expected import Expected
from sim_to_real.observed import observe

EXAMPLE = Path(__file__).parents[2] / "examples" / "v_groove"
SMALL = 6
"""By so much the example's camera is coarser here."""


def planted(n_frames=24, shape=(24, 32), seed=0):
    """Covariates of made-up frames: arc light that falls off aside, a stripe across, every bin counted."""
    draw = np.random.default_rng(seed)
    n = shape[0] * shape[1]
    row, column = (np.tile(part.ravel(), n_frames).astype(np.float32) for part in np.indices(shape))
    frame = np.repeat(np.arange(n_frames), n)
    arc_on, laser_on = frame % 6 >= 2, ~np.isin(frame % 6, (0, 2))
    current = np.where(arc_on, np.where(frame % 3 == 0, 140.0, 100.0), 0.0)
    place = 30.0 * draw.random(n_frames)[frame]
    distance = 20.0 + np.hypot(column - place, 0.7 * row)
    arc_dn = np.where(arc_on, current / 100.0 * 2e5 / distance**2.2, 0.0)
    in_stripe = laser_on & (np.abs(row - 8.0 - 6.0 * draw.random(n_frames)[frame]) < 3.0)
    laser_dn = np.where(in_stripe, 60.0 * (1.0 + 0.3 * np.sin(column / 6.0)), 0.0)
    angles = {name: 20.0 + 40.0 * draw.random(len(frame)) for name in UNITS if UNITS[name] == "deg"}
    radius = np.hypot(row - shape[0] / 2.0, column - shape[1] / 2.0)
    values = angles | {
        "distance": np.where(arc_on, distance, np.nan),
        "field_angle": radius / 5.0,
        "gray_level": 4.0 + arc_dn + laser_dn,
        "exposure": np.where(frame % 5 == 0, 0.0025, 0.005),
        "current": current,
        "time": 0.1 * frame,
        "velocity_sign": np.sign(np.sin(frame * 0.9)),
        "concavity": np.where(column < 10, 0.4, 0.0),
        "row": row,
        "column": column,
        "radius": radius,
    }
    return Covariates(
        shape,
        {name: values[name].astype(np.float32) for name in UNITS},
        frame.astype(np.int32),
        np.tile(np.arange(n, dtype=np.int32), n_frames),
        (laser_on + 2 * arc_on).astype(np.int8),
        in_stripe,
        np.ones(len(frame), dtype=np.float32),
        arc_dn.astype(np.float32),
        laser_dn.astype(np.float32),
        values["gray_level"].astype(np.float32),
        np.zeros((len(frame), 9), dtype=np.float32),
        tuple(Parameter(f"p{n}", "", 0.0, 1.0, -3.0, 3.0, 0.1) for n in range(9)),
        np.zeros(9),
    )


def small_recording(path, effects):
    """An expected recording of the example's sensor with a coarse camera, 12 frames, its seam nominal."""
    setup = read_recording(EXAMPLE).setup
    camera = setup.camera
    coarse = replace(
        camera,
        width=camera.width // SMALL,
        height=camera.height // SMALL,
        fx=camera.fx / SMALL,
        fy=camera.fy / SMALL,
        cx=(camera.cx + 0.5) / SMALL - 0.5,
        cy=(camera.cy + 0.5) / SMALL - 0.5,
    )
    plan = SimulationPlan(frames=12, seam_wander_mm=0.0, exact=True)
    simulate_recording(path, replace(setup, camera=coarse), plan, hidden_effects=effects)
    recording = read_recording(path)
    poses = recording.pose_buffer()
    observed = observe(recording.setup, list(recording.frames()), lambda t: pose_at(poses, t))
    seam = replace(observed.seam, mean_mm=np.zeros_like(observed.seam.mean_mm))
    expected = Expected(replace(observed, seam=seam))
    expected.take_tangents(expected.neutral, {})
    return expected


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    expected = small_recording(tmp_path_factory.mktemp("covariates") / "nominal", {})
    return expected, covariates(expected, Start.of(expected))


def test_every_bin_that_counts_has_its_frame_light_and_noise(nominal):
    expected, of = nominal
    frames = expected.observed.frames
    assert len(of.frame) == sum(int(frame.keep.sum()) for frame in frames)
    assert of.n_frames == len(frames)
    recorded = np.concatenate([frame.kept_dn for frame in frames])
    r = Start.of(expected).residuals
    np.testing.assert_allclose(of.predicted_dn + r * of.sigma_dn, recorded, atol=1e-3)
    black = expected.observed.setup.sensor.black_level_dn
    np.testing.assert_allclose(black + of.light_dn, of.predicted_dn, atol=1e-3)
    frame = next(frame for frame in frames if frame.stratum == "both")
    assert np.array_equal(np.isfinite(of.image(frame.position, of.sigma_dn)), frame.keep)


def test_angles_and_distances_on_the_plate_are_those_of_rays_and_a_plane(nominal):
    expected, of = nominal
    setup = expected.observed.setup
    frame = next(frame for frame in expected.observed.frames if frame.stratum == "arc")
    chosen = np.flatnonzero((of.frame == frame.position) & (of.values["concavity"] == 0.0))[::7]
    T_base_tool = frame.T_base_tool_in(setup)
    T_base_camera = T_base_tool @ setup.camera.T_tool_camera
    eye = T_base_camera[:3, 3]
    px = np.column_stack([of.values["column"][chosen], of.values["row"][chosen]])
    xy = (px - [setup.camera.cx, setup.camera.cy]) / [setup.camera.fx, setup.camera.fy]
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_base_camera[:3, :3].T
    points = eye - eye[2] / rays[:, 2:] * rays
    # The torch stands over the plate at the height that the setup states, wherever the tool is.
    center = T_base_tool[:3, :3] @ setup.arc.center_in_tool_mm + T_base_tool[:3, 3]
    center[2] = setup.arc.center_in_tool_mm[2]
    to_arc = center + np.array([0.0, 0.0, setup.arc.radius_mm / 2.0]) - points
    to_eye = eye - points

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
        "field_angle": degrees(np.hypot(*xy.T), 1.0),
        "radius": np.hypot(px[:, 0] - setup.camera.cx, px[:, 1] - setup.camera.cy),
    }.items():
        np.testing.assert_allclose(of.values[name][chosen], should, atol=0.02, err_msg=name)


def test_what_a_frame_has_in_common(nominal):
    expected, of = nominal
    for frame in expected.observed.frames:
        chosen = of.frame == frame.position
        assert of.values["time"][chosen] == pytest.approx(frame.timestamp_s)
        assert of.values["exposure"][chosen] == pytest.approx(frame.condition.exposure_s)
        current_a = of.values["current"][chosen][0]
        level = (current_a / expected.observed.setup.arc.current_a) ** 1.3
        assert level == pytest.approx(frame.condition.arc_level, rel=1e-5)
        assert np.isnan(of.values["half_angle"][chosen]).all() == (frame.condition.arc_level == 0.0)
        moved_mm = (
            frame.pose_at(frame.timestamp_s + 0.02)[1, 3] - frame.pose_at(frame.timestamp_s - 0.02)[1, 3]
        )
        if abs(moved_mm) > 0.04 * 0.5:
            assert (of.values["velocity_sign"][chosen] == np.sign(moved_mm)).all()


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

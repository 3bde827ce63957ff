"""The camera's pose from the arc's light: one that is off is found, what cannot be trusted is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from calibration import hand_eye_arc
from calibration.hand_eye_arc import (
    MAX_ERROR_RATIO,
    _ArcHandEyeProblem,
    _sightings,
    estimate_hand_eye,
    seam_sigma_mm,
)
from noise_model.arc.scene import make_scene
from noise_model.condition import Condition
from noise_model.fit import Fit
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import invert, moved, transform
from tracker.geometry import SensorGeometry, to_laser_plane
from tracker.seam_observations import SeamObservations
from tracker.state import Frame, Pose

CHANGE = np.array([0.04, -0.09, 0.03, 0.03, 0.04, -0.03])
CHI2_6 = 16.8
"""The quantile of chi^2 of six degrees of freedom that one of a hundred exceeds."""

LEVEL = 0.1
"""How closely the arc's level comes out: levels of frames, the arc's height and radius trade with it."""


def small_setup() -> Setup:
    setup = nominal_setup("v_groove", "mild_steel", width=320, height=240)
    return replace(setup, arc=replace(setup.arc, radiance_e=1.6e8))


def frames(
    seen_by: Setup,
    seam: SeamLine | Callable[[float], SeamLine],
    arc_on: bool = True,
    apart_mm: float = 4.0,
) -> list[tuple[Frame, Pose]]:
    """Render a few frames, each with another pose of the tool and the seam there straight."""
    rng = np.random.default_rng(7)
    made = []
    for i in range(6):
        T_base_tool = np.eye(4)
        T_base_tool[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-2.0, 2.0, 3), degrees=True).as_matrix()
        T_base_tool[:3, 3] = [apart_mm * i, rng.uniform(-0.8, 0.8), rng.uniform(-0.5, 1.5)]
        condition = Condition(laser_level=float(i % 2), arc_level=1.05 if arc_on else 0.0, exposure_s=0.005)
        line = seam if isinstance(seam, SeamLine) else seam(apart_mm * i + 35.0)
        image = draw_frame(seen_by, T_base_tool, condition, rng, seam=line)
        frame = Frame(i, 0.1 * i, image, 0.005, 100.0 if arc_on else 0.0, bool(i % 2), arc_on)
        made.append((frame, Pose(T_base_tool)))
    return made


def problem_of(setup: Setup, posed: list[tuple[Frame, Pose]]) -> _ArcHandEyeProblem:
    return _ArcHandEyeProblem.of(
        setup, _sightings(setup, posed), [(frame, pose.T_base_tool) for frame, pose in posed]
    )


def mahalanobis2(found: Fit) -> float:
    """Return the squared distance of the camera found from the true one, in its covariance."""
    off = found.values[:6] - CHANGE
    return float(off @ np.linalg.solve(found.covariance[:6, :6], off))


@pytest.mark.slow
def test_a_camera_that_is_off_is_found() -> None:
    setup = small_setup()
    true_pose = moved(setup.camera.T_tool_camera, CHANGE[:3], CHANGE[3:6])
    true_setup = replace(setup, camera=replace(setup.camera, T_tool_camera=true_pose))
    found = estimate_hand_eye(setup, frames(true_setup, SeamLine(45.0, 0.4, -0.2)))
    assert mahalanobis2(found.fit) < CHI2_6
    # Across the seam the arc's fall-off is steep: there six small frames are enough to learn from.
    assert found.seam_sigma_after_mm[0] < MAX_ERROR_RATIO * found.seam_sigma_before_mm[0]
    assert found.fit.value("rot_y") == pytest.approx(CHANGE[1], abs=2.0 * found.fit.sigma("rot_y"))
    assert found.fit.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=LEVEL)
    # In height they tell too little: together that is no clear gain.
    assert found.error_ratio > MAX_ERROR_RATIO
    assert not found.is_gain


@pytest.mark.slow
def test_the_expected_error_before_is_what_the_tracker_states_of_the_tolerance() -> None:
    setup = small_setup()
    posed = frames(setup, SeamLine())
    sightings = _sightings(setup, posed)
    tolerance = setup.tolerance
    prior = np.diag([tolerance.hand_eye_deg**2] * 3 + [tolerance.hand_eye_mm**2] * 3)
    sigma_mm = seam_sigma_mm(setup, sightings, prior)
    points_tool, _ = to_laser_plane(setup, sightings.image_px)
    field = SensorGeometry.of(setup).calibration_field
    variances_mm2 = [
        np.sum((field.moves_mm(point) @ make_scene(setup, pose(0.0)).T_joint_tool[1:3, :3].T) ** 2, axis=0)
        for pose, point in zip(sightings.poses, points_tool, strict=True)
    ]
    np.testing.assert_allclose(sigma_mm, np.sqrt(np.mean(variances_mm2, axis=0)), rtol=0.01)
    assert seam_sigma_mm(setup, sightings, 0.25 * prior) == pytest.approx(0.5 * sigma_mm, rel=1e-9)


@pytest.mark.slow
def test_a_camera_far_beyond_its_tolerance_is_refused() -> None:
    setup = small_setup()
    far = moved(setup.camera.T_tool_camera, 15.0 * CHANGE[:3], 15.0 * CHANGE[3:6])
    far_setup = replace(setup, camera=replace(setup.camera, T_tool_camera=far))
    with pytest.raises(ValueError, match="of its stated sigmas"):
        estimate_hand_eye(setup, frames(far_setup, SeamLine())[:3])


@pytest.mark.slow
def test_an_arc_that_is_far_darker_than_stated_is_refused() -> None:
    setup = small_setup()
    dark = replace(setup, arc=replace(setup.arc, radiance_e=0.01 * setup.arc.radiance_e))
    with pytest.raises(ValueError, match="off by a factor of 20"):
        estimate_hand_eye(setup, frames(dark, SeamLine())[:3])


def exact_black_level() -> Setup:
    setup = small_setup()
    return replace(setup, tolerance=replace(setup.tolerance, black_level_dn=0.0))


@pytest.fixture(scope="module")
def n_residuals_of_all() -> int:
    setup = exact_black_level()
    return estimate_hand_eye(setup, frames(setup, SeamLine())).fit.n_residuals


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [{0, 2}, set(range(6))])
def test_an_unknown_current_is_left_out_unless_all_are_and_the_black_level_may_be_exact(
    unknown: set[int], n_residuals_of_all: int
) -> None:
    setup = exact_black_level()
    seen = [
        (replace(frame, current_a=math.nan) if frame.index in unknown else frame, pose)
        for frame, pose in frames(setup, SeamLine())
    ]
    found = estimate_hand_eye(setup, seen)
    assert found.fit.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=LEVEL)
    assert abs(found.fit.value("black_level")) < 0.01
    share = found.fit.n_residuals / n_residuals_of_all
    assert share == pytest.approx(1.0 if len(unknown) == 6 else 4.0 / 6.0, abs=0.1)


def test_without_arc_there_is_nothing_to_go_by() -> None:
    setup = small_setup()
    with pytest.raises(ValueError, match="no frame has the arc on"):
        estimate_hand_eye(setup, frames(setup, SeamLine(), arc_on=False))


def wave(amplitude_mm: float, length_mm: float) -> Callable[[float], SeamLine]:
    def line_at(station_mm: float) -> SeamLine:
        phase = 2.0 * math.pi * station_mm / length_mm
        slope = amplitude_mm * 2.0 * math.pi / length_mm * math.cos(phase)
        y_mm = amplitude_mm * math.sin(phase)
        return SeamLine(station_mm, y_mm, 0.5 * y_mm, slope, 0.5 * slope)

    return line_at


@pytest.mark.slow
def test_a_seam_may_wander() -> None:
    setup = small_setup()
    true_pose = moved(setup.camera.T_tool_camera, CHANGE[:3], CHANGE[3:6])
    true_setup = replace(setup, camera=replace(setup.camera, T_tool_camera=true_pose))
    seen = frames(true_setup, wave(0.8, 100.0), apart_mm=8.0)
    found = estimate_hand_eye(setup, seen)
    assert mahalanobis2(found.fit) < CHI2_6
    assert found.seam_sigma_after_mm[0] < MAX_ERROR_RATIO * found.seam_sigma_before_mm[0]


@pytest.mark.slow
def test_a_joint_with_faces_in_shadow_is_no_hindrance() -> None:
    setup = nominal_setup("corrugation", "mild_steel", width=320, height=240)
    setup = replace(setup, arc=replace(setup.arc, radiance_e=1.6e8))
    # The last frames look at what lies behind a ridge.
    seen = frames(setup, SeamLine(), apart_mm=10.0)
    problem = problem_of(setup, seen)
    x = np.zeros(len(problem.parameters))
    arc_e, _ = problem.light(problem.choose(x)[-1:], x)
    assert (arc_e == 0.0).mean() > 0.05
    found = estimate_hand_eye(setup, seen).fit
    assert found.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=LEVEL)
    assert np.abs(found.values[:6] / found.sigmas[:6]).max() < 3.0


@pytest.mark.slow
def test_what_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = small_setup()
    seen = frames(setup, SeamLine(45.0, 0.4, -0.2))[:3]
    stated = moved(setup.camera.T_tool_camera, 5.0 * CHANGE[:3], 5.0 * CHANGE[3:6])
    setup = replace(setup, camera=replace(setup.camera, T_tool_camera=stated))
    monkeypatch.setattr(hand_eye_arc, "MAX_ROUNDS", 1)
    with pytest.raises(ValueError, match="camera and seam do not settle in 1 rounds"):
        estimate_hand_eye(setup, seen)


@pytest.mark.slow
def test_pixels_that_see_another_face_are_told() -> None:
    setup = small_setup()
    problem = problem_of(setup, frames(setup, SeamLine()))
    x = np.zeros(len(problem.parameters))
    views = problem.choose(x)
    curve, seam = problem.curve, np.zeros(problem.curve.n_modes)
    for aside_mm, least, most in ((0.0, 0.0, 0.0), (0.2, 0.0, 0.01), (2.0, 0.02, 1.0)):
        aside = replace(curve, mean_mm=curve.mean_mm + np.array([[aside_mm], [0.0]]))
        # Of all views: which pixels one of them compares follows the frames' noise.
        lost = np.mean([np.isnan(view.light(setup, problem.rays, aside, seam)[0]).mean() for view in views])
        assert least <= lost <= most


@pytest.mark.slow
def test_frames_count_where_the_seam_is_known_under_their_stripe() -> None:
    setup = small_setup()
    posed = []
    for x_mm in (5.0, 150.0, 305.0):
        T_base_tool = np.eye(4)
        T_base_tool[0, 3] = x_mm
        frame = Frame(0, 0.0, np.zeros((240, 320), np.uint8), 0.005, 100.0, False, True)
        posed.append((frame, T_base_tool))
    # Seen from where the first frame stands and from where the last does, and nowhere between.
    seen = [*np.arange(-10.0, 20.0), *np.arange(290.0, 320.0)]
    poses = []
    for x_mm in seen:
        T_base_tool = np.eye(4)
        T_base_tool[0, 3] = x_mm
        poses.append(lambda _, T=T_base_tool: T)
    root_camera = transform(invert(setup.camera.T_tool_camera), np.array([[35.0, 0.0, -4.0]]))
    root_px = setup.camera.project(root_camera)[0]
    n = len(seen)
    sightings = SeamObservations(np.tile(root_px, (n, 1)), np.zeros(n), np.full((n, 2), 1e-4), tuple(poses))
    known = [T_base_tool[0, 3] for _, T_base_tool in _ArcHandEyeProblem.of(setup, sightings, posed).lit]
    assert known == [5.0, 305.0]
    with pytest.raises(ValueError, match="the joint was found near no frame with the arc on"):
        _ArcHandEyeProblem.of(setup, sightings, posed[1:2])


@pytest.mark.slow
def test_frames_without_a_pixel_to_compare_are_refused() -> None:
    setup = small_setup()
    bright = [
        (replace(frame, image_dn=np.full_like(frame.image_dn, 255)), pose)
        if not frame.laser_on
        else (replace(frame, arc_on=False, current_a=0.0), pose)
        for frame, pose in frames(setup, SeamLine())
    ]
    with pytest.raises(ValueError, match=r"no pixel .* below saturation, .*: shorten the exposure"):
        estimate_hand_eye(setup, bright)

"""The camera's pose from the arc's light: one that is off is found, what cannot be trusted is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arctrack.nominal import nominal_setup
from calibration import hand_eye
from calibration.hand_eye import _tracked, _View, _with_seam, estimate_hand_eye
from noise_model.condition import Condition
from noise_model.forward import draw_frame
from noise_model.setup import Setup
from noise_model.surface.joint import SeamLine
from noise_model.transforms import moved
from tracker.geometry import SensorGeometry
from tracker.seam.gaussian_process import SeamHistory
from tracker.state import Frame, Pose
from tracker.step import TrackerState

CHANGE = np.array([0.04, -0.09, 0.03, 0.03, 0.04, -0.03])
LATTICE_PX = 6


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


@pytest.mark.slow
def test_a_camera_that_is_off_is_found() -> None:
    setup = small_setup()
    true_pose = moved(setup.camera.T_tool_camera, CHANGE[:3], CHANGE[3:6])
    true_setup = replace(setup, camera=replace(setup.camera, T_tool_camera=true_pose))
    found = estimate_hand_eye(setup, frames(true_setup, SeamLine(45.0, 0.4, -0.2)), lattice_px=LATTICE_PX)
    pull = (found.fit.values[:6] - CHANGE) / found.fit.sigmas[:6]
    assert np.abs(pull).max() < 3.0
    # Across the seam the arc's fall-off is steep: there six small frames are enough to learn from.
    assert found.fit.sigma("rot_y") < 0.5 * setup.tolerance.hand_eye_deg
    assert found.fit.value("rot_y") == pytest.approx(CHANGE[1], abs=0.4 * abs(CHANGE[1]))
    assert found.fit.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=0.02)


@pytest.mark.slow
def test_a_camera_far_beyond_its_tolerance_is_refused() -> None:
    setup = small_setup()
    far = moved(setup.camera.T_tool_camera, 15.0 * CHANGE[:3], 15.0 * CHANGE[3:6])
    far_setup = replace(setup, camera=replace(setup.camera, T_tool_camera=far))
    with pytest.raises(ValueError, match="of its stated sigmas"):
        estimate_hand_eye(setup, frames(far_setup, SeamLine()), lattice_px=LATTICE_PX)


@pytest.mark.slow
def test_an_arc_that_is_far_darker_than_stated_is_refused() -> None:
    setup = small_setup()
    dark = replace(setup, arc=replace(setup.arc, radiance_e=0.01 * setup.arc.radiance_e))
    with pytest.raises(ValueError, match="off by a factor of 20"):
        estimate_hand_eye(setup, frames(dark, SeamLine()), lattice_px=LATTICE_PX)


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [{0, 2}, set(range(6))])
def test_an_unknown_current_is_left_out_unless_all_are_and_the_black_level_may_be_exact(
    unknown: set[int],
) -> None:
    setup = small_setup()
    setup = replace(setup, tolerance=replace(setup.tolerance, black_level_dn=0.0))
    seen = [
        (replace(frame, current_a=math.nan) if frame.index in unknown else frame, pose)
        for frame, pose in frames(setup, SeamLine())
    ]
    found = estimate_hand_eye(setup, seen, lattice_px=LATTICE_PX)
    assert found.fit.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=0.02)
    assert abs(found.fit.value("black_level")) < 0.01
    of_all = estimate_hand_eye(setup, frames(setup, SeamLine()), lattice_px=LATTICE_PX)
    share = found.fit.n_residuals / of_all.fit.n_residuals
    assert share == pytest.approx(1.0 if len(unknown) == 6 else 4.0 / 6.0, abs=0.1)


def test_without_arc_there_is_nothing_to_go_by() -> None:
    setup = small_setup()
    with pytest.raises(ValueError, match="no frame has the arc on"):
        estimate_hand_eye(setup, frames(setup, SeamLine(), arc_on=False), lattice_px=LATTICE_PX)


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
    found = estimate_hand_eye(setup, seen, lattice_px=LATTICE_PX).fit
    pull = (found.values[:6] - CHANGE) / found.sigmas[:6]
    assert np.abs(pull).max() < 3.0
    assert found.sigma("rot_y") < 0.5 * setup.tolerance.hand_eye_deg


@pytest.mark.slow
def test_a_joint_with_faces_in_shadow_is_no_hindrance() -> None:
    setup = nominal_setup("corrugation", "mild_steel", width=320, height=240)
    setup = replace(setup, arc=replace(setup.arc, radiance_e=1.6e8))
    # The last frames look at what lies behind a ridge.
    seen = frames(setup, SeamLine(), apart_mm=10.0)
    last = _with_seam(setup, seen, _tracked(setup, seen))[-1]
    view = _View.of(SensorGeometry.of(setup), last, last.tracked, LATTICE_PX)
    assert (view.mean_e(setup, 1.0, 0.0, last.tracked) == 0.0).mean() > 0.05
    found = estimate_hand_eye(setup, seen, lattice_px=LATTICE_PX).fit
    assert found.value("ln_arc_level") == pytest.approx(np.log(1.05), abs=0.02)
    assert np.abs(found.values[:6] / found.sigmas[:6]).max() < 3.0


@pytest.mark.slow
def test_what_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    setup = small_setup()
    monkeypatch.setattr(hand_eye, "MAX_ROUNDS", 1)
    with pytest.raises(ValueError, match="camera and seam do not settle in 1 rounds"):
        estimate_hand_eye(setup, frames(setup, SeamLine(45.0, 0.4, -0.2)), lattice_px=LATTICE_PX)


def test_pixels_that_see_another_face_are_told() -> None:
    setup = small_setup()
    seen = frames(setup, SeamLine())
    one = _with_seam(setup, seen, _tracked(setup, seen))[2]
    view = _View.of(SensorGeometry.of(setup), one, one.tracked, LATTICE_PX)
    assert np.isfinite(view.residual(setup, 1.0, 0.0, one.tracked)).all()
    beside = replace(one.tracked, y_mm=one.tracked.y_mm + 0.2)
    assert np.isfinite(view.residual(setup, 1.0, 0.0, beside)).all()
    assert view.shift_px(setup, beside) < 4.0
    away = replace(one.tracked, y_mm=one.tracked.y_mm + 2.0)
    assert np.isnan(view.residual(setup, 1.0, 0.0, away)).mean() > 0.02
    assert view.shift_px(setup, away) > 8.0


def test_of_a_long_recording_each_frame_has_the_history_that_knows_its_seam() -> None:
    setup = small_setup()
    early, late = (
        TrackerState(history=SeamHistory(stations, np.full((20, 2), y_mm), np.full((20, 2), 1e-4)))
        for stations, y_mm in ((np.arange(30.0, 50.0), 0.3), (np.arange(330.0, 350.0), -0.4))
    )
    posed = []
    for x_mm in (5.0, 150.0, 305.0):
        T_base_tool = np.eye(4)
        T_base_tool[0, 3] = x_mm
        posed.append((Frame(0, 0.0, np.zeros((240, 320), np.uint8), 0.005, 100.0), Pose(T_base_tool)))
    found = _with_seam(setup, posed, [early, late])
    # In the middle nothing was tracked.
    assert [one.tracked.y_mm for one in found] == pytest.approx([0.3, -0.4], abs=0.01)
    with pytest.raises(ValueError, match="the joint was found near no frame with the arc on"):
        _with_seam(setup, posed[1:2], [early, late])


def test_frames_without_a_pixel_to_compare_are_refused() -> None:
    setup = small_setup()
    bright = [
        (replace(frame, image_dn=np.full_like(frame.image_dn, 255)), pose)
        if not frame.laser_on
        else (replace(frame, arc_on=False, current_a=0.0), pose)
        for frame, pose in frames(setup, SeamLine())
    ]
    with pytest.raises(ValueError, match=r"no pixel .* below saturation, .*: shorten the exposure"):
        estimate_hand_eye(setup, bright, lattice_px=LATTICE_PX)

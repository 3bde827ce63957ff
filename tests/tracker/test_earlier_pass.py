"""A pass that follows an earlier one again: fused with what it sees, without the laser, and fail-closed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from rendered import pose_at, small_setup

from tracker.checks import FrameChecks
from tracker.seam.correction import UNSTATED, AxisCorrection, Correction
from tracker.seam.earlier_pass import EarlierPass, KnownSeam, tool_tilt_deg
from tracker.seam.gaussian_process import NO_HISTORY, SeamHistory
from tracker.seam.locate import SeamSource
from tracker.state import Frame, Pose, Track
from tracker.steer import SeamAtTorch, seam_at_torch
from tracker.tracker import Tracker
from tracker.tracker_state import TrackerMemory

V = small_setup("v_groove")
SOURCE = SeamSource.of(V)
ENDLESS = (-math.inf, math.inf)
STATIONS_MM = np.arange(0.0, 61.0)


def history_of(y_mm: float, z_mm: float, sigma_mm: float = 0.03) -> SeamHistory:
    """A straight seam measured each mm from 0 to 60 mm."""
    n = len(STATIONS_MM)
    return SeamHistory(STATIONS_MM.copy(), np.tile((y_mm, z_mm), (n, 1)), np.full((n, 2), sigma_mm**2))


def earlier_pass(y_mm: float = 1.0, z_mm: float = -0.4, **changes: object) -> EarlierPass:
    before = EarlierPass(history_of(y_mm, z_mm), 0.05, (0.01, 0.04), np.zeros(len(STATIONS_MM)))
    return before._replace(**changes)


def at_torch(
    history: SeamHistory, earlier: EarlierPass, torch_mm: float, correction: Correction = UNSTATED
) -> tuple[SeamAtTorch, tuple[str, ...]]:
    frame_checks = FrameChecks()
    known = KnownSeam(SOURCE, history, earlier)
    seam = seam_at_torch(frame_checks, known, correction, torch_mm, ENDLESS)
    return seam, Track(0, 0.0, frame_checks.flags).flag_names


def test_where_nothing_is_seen_the_earlier_pass_is_followed_with_its_sigma() -> None:
    seam, raised = at_torch(NO_HISTORY, earlier_pass(), 30.0)
    np.testing.assert_allclose(seam.displacement_mm, (1.0, -0.4), atol=2e-3)
    # What has moved since does not average out over 60 measurements; their noise does.
    assert 0.05 < seam.sigma_mm[0] < 0.055
    assert raised == ("pass_followed",)


@pytest.mark.parametrize("station_mm", [-5.0, 3.0, 777.3, 1996.0, 2003.0])
def test_of_a_long_seam_the_measurements_about_a_station_tell_it(station_mm: float) -> None:
    stations_mm = np.arange(0.5, 2000.0)
    waves_mm = np.column_stack([np.sin(stations_mm / 40.0), 0.5 * np.cos(stations_mm / 70.0)])
    whole = SeamHistory(stations_mm, waves_mm, np.full((2000, 2), 0.03**2))
    near = KnownSeam(SOURCE, NO_HISTORY, EarlierPass(whole)).before(station_mm)
    far = SOURCE.seam_at(whole, station_mm)
    apart_mm = np.abs(np.subtract(near.displacement_mm, far.displacement_mm))
    assert (apart_mm < 0.2 * np.array(far.sigma_mm)).all()
    np.testing.assert_allclose(near.sigma_mm, far.sigma_mm, rtol=0.02)
    assert (near.first_mm, near.last_mm) == (far.first_mm, far.last_mm) == (0.5, 1999.5)


def test_both_count_by_their_sigmas() -> None:
    before = earlier_pass(1.0, -0.4)
    apart = history_of(1.2, -0.4, 0.3)
    known = KnownSeam(SOURCE, apart, before)
    seam, raised = at_torch(apart, before, 30.0)
    seen, earlier = SOURCE.seam_at(apart, 30.0), known.before(30.0)
    assert earlier is not None
    weights = np.array([seen.sigma_mm[0] ** -2, earlier.sigma_mm[0] ** -2])
    values = np.array([seen.displacement_mm[0], earlier.displacement_mm[0]])
    assert seam.displacement_mm[0] == pytest.approx(weights @ values / weights.sum())
    assert seam.sigma_mm[0] == pytest.approx(weights.sum() ** -0.5)
    # The better of the two names the source.
    assert (raised == ("pass_followed",)) == (weights[1] > weights[0])
    sharp, raised = at_torch(history_of(1.1, -0.4, 0.01), before, 30.0)
    assert raised == ()
    assert abs(sharp.displacement_mm[0] - 1.1) < abs(sharp.displacement_mm[0] - 1.0)


def test_errors_of_the_fused_seam_are_as_its_sigma_says() -> None:
    rng = np.random.default_rng(5)
    scores = []
    for _ in range(200):
        y_mm, z_mm = rng.normal(0.0, 2.0, 2)
        moved_mm = rng.normal(0.0, 0.05, 2)
        seen = history_of(y_mm, z_mm)
        before = history_of(y_mm + moved_mm[0], z_mm + moved_mm[1])
        for history in (seen, before):
            history.displacements_mm[:] += rng.normal(0.0, 0.03, history.displacements_mm.shape)
        # The sensor has seen to 20 mm, the torch is at 40.
        part = SeamHistory(*(np.ascontiguousarray(values[:21]) for values in seen[:3]))
        seam, _ = at_torch(part, earlier_pass(history=before), 40.0)
        scores.append((np.array(seam.displacement_mm) - (y_mm, z_mm)) / seam.sigma_mm)
    assert 0.85 < np.sqrt(np.mean(np.square(scores))) < 1.15


@pytest.mark.parametrize(
    ("history", "earlier", "torch_mm", "flag"),
    [
        (history_of(1.0, -0.4), EarlierPass(), 30.0, "pass_unusable"),
        (history_of(2.0, -0.4), earlier_pass(), 30.0, "pass_contradicted"),
        (history_of(1.0, 0.4), earlier_pass(), 30.0, "pass_contradicted"),
        (NO_HISTORY, earlier_pass(), 71.0, "offset_unknown"),
        (NO_HISTORY, earlier_pass(), -90.0, "offset_unknown"),
        (NO_HISTORY, earlier_pass(moved_sigma_mm=0.51), 30.0, "offset_unknown"),
    ],
)
def test_nothing_is_sent_of_what_is_not_known(
    history: SeamHistory, earlier: EarlierPass, torch_mm: float, flag: str
) -> None:
    seam, raised = at_torch(history, earlier, torch_mm)
    assert np.isnan([seam.displacement_mm, seam.sigma_mm]).all()
    assert flag in raised


def blind_track(pose: Pose, earlier: EarlierPass, correction: Correction = UNSTATED) -> Track:
    """Track a frame that shows nothing, of a pass without the laser."""
    tracker = Tracker(V, correction=correction)
    tracker.state = TrackerMemory(earlier=earlier._replace(uses_laser=False))
    image_dn = np.zeros(tracker.geometry.frame_form[0], tracker.geometry.frame_form[1])
    return tracker.step(Frame(0, 0.0, image_dn, 0.005), pose)


def test_without_the_laser_the_torch_is_sent_onto_the_displaced_seam() -> None:
    displaced = Correction(y=AxisCorrection(bias_mm=2.0), z=AxisCorrection(bias_mm=1.5))
    track = blind_track(pose_at(30.0), earlier_pass(), displaced)
    np.testing.assert_allclose((track.offset_y_mm, track.offset_z_mm), (3.0, 1.1), atol=2e-3)
    assert track.flag_names == ("laser_off", "pass_followed")
    assert not track.valid
    # The calibration's part of the earlier pass counts: sigma 0.21 mm in z of a tolerance of 0.5.
    without = blind_track(pose_at(30.0), earlier_pass(calibration_variance_mm2=(0.0, 0.0)), displaced)
    assert track.offset_confidence < without.offset_confidence


def test_without_the_laser_the_sensor_may_stand_anywhere() -> None:
    """A torch that goes back over the seam has its sensor behind: no pose of it is refused."""
    turned = pose_at(30.0, turn_deg=(0, 0, 180))
    assert blind_track(turned, earlier_pass()).offset_y_mm == pytest.approx(1.0, abs=2e-3)


def test_a_tool_that_leans_otherwise_than_the_pass_is_sent_nothing() -> None:
    leaning = pose_at(30.0, turn_deg=(25, 0, 0))
    assert tool_tilt_deg(leaning.T_base_tool) == pytest.approx(25.0)
    upright = earlier_pass()
    track = blind_track(leaning, upright)
    assert math.isnan(track.offset_y_mm)
    assert "pass_tilted" in track.flag_names
    stated = upright._replace(tilts_deg=np.full(len(STATIONS_MM), 20.0))
    assert blind_track(leaning, stated).offset_y_mm == pytest.approx(1.0, abs=2e-3)


def test_a_pose_that_is_none_is_refused_without_the_laser_too() -> None:
    wrong = pose_at(30.0)
    track = blind_track(replace(wrong, T_base_tool=2.0 * wrong.T_base_tool), earlier_pass())
    assert math.isnan(track.offset_y_mm)
    assert "pose_refused" in track.flag_names

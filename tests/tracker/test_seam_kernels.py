"""What a step asks of a pose and where it looks for the seam, against NumPy twins."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendered import pose_at, small_setup

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Float64
from noise_model.surface.joint import SeamLine, corrugation_height, seam_frame, seam_height_mm
from noise_model.transforms import invert, inverted, moved_point, multiplied, transform
from tracker.seam.expected import expect_seam, pose_numbers
from tracker.seam.gaussian_process import (
    CAPACITY,
    MIN_VARIANCE_MM2,
    MODEL_SIGMA_MM,
    SPACING_MM,
    SeamHistory,
)
from tracker.seam.locate import SeamSource, locate, sources

JOINTS = "v_groove", "lap", "corrugation"
TURNS_DEG = st.tuples(*[st.floats(-20.0, 20.0)] * 3)
seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=30)
@given(TURNS_DEG, st.floats(-50.0, 50.0))
def test_small_matrices_are_numpys(turn_deg: tuple[float, float, float], x_mm: float) -> None:
    T, other = pose_at(x_mm, 1.0, -2.0, turn_deg).T_base_tool, pose_at(3.0, 4.0, 5.0).T_base_tool
    point = np.array([x_mm, -3.0, 7.0])
    np.testing.assert_allclose(inverted(T), invert(T), atol=1e-12)
    np.testing.assert_allclose(multiplied(T, other), T @ other, atol=1e-12)
    np.testing.assert_allclose(moved_point(T, point), transform(T, point), atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(JOINTS), TURNS_DEG)
def test_what_is_asked_of_a_pose_is_its_twin(name: str, turn_deg: tuple[float, float, float]) -> None:
    setup = small_setup(name)
    T, laser = pose_at(10.0, 0.7, 1.0, turn_deg).T_base_tool, setup.laser
    laser_base = transform(T, laser.origin_mm)
    T_base_joint = seam_frame(setup.joint, laser_base)
    told = pose_numbers(SeamSource.of(setup), T)
    assert told.is_rotation
    assert told.height_mm == pytest.approx((laser_base - T_base_joint[:3, 3]) @ T_base_joint[:3, 2])
    crossing = abs(T[:3, :3] @ laser.plane[:3] @ T_base_joint[:3, 0])
    assert told.crossing == pytest.approx(crossing)
    assert told.ahead_mm == pytest.approx(T[:3, :3] @ laser.point_mm @ T_base_joint[:3, 0])


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(JOINTS), TURNS_DEG, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_located_seam_lies_in_the_sheet_and_where_it_was_put(
    name: str, turn_deg: tuple[float, float, float], y_mm: float, z_mm: float
) -> None:
    setup = small_setup(name)
    source = SeamSource.of(setup)
    T = pose_at(10.0, 0.7, 1.0, turn_deg).T_base_tool
    nominal = make_scene(setup, T)
    found = locate(source, T, nominal, y_mm, z_mm)
    point = np.array(found.seam_tool_mm)
    assert setup.laser.plane[:3] @ point + setup.laser.plane[3] == pytest.approx(0.0, abs=1e-7)
    station, y, z = transform(nominal.T_joint_tool, point)
    ridge_mm = float(corrugation_height(station, nominal.shape.corrugation))
    assert found.station_mm == pytest.approx(station)
    assert y == pytest.approx(y_mm, abs=1e-9)
    assert z - ridge_mm == pytest.approx(z_mm, abs=1e-7)
    above_mm = seam_height_mm(setup.joint)
    assert found.displacement_mm == pytest.approx((y_mm, z_mm - above_mm), abs=1e-7)


@pytest.mark.parametrize("name", JOINTS)
def test_the_expected_seam_is_where_the_history_meets_the_sheet(name: str) -> None:
    """Expected twice: where it is met goes with how high it is expected there."""
    setup, history = small_setup(name), SeamHistory()
    source, T = SeamSource.of(setup), pose_at(10.0, 0.7).T_base_tool
    for station in np.arange(20.0, 50.0, 2.0):
        history = history.with_measurement(float(station), (0.01 * station, -0.2), (1e-4, 1e-4))
    expected = expect_seam(source, T, history)
    scene = make_scene(setup, T)
    ahead_mm = float(transform(scene.T_joint_tool, setup.laser.point_mm)[0])
    (y, z), _ = history.at(ahead_mm)
    met = locate(source, T, scene, float(y), float(z) + seam_height_mm(setup.joint))
    twin = history.point_at(met.station_mm)
    place = twin.displacement_mm, twin.slope, max(twin.slope_sigma)
    assert tuple(expected.line) == pytest.approx((met.station_mm, *np.hstack(place)))
    assert expected.sigma_mm == pytest.approx(twin.sigma_mm)


@pytest.mark.parametrize("name", JOINTS)
def test_the_nominal_frame_is_the_scenes(name: str) -> None:
    setup = small_setup(name)
    source, T = SeamSource.of(setup), pose_at(10.0, 0.7, 1.0, (2.0, -3.0, 4.0)).T_base_tool
    expected, scene = expect_seam(source, T, SeamHistory()), make_scene(setup, T)
    np.testing.assert_allclose(expected.T_joint_tool, scene.T_joint_tool, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_is_no_pose_raises_nothing(wrong: float) -> None:
    source = SeamSource.of(small_setup("corrugation"))
    assert not pose_numbers(source, np.full((4, 4), wrong)).is_rotation


@pytest.mark.parametrize("name", JOINTS)
def test_camera_and_laser_stand_over_the_tangent_plane(name: str) -> None:
    setup, station = small_setup(name), 31.0
    scene = make_scene(setup, pose_at(10.0, 0.7, 1.0, (2.0, -3.0, 4.0)).T_base_tool, SeamLine(30.0, 0.5))
    ahead, here, behind = corrugation_height(station + np.array([0.5, 0.0, -0.5]), scene.shape.corrugation)
    places = scene.T_joint_camera[:3, 3], transform(scene.T_joint_tool, setup.laser.origin_mm)
    for place, told in zip(places, sources(SeamSource.of(setup), scene, station), strict=True):
        x = place[0] - station
        np.testing.assert_allclose(told, [x, place[1], place[2] - here - (ahead - behind) * x], rtol=1e-9)


@settings(deadline=None, max_examples=20)
@given(TURNS_DEG)
def test_the_torchs_station_is_that_of_its_own_segment(turn_deg: tuple[float, float, float]) -> None:
    setup = small_setup("v_groove")
    T = pose_at(10.0, 0.7, 1.0, turn_deg).T_base_tool
    scene, expected = make_scene(setup, T), expect_seam(SeamSource.of(setup), T, SeamHistory())
    own = invert(seam_frame(setup.joint, T[:3, 3])) @ T
    assert expected.torch_mm == pytest.approx(own[0, 3])
    points = np.asarray(setup.joint.seam_in_base_mm)[[0, -1]]
    stations = transform(scene.T_joint_tool @ invert(T), points)[:, 0]
    assert expected.ends_mm == pytest.approx(tuple(stations))


def plain_history(seen: list[tuple[float, Float64, Float64]]) -> tuple[Float64, Float64, Float64]:
    """Measurements as a history keeps them, by lists: stations, displacements, variances."""
    kept: list[tuple[float, Float64, Float64]] = []
    began_mm = math.nan
    for station, displacement, variance in seen:
        noise = np.maximum(variance, MIN_VARIANCE_MM2)
        if abs(station - began_mm) < SPACING_MM:
            at, latest, before = kept.pop()
            before = np.maximum(before - MODEL_SIGMA_MM**2, MIN_VARIANCE_MM2)
            share = before / (before + noise)
            at += float(share.mean()) * (station - at)
            kept.append((at, latest + share * (displacement - latest), share * noise + MODEL_SIGMA_MM**2))
            continue
        *others, latest_one = kept or [None]
        kept = [one for one in others if abs(one[0] - station) >= SPACING_MM]
        kept = ([*kept, latest_one] if latest_one else kept)[1 - CAPACITY :]
        kept.append((station, displacement, noise + MODEL_SIGMA_MM**2))
        began_mm = station
    stations, displacements, variances = zip(*kept, strict=True)
    return np.array(stations), np.array(displacements), np.array(variances)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(1, 260), st.floats(0.05, 3.0))
def test_a_history_keeps_what_its_twin_keeps(seed: int, n: int, step_mm: float) -> None:
    rng, history, seen = np.random.default_rng(seed), SeamHistory(), []
    station = 0.0
    for _ in range(n):
        # To and fro: the sensor comes back to where it has been.
        station += step_mm * rng.choice([1.0, 1.0, 1.0, -1.0]) * rng.uniform(0.2, 1.0)
        seen.append((station, rng.normal(size=2), rng.uniform(0.0, 0.1, 2) * (rng.random() < 0.9)))
        history = history.with_measurement(*seen[-1])
    stations, displacements, variances = plain_history(seen)
    np.testing.assert_allclose(history.stations_mm, stations, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(history.displacements_mm, displacements, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(history.variances_mm2, variances, rtol=1e-9)

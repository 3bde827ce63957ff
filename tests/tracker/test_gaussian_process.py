"""The seam along the path against a dense Gaussian process, and the offset at the torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import twins
from hypothesis import given, settings
from hypothesis import strategies as st

from tracker.seam.gaussian_process import (
    BEND_LENGTH_MM,
    BEND_SIGMA_MM,
    CAPACITY,
    MIN_VARIANCE_MM2,
    MODEL_SIGMA_MM,
    NO_HISTORY,
    SLOPE_SIGMA,
    SPACING_MM,
    WIDE_SIGMA_MM,
    SeamHistory,
)

PRIOR_SIGMA = math.hypot(WIDE_SIGMA_MM, BEND_SIGMA_MM)
seeds = st.integers(0, 2**32 - 1)


def history_of(stations: np.ndarray, displacements: np.ndarray, variances: np.ndarray) -> SeamHistory:
    history = SeamHistory()
    for station, displacement, variance in zip(stations, displacements, variances, strict=True):
        history = history.with_measurement(float(station), displacement, variance)
    return history


def dense(stations: np.ndarray, values: np.ndarray, variances: np.ndarray, at: float) -> tuple[float, float]:
    """Condition the joint normal law of all displacements, by its precision matrix."""
    everywhere = np.append(stations, at)
    K = twins.seam_prior(
        everywhere[:, None] - everywhere, WIDE_SIGMA_MM, BEND_SIGMA_MM, BEND_LENGTH_MM
    ) + np.diag(np.append(variances + MODEL_SIGMA_MM**2, 0.0))
    K[-1, -1] += 1e-12
    precision = np.linalg.inv(K)
    mean = -precision[-1, :-1] @ values / precision[-1, -1]
    return float(mean), float(precision[-1, -1] ** -0.5)


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(1, 40))
def test_the_seam_is_the_dense_process(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    stations = np.cumsum(rng.uniform(1.0, 4.0, n))
    displacements, variances = rng.normal(0.0, 2.0, (n, 2)), rng.uniform(1e-4, 0.1, (n, 2))
    history = history_of(stations, displacements, variances)
    at = float(rng.uniform(-60.0, stations[-1] + 60.0))
    value, sigma = history.at(at)
    for axis in range(2):
        mean, spread = dense(stations, displacements[:, axis], variances[:, axis], at)
        assert value[axis] == pytest.approx(mean, rel=1e-5, abs=1e-5)
        assert sigma[axis] == pytest.approx(spread, rel=1e-4, abs=1e-5)


def test_without_measurements_it_is_the_programmed_path() -> None:
    value, sigma = SeamHistory().at(123.0)
    np.testing.assert_array_equal(value, 0.0)
    np.testing.assert_allclose(sigma, PRIOR_SIGMA)
    assert not SeamHistory().is_measured(123.0)


def test_sigma_grows_outside_the_measured_stretch() -> None:
    stations = np.arange(0.0, 40.0, 1.0)
    history = history_of(stations, np.zeros((40, 2)), np.full((40, 2), 0.01))
    inside = history.at(20.0)[1]
    outside = np.array([history.at(39.0 + d)[1][0] for d in (0.0, 5.0, 10.0, 20.0, 40.0, 80.0, 1e4)])
    assert (inside < outside[0]).all()
    assert (np.diff(outside) > 0.0).all()
    assert outside[-1] < PRIOR_SIGMA
    assert history.is_measured(20.0)
    assert not history.is_measured(40.0)


def test_a_straight_seam_gives_its_own_line() -> None:
    stations = np.arange(100.0, 160.0, 1.0)
    displacements = np.column_stack([1.0 + 0.01 * stations, 2.0 - 0.005 * stations])
    history = history_of(stations, displacements, np.full((60, 2), 1e-4))
    there = history.point_at(130.0)
    assert there.displacement_mm == pytest.approx((2.3, 1.35), abs=2e-3)
    assert there.slope == pytest.approx((0.01, -0.005), abs=5e-4)


def test_a_slope_is_as_unsure_as_it_is_before_it_is_measured() -> None:
    assert max(SeamHistory().point_at(5.0).slope_sigma) == pytest.approx(SLOPE_SIGMA)
    sigmas = []
    for length_mm in (2.0, 10.0, 40.0):
        stations = np.arange(0.0, length_mm, 1.0)
        displacements, variances = np.zeros((len(stations), 2)), np.full((len(stations), 2), 0.03**2)
        sigmas.append(history_of(stations, displacements, variances).point_at(length_mm).slope_sigma[0])
    assert SLOPE_SIGMA > sigmas[0] > sigmas[1] > sigmas[2]
    assert sigmas[1] < 0.5 * SLOPE_SIGMA


def test_a_shifted_seam_is_shifted_at_the_torch_too() -> None:
    stations = np.arange(35.0, 60.0, 2.0)
    history = history_of(
        stations, np.tile([3.0, -1.0], (len(stations), 1)), np.full((len(stations), 2), 1e-3)
    )
    offset, sigma = history.at(40.0)
    np.testing.assert_allclose(offset, [3.0, -1.0], atol=0.01)
    assert (sigma < 0.03).all()


@pytest.mark.parametrize("spacing_mm", [0.0, 1e-9, 0.05])
def test_repeated_stations_stay_solvable(spacing_mm: float) -> None:
    rng = np.random.default_rng(1)
    n = 3 * CAPACITY
    values = rng.normal(1.0, 0.1, (n, 2))
    history = history_of(spacing_mm * np.arange(n), values, np.zeros((n, 2)))
    value, sigma = history.at(spacing_mm * n)
    assert np.isfinite(value).all()
    np.testing.assert_allclose(value, 1.0, atol=0.3)
    assert (sigma > 0.0).all()
    assert (sigma < 0.1).all()


@pytest.mark.parametrize("variance_mm2", [0.0, 1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("frame_spacing_mm", [0.02, 0.1, 0.5, 0.99, 1.0, 2.0])
def test_the_look_ahead_is_remembered_at_any_frame_rate(frame_spacing_mm: float, variance_mm2: float) -> None:
    """A torch 60 mm behind the sensor still stands on the measured stretch, on its own part of the seam."""
    stations = np.arange(0.0, 200.0, frame_spacing_mm)
    drifting = np.column_stack([0.02 * stations, 2.0 - 0.01 * stations])
    history = history_of(stations, drifting, np.full((len(stations), 2), variance_mm2))
    assert history.n <= CAPACITY
    torch = float(stations[-1]) - 60.0
    assert history.is_measured(torch)
    offset, sigma = history.at(torch)
    np.testing.assert_allclose(offset, [0.02 * torch, 2.0 - 0.01 * torch], atol=0.01)
    assert (sigma < 0.1).all()


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.floats(0.3, 1.0), st.floats(4.0, 30.0))
def test_a_sensor_that_goes_to_and_fro_forgets_nothing_behind_it(step_mm: float, turn_mm: float) -> None:
    """It is measured up to 50 mm; then back and forth before that, a hundred times over."""
    there = np.arange(0.0, 50.0, step_mm)
    back_and_forth = 50.0 - turn_mm * np.abs(
        (np.arange(100.0 * turn_mm / step_mm) * step_mm / turn_mm) % 2 - 1
    )
    history = history_of(there, np.zeros((len(there), 2)), np.full((len(there), 2), 1e-4))
    n = history.n
    for station in back_and_forth:
        history = history.with_measurement(float(station), np.full(2, 0.2), np.full(2, 1e-4))
    assert history.is_measured(1.0)
    assert history.n <= n + turn_mm
    # What is seen again is as it was seen last.
    assert history.at(50.0 - turn_mm / 2)[0] == pytest.approx(0.2, abs=0.05)


def test_what_lies_close_together_is_its_mean() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(1.0, 0.1, (50, 2))
    history = history_of(np.linspace(10.0, 10.9, 50), values, np.full((50, 2), 0.01))
    assert history.n == 1
    np.testing.assert_allclose(history.displacements_mm[0], values.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(history.variances_mm2[0], 0.01 / 50 + MODEL_SIGMA_MM**2)
    assert history.stations_mm[0] == pytest.approx(10.45, abs=1e-6)


def test_its_sigma_is_honest() -> None:
    """Seams drawn from the prior, measured with noise: error over sigma is about 1, within and beyond."""
    rng = np.random.default_rng(1)
    stations = np.arange(0.0, 60.0, 3.0)
    everywhere = np.concatenate([stations, [31.0, 80.0]])
    K = twins.seam_prior(everywhere[:, None] - everywhere, WIDE_SIGMA_MM, BEND_SIGMA_MM, BEND_LENGTH_MM)
    root = np.linalg.cholesky(K + 1e-10 * np.eye(len(K)))
    errors = []
    for _ in range(300):
        seam = root @ rng.normal(size=(len(K), 2))
        measured = seam[:-2] + rng.normal(0.0, math.hypot(0.1, MODEL_SIGMA_MM), (len(stations), 2))
        history = history_of(stations, measured, np.full((len(stations), 2), 0.01))
        found = [history.at(31.0), history.at(80.0)]
        errors.append([(value - true) / sigma for (value, sigma), true in zip(found, seam[-2:], strict=True)])
    chi2 = np.mean(np.square(errors), axis=(0, 2))
    print(f"chi2 of the stated sigma: {chi2[0]:.3f} within, {chi2[1]:.3f} beyond the measured stretch")
    assert ((chi2 > 0.85) & (chi2 < 1.15)).all()


def with_measurement(
    before: SeamHistory, station_mm: float, place_mm: np.ndarray, mm2: np.ndarray
) -> SeamHistory:
    """Return a history with one more measurement: averaged with the latest, or in place of near ones."""
    stations_mm, places_mm, variances_mm2, began_mm = before
    noise_mm2 = np.maximum(mm2, MIN_VARIANCE_MM2)
    if abs(station_mm - began_mm) < SPACING_MM:
        kept = np.arange(before.n) < before.n - 1
        latest_mm2 = np.maximum(variances_mm2[-1] - MODEL_SIGMA_MM**2, MIN_VARIANCE_MM2)
        share = latest_mm2 / (latest_mm2 + noise_mm2)
        place_mm, noise_mm2 = places_mm[-1] + share * (place_mm - places_mm[-1]), share * noise_mm2
        station_mm = stations_mm[-1] + share.mean() * (station_mm - stations_mm[-1])
    else:
        began_mm, kept = station_mm, np.abs(stations_mm - station_mm) >= SPACING_MM
        kept[-1:] = True
        kept &= np.cumsum(kept[::-1])[::-1] < CAPACITY
    return SeamHistory(
        np.append(stations_mm[kept], station_mm),
        np.vstack([places_mm[kept], place_mm]),
        np.vstack([variances_mm2[kept], noise_mm2 + MODEL_SIGMA_MM**2]),
        began_mm,
    )


@pytest.mark.parametrize("step_mm", [0.2, 0.9, 1.7])
def test_a_history_is_its_twin_on_a_way_to_and_fro(step_mm: float) -> None:
    rng = np.random.default_rng(3)
    got = want = NO_HISTORY
    for k in range(3 * CAPACITY):
        there = (
            40.0 * step_mm * math.sin(0.03 * k) + step_mm * k,
            rng.normal(size=2),
            10.0 ** rng.uniform(-14, -1, 2),
        )
        got, want = got.with_measurement(*there), with_measurement(want, *there)
        for ours, twin in zip(got, want, strict=True):
            np.testing.assert_allclose(ours, twin, rtol=1e-12, atol=1e-12)
    assert got.n > 30

"""The exposure that shows a stripe best, against the bound of all parameters and against drawn frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arctrack.nominal import nominal_setup
from noise_model.instrument.sensor import linearise, respond, variance_e2
from noise_model.plan.cramer_rao import POSITION, stripe_sigmas
from noise_model.plan.exposure import (
    NODES,
    POLICY,
    SATURATED_SIGMAS,
    better_exposure_s,
    expected_sigma_px,
    ladder_s,
)

SENSOR = replace(nominal_setup("v_groove", "mild_steel").sensor, gamma=1.0, bend=0.0)
RATES = st.floats(1e3, 1e7)
SCENES = st.tuples(RATES, st.floats(0.8, 5.0), st.floats(0.0, 1e7))


def sigma_at(t_s, scene, **options):
    peak, width, background = (np.array([value]) for value in scene)
    return expected_sigma_px(np.atleast_1d(t_s), peak, width, background, SENSOR, **options)


@given(SCENES, st.floats(1e-5, 1e-2))
def test_without_saturation_it_is_the_bound_with_all_parameters_unknown(scene, t_s):
    peak, width, background = scene
    mean_e = t_s * (peak * np.exp(-0.5 * NODES**2) + background)
    variance = variance_e2(mean_e, SENSOR) + (POLICY.map_share * background * t_s) ** 2
    if np.any(mean_e + SATURATED_SIGMAS * np.sqrt(variance) >= top_e()):
        return
    spacing_px = width * (NODES[1] - NODES[0])
    bound = stripe_sigmas(
        (width * NODES)[None], np.array([peak * t_s]), np.array([width]), variance[None], spacing_px
    )[0, POSITION]
    assert sigma_at(t_s, scene)[0] == pytest.approx(bound, rel=1e-6)


@given(SCENES, st.floats(1e-4, 1e-2), st.floats(0.1, 0.99))
def test_a_laser_that_is_on_all_the_exposure_is_never_worse(scene, t_s, duty):
    peak, width, background = scene
    pulsed = sigma_at(t_s, (duty * peak, width, background), speed_px_s=20.0)
    assert sigma_at(duty * t_s, scene, speed_px_s=20.0)[0] <= pulsed[0] * (1.0 + 1e-9)


@given(SCENES)
def test_a_choice_is_on_the_ladder_better_by_enough_and_stays(scene):
    rungs_s = ladder_s(1e-4, 1e-2)
    assert rungs_s[0] == 1e-4
    assert 1e-2 / POLICY.step < rungs_s[-1] <= 1e-2 * (1.0 + 1e-9)
    current_s = 3e-3
    sigma = sigma_at(np.append(rungs_s, current_s), scene)
    chosen_s = better_exposure_s(current_s, rungs_s, sigma)
    if chosen_s == current_s:
        assert sigma[:-1].min() >= (1.0 - POLICY.gain) * sigma[-1]
        return
    assert chosen_s in rungs_s
    assert sigma_at(chosen_s, scene)[0] < (1.0 - POLICY.gain) * sigma[-1]
    again = sigma_at(np.append(rungs_s, chosen_s), scene)
    assert better_exposure_s(chosen_s, rungs_s, again) == chosen_s


def test_where_nothing_is_told_nothing_changes():
    assert better_exposure_s(3e-3, np.array([1e-3, 2e-3]), np.full(3, np.inf)) == 3e-3


@pytest.mark.parametrize("seed", range(6))
def test_drawn_frames_scatter_as_expected_and_are_best_where_it_says(seed):
    rng = np.random.default_rng(seed)
    peak, background = 10.0 ** rng.uniform(5.0, 6.5, 2)
    width, speed_px_s = rng.uniform(1.0, 2.5), rng.uniform(0.0, 300.0)
    rungs_s = ladder_s(2e-4, 2e-2, 2.0)
    expected = sigma_at(rungs_s, (peak, width, background), speed_px_s=speed_px_s)
    drawn = np.array([drawn_sigma_px(rng, t_s, peak, width, background, speed_px_s) for t_s in rungs_s])
    # Where a whole half of the stripe is cut, next to nothing is left to compare.
    told = expected < 4.0 * expected.min()
    np.testing.assert_allclose(drawn[told], expected[told], rtol=0.25)
    assert drawn[np.argmin(expected)] <= 1.15 * drawn[told].min()


def top_e() -> float:
    return min(SENSOR.full_well_e, float(linearise(SENSOR.max_dn, SENSOR)))


def drawn_sigma_px(rng, t_s, peak, width, background, speed_px_s, frames=1500):
    """Return how the centre scatters that a fit of all five parameters finds in drawn scan lines."""
    wide = np.hypot(width, speed_px_s * t_s / np.sqrt(12.0))
    x = np.arange(-np.floor(4.0 * wide), np.floor(4.0 * wide) + 1.0)
    moved = speed_px_s * t_s * np.linspace(-0.5, 0.5, 41)
    shape = np.exp(-0.5 * ((x[:, None] - moved) / width) ** 2).mean(axis=1)
    map_error = 1.0 + POLICY.map_share * rng.standard_normal((frames, len(x)))
    true_e = t_s * (peak * shape + background * map_error)
    charge = rng.poisson(np.maximum(true_e, 0.0)) + SENSOR.read_noise_e * rng.standard_normal(true_e.shape)
    codes = np.clip(np.round(respond(charge, SENSOR)), 0, SENSOR.max_dn)
    read_e = linearise(codes, SENSOR)
    A, u = peak * t_s * width / wide, x / wide
    g = np.exp(-0.5 * u**2)
    mean_e = A * g + t_s * background
    variance = variance_e2(mean_e, SENSOR) + (POLICY.map_share * background * t_s) ** 2
    weight = (mean_e + SATURATED_SIGMAS * np.sqrt(variance) < top_e()) / variance
    J = np.stack([g, A * u * g / wide, A * u**2 * g / wide, np.ones_like(u), u], axis=1)
    normal = J.T @ (weight[:, None] * J)
    step = np.linalg.pinv(normal, rcond=1e-13) @ (J.T * weight) @ (read_e - mean_e).T
    return step[1].std()

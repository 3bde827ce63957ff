"""The compiled fit of a section against its twin, whose derivatives are all numerical."""

from __future__ import annotations

import numpy as np
import pytest
import twins
from hypothesis import example, given, settings
from hypothesis import strategies as st
from profiles import groove, lap, measure, spoil

from tracker.joint.lap import PRIOR_SIGMA as LAP_PRIOR
from tracker.joint.section_fit import GROOVE, SHEETS, best_shift, fit_section
from tracker.joint.v_groove import PRIOR_SIGMA as GROOVE_PRIOR

seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=25)
@given(seeds, st.sampled_from([GROOVE, SHEETS]), st.floats(0.0, 0.2))
@example(16040162, GROOVE, 0.0625)
def test_the_fit_is_its_twin(seed: int, shape: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    tan = float(np.tan(np.radians(30.0)))
    if shape == GROOVE:
        corners = groove((30.0, 31.0), (4.0, 4.2), rng.uniform(0.3, 1.5), 0.01)
        start = np.array([*rng.normal(0.0, 0.1, 2), 1.0, tan, tan, 4.0, 4.0, 0.0, 0.0])
        prior, height = GROOVE_PRIOR, twins.groove_height
    else:
        corners = lap(2.2, 0.01, -0.01)
        start = np.array([rng.normal(0.0, 0.1), 2.0, 0.0, 0.0, 0.0])
        prior, height = LAP_PRIOR, twins.sheets_height
    profile = spoil(measure(corners, (0.0, 0.0), rng), wrong, rng)
    used = np.abs(profile.y_mm) > 0.4 if shape == SHEETS else np.ones(len(profile.y_mm), dtype=bool)
    sigma = np.hypot(profile.sigma_px, 0.05)
    fitted, covariance, weights = start.copy(), np.empty((len(prior), len(prior))), np.empty(len(sigma))
    chi2 = fit_section(
        shape,
        profile.y_mm,
        profile.z_mm,
        profile.dy_mm,
        profile.dz_mm,
        sigma,
        used,
        30.0,
        prior,
        fitted,
        covariance,
        weights,
    )
    move = profile.dy_mm, profile.dz_mm
    twin = twins.bisquare_fit(height, profile.y_mm, profile.z_mm, move, sigma, used, start, prior, 30.0)
    # A point at a corner lies on one face or the other by a hair, and its derivative with it.
    np.testing.assert_allclose(fitted, twin[0], rtol=0.0, atol=2e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.sqrt(np.diag(twin[1])), rtol=0.02)
    assert chi2 == pytest.approx(twin[2], rel=0.02)
    assert np.mean(np.abs(weights - twin[3])) < 1e-3


@settings(deadline=None, max_examples=25)
@given(seeds, st.floats(0.0, 0.3))
def test_the_shift_is_its_twin(seed: int, wrong: float) -> None:
    rng = np.random.default_rng(seed)
    corners = groove((30.0, 30.0), (4.0, 4.0), 1.0)
    seam = (rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0))
    profile = spoil(measure(corners, seam, rng), wrong, rng)
    shifts = np.arange(profile.y_mm[0], profile.y_mm[-1], 0.2)
    found = best_shift(profile.y_mm, profile.z_mm, corners, shifts, 1.0)
    assert found == pytest.approx(twins.best_shift(profile.y_mm, profile.z_mm, corners, shifts, 1.0))
    assert found == pytest.approx(seam, abs=0.3)


def test_a_fit_that_runs_away_is_nan() -> None:
    y = np.linspace(-5.0, 5.0, 50)
    n = np.ones(50)
    start = np.array([0.0, 0.0, 1.0, np.nan, 0.6, 4.0, 4.0, 0.0, 0.0])
    covariance, weights = np.empty((9, 9)), np.empty(50)
    chi2 = fit_section(
        GROOVE, y, y, 0.01 * n, 0.07 * n, n, n > 0.0, 3.0, GROOVE_PRIOR, start, covariance, weights
    )
    assert np.isnan(chi2)

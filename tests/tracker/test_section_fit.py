"""The compiled fit of a section against its twin, whose derivatives are all numerical."""

from __future__ import annotations

import numpy as np
import pytest
import twins
from hypothesis import example, given, settings
from hypothesis import strategies as st
from profiles import groove, lap, measure, spoil

from tracker.joint.groove import PRIOR_SIGMA as GROOVE_PRIOR
from tracker.joint.groove import weights_within
from tracker.joint.lap import PRIOR_SIGMA as LAP_PRIOR
from tracker.joint.section_fit import best_shift, fit_section
from tracker.joint.section_shapes import (
    CORNER,
    GROOVE,
    HALF_GROOVE,
    N_CORNERS,
    ROUND_GROOVE,
    SHEETS,
    corners_of,
    opening,
)
from tracker.profile import points_of

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
    fitted, covariance, chi2, weights = fit_section(shape, profile.points, sigma, used, 30.0, prior, start)
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
    points = points_of(y, y, scan=y, sigma_px=n, beside_px=n, dy_mm=0.01, dz_mm=0.07)
    chi2 = fit_section(GROOVE, points, n, n > 0.0, 3.0, GROOVE_PRIOR, start).chi2
    assert np.isnan(chi2)


@pytest.mark.parametrize(
    ("shape", "height", "p", "off_mm"),
    [
        (GROOVE, twins.groove_height, (0.3, -4.0, 1.1, 0.5, 0.6, 4.0, 4.3, 0.01, -0.02), 1e-9),
        (SHEETS, twins.sheets_height, (0.2, 2.0, 0.01, -0.02, 0.4), 1e-9),
        (HALF_GROOVE, twins.half_groove_height, (0.9, -4.0, 1.0, 4.1, 3.9, 0.01, 0.02, -0.5), 1e-9),
        (CORNER, twins.corner_height, (0.3, -1.0, 0.9, -1.1), 1e-9),
        # Chords of 3 degrees lie off a circle of 3 mm by its sagitta, 1 um, more where it is steep.
        (
            ROUND_GROOVE,
            twins.round_groove_height,
            (0.3, -6.0, 1.0, 0.36, 0.4, 6.0, 6.2, 0.01, -0.02, 3.0),
            0.005,
        ),
    ],
)
def test_corners_lie_on_the_shape(shape, height, p, off_mm: float) -> None:
    corners = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, np.array(p), corners)
    assert (np.diff(corners[:, 0]) >= 0.0).all()
    y = np.linspace(-12.0, 12.0, 4001) + 0.00037
    drawn = np.interp(y, corners[:, 0], corners[:, 1])
    np.testing.assert_allclose(drawn, height(np.array(p), y), atol=off_mm)


@pytest.mark.parametrize(
    ("shape", "p"),
    [
        (GROOVE, (0.3, -4.0, 1.1, 0.5, 0.6, 4.0, 4.3, 0.01, -0.02)),
        (HALF_GROOVE, (0.9, -4.0, 1.0, 4.1, 3.9, 0.01, 0.02, -0.5)),
        (ROUND_GROOVE, (0.3, -6.0, 1.0, 0.36, 0.4, 6.0, 6.2, 0.01, -0.02, 3.0)),
    ],
)
def test_the_opening_is_what_a_sum_over_y_gives(shape: int, p: tuple[float, ...]) -> None:
    def area(p: np.ndarray) -> float:
        corners = np.empty((N_CORNERS[shape], 2))
        corners_of(shape, p, corners)
        (right_y, right_z), (left_y, left_z) = corners[1], corners[-2]
        y = np.linspace(right_y + 1e-9, left_y, 400001)
        top = right_z + (left_z - right_z) * (y - right_y) / (left_y - right_y)
        return float(np.trapezoid(top - np.interp(y, corners[:, 0], corners[:, 1]), y))

    at, gradient = np.array(p), np.zeros(len(p))
    assert opening(shape, at, gradient) == pytest.approx(area(at), rel=1e-4)
    for i in range(len(p)):
        step = 1e-3 * np.eye(len(p))[i]
        want = (area(at + step) - area(at - step)) / 2e-3
        assert gradient[i] == pytest.approx(want, abs=0.02), i


@given(seeds)
def test_what_is_seen_of_a_groove_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y, weights = rng.uniform(-6.0, 6.0, 60), rng.choice([0.0, 0.05, 0.5, 1.0], 60)
    middle, gap, mouth = rng.uniform(-1.0, 1.0), rng.uniform(0.0, 0.8), rng.uniform(1.5, 4.0)
    right, left, right_bevel, left_bevel, out = weights_within(y, weights, middle, gap, mouth)
    share = (np.abs(y - middle) - gap) / (mouth - gap)
    amid, inside = (share > 0.25) & (share < 0.75), share < 1.0
    assert right_bevel == pytest.approx(weights[amid & (y < middle)].sum())
    assert left_bevel == pytest.approx(weights[amid & (y > middle)].sum())
    assert right == pytest.approx(weights[inside & (y < middle)].sum())
    assert left == pytest.approx(weights[inside & (y > middle)].sum())
    assert out == pytest.approx(np.mean(weights[inside] < 0.1) if inside.any() else 1.0)

"""A narrow root, weighed over gaps: its posterior on grooves whose gap is drawn from what is stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from profiles import fit_joint, groove, measure

from noise_model.surface.joint import Joint
from tracker.joint import MeasuredJoint
from tracker.joint.common_mode import COMMON_MODE_PX
from tracker.joint.groove import CELLS_MM, CLOSED_AS_STATED, GAP, GAPS, NARROW_MM, PRIOR_SIGMA, prior_of

LINE = ((-100.0, 0.0, 0.0), (100.0, 0.0, 0.0))
CAMERA_MM, LASER_MM = np.array([60.0, 0.0, 130.0]), np.array([0.0, 0.0, 140.0])
SEAM = (1.0, -4.0)


def stated(gap_mm: float) -> Joint:
    return Joint("v_groove", {"included_angle_deg": 60.0, "depth_mm": 4.0, "root_gap_mm": gap_mm}, LINE)


def fit(joint: Joint, gap_mm: float, mixed_mm: float, rng: np.random.Generator) -> MeasuredJoint:
    profile = measure(
        groove((30.0, 30.0), (4.0, 4.0), gap_mm), SEAM, rng, sigma_px=0.1, common_px=COMMON_MODE_PX
    )
    found = fit_joint(replace(profile, mixed_mm=mixed_mm), joint, CAMERA_MM, LASER_MM)
    assert found is not None
    return found


@given(st.one_of(st.just(0.0), st.floats(0.01, 1.5)), st.floats(0.05, 0.6))
def test_the_prior_is_a_probability(stated_mm: float, sigma_mm: float) -> None:
    prior = prior_of(stated_mm, sigma_mm)
    assert prior.sum() == pytest.approx(1.0)
    assert (prior >= 0.0).all()
    assert len(CELLS_MM) == len(GAPS)
    if stated_mm == 0.0:
        assert prior[0] == CLOSED_AS_STATED
    else:
        # What a normal has below the first cell's end counts for the closed root.
        border = 0.5 * (GAPS[0] + GAPS[1])
        below = 0.5 * (1.0 + math.erf((border - stated_mm) / (math.sqrt(2.0) * sigma_mm)))
        assert prior[0] == pytest.approx(below)


@pytest.mark.slow
@pytest.mark.parametrize("mixed_mm", [0.0, 0.21])
@pytest.mark.parametrize("stated_mm", [0.0, 0.1, 0.3])
def test_the_posterior_is_honest(stated_mm: float, mixed_mm: float) -> None:
    """Of gaps drawn from the prior, with the root's own lines and without what mixes both bevels."""
    rng, prior = np.random.default_rng(4), prior_of(stated_mm, PRIOR_SIGMA[GAP])
    ends = np.concatenate([[0.0], 0.5 * (GAPS[1:] + GAPS[:-1]), [GAPS[-1]]])
    errors, sigmas = [], []
    for _ in range(600):
        k = rng.choice(len(GAPS), p=prior)
        gap_mm = rng.uniform(ends[k], ends[k + 1]) if k else 0.0
        found = fit(stated(stated_mm), gap_mm, mixed_mm, rng)
        errors.append(np.array([found.y_mm, found.z_mm]) - SEAM)
        sigmas.append(np.sqrt(np.diag(found.covariance_mm2)))
    rms, stated_rms = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (errors, sigmas))
    beyond = np.mean(np.abs(errors) > 2.0 * np.array(sigmas), axis=0)
    print(f"stated {stated_mm}, mixed {mixed_mm}: {rms / stated_rms} of sigma, {beyond} beyond two")
    # Few wide gaps make most of it where nineteen in twenty are closed.
    assert ((rms / stated_rms > 0.7) & (rms / stated_rms < 1.5)).all()
    assert (beyond < 0.09).all()


@pytest.mark.parametrize("mixed_mm", [0.0, 0.21])
def test_a_root_that_is_closed_as_stated_has_next_to_no_gap(mixed_mm: float) -> None:
    rng = np.random.default_rng(5)
    roots = [fit(stated(0.0), 0.0, mixed_mm, rng) for _ in range(40)]
    gaps_mm = np.array([root.gap_mm for root in roots])
    assert (gaps_mm >= 0.0).all()
    assert np.median(gaps_mm) < 0.015
    assert np.quantile(gaps_mm, 0.9) < 0.03
    for root in roots:
        assert abs(root.z_mm - SEAM[1]) < 4.0 * math.sqrt(root.covariance_mm2[1, 1])


def test_of_a_root_that_no_line_tells_the_gap_is_what_is_stated() -> None:
    rng = np.random.default_rng(6)
    found = fit(stated(0.1), 0.1, 0.5, rng)
    # The prior's own scatter, what it has below none heaped there; up by half of it over a bevel's tangent.
    own = prior_of(0.1, PRIOR_SIGMA[GAP])
    sigma = math.sqrt(own @ GAPS**2 - (own @ GAPS) ** 2)
    assert found.shape.gap_sigma_mm == pytest.approx(sigma, rel=0.5)
    up = found.shape.gap_sigma_mm / (2.0 * math.tan(math.radians(30.0)))
    assert math.sqrt(found.covariance_mm2[1, 1]) == pytest.approx(up, rel=0.15)


def test_a_wide_root_is_left_as_it_was_fitted() -> None:
    rng = np.random.default_rng(7)
    wide = fit(stated(1.2), 1.2, 0.0, rng)
    assert wide.gap_mm > NARROW_MM
    rng = np.random.default_rng(7)
    blind = fit(stated(1.2), 1.2, 0.5, rng)
    np.testing.assert_array_equal(wide.covariance_mm2, blind.covariance_mm2)
    assert (wide.y_mm, wide.z_mm, wide.gap_mm) == (blind.y_mm, blind.z_mm, blind.gap_mm)

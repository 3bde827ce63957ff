from dataclasses import replace

import numpy as np
import pytest

from noise_model.fit import Parameter
from sim_to_real.locate.spline_term import (
    SPLINE_FOLDS,
    CrossValidation,
    folds_by_turn,
    gap_size,
    hat_basis,
    hat_basis_2d,
    spline_terms,
)
from tests.sim_to_real.planted import planted

TRAINING = np.arange(24) % 3 != 0


def noise(values, seed=1):
    return np.random.default_rng(seed).standard_normal(len(values.frame))


def terms_of(values, r):
    """Free functions of what nothing that is named has touched."""
    return spline_terms(values, r, TRAINING, gap_size(values, r, TRAINING))


def test_hats_interpolate_lines_exactly_and_leave_out_what_is_unknown():
    values = np.random.default_rng(3).gamma(2.0, 5.0, 4000).astype(np.float32)
    values[::50] = np.nan
    X = hat_basis(values)
    known = np.isfinite(values)
    np.testing.assert_allclose(X.sum(axis=1), known, atol=1e-6)
    line = 3.0 - 0.7 * values[known]
    c, *_ = np.linalg.lstsq(X[known], line, rcond=None)
    np.testing.assert_allclose(X[known] @ c, line, atol=1e-3)
    assert hat_basis(np.full(5, 2.0, dtype=np.float32)).shape == (5, 1)
    # 24 frames' times: a third as many knots, not one for each.
    assert hat_basis(np.arange(24, dtype=np.float32)).shape == (24, 8)


def test_hats_of_row_and_column_interpolate_their_product():
    bins = planted(2)
    X = hat_basis_2d(bins)
    product = bins.values["row"] * bins.values["column"]
    c, *_ = np.linalg.lstsq(X, product, rcond=None)
    np.testing.assert_allclose(X @ c, product, atol=0.05)


@pytest.mark.parametrize(
    ("covariate", "form", "gap"),
    [
        ("distance", "adds", lambda bins: 60.0 / np.nan_to_num(bins.values["distance"], nan=np.inf)),
        ("column", "times_laser", lambda bins: 0.1 * bins.laser_dn * np.sin(bins.values["column"] / 4.0)),
        ("half_angle", "times_arc", lambda bins: 0.1 * bins.arc_dn * np.cos(bins.values["half_angle"] / 9.0)),
    ],
)
def test_the_function_that_was_planted_closes_the_gap(covariate, form, gap):
    bins = planted()
    terms = terms_of(bins, noise(bins) + gap(bins))
    assert (terms[0].covariate, terms[0].form) == (covariate, form)
    assert terms[0].name == f"{covariate} {form}"
    assert terms[0].closed > 0.75
    assert [term.closed for term in terms] == sorted((term.closed for term in terms), reverse=True)


def test_of_noise_and_of_frames_own_levels_no_function_closes_anything():
    bins = planted()
    for term in terms_of(bins, 1.2 * noise(bins)):
        assert term.closed < 0.03, term.name
    levels = np.random.default_rng(7).standard_normal(24)
    terms = terms_of(bins, noise(bins) + 2.0 * levels[bins.frame] * (bins.arc_dn > 0.0))
    assert terms[0].closed < 0.15


def test_a_share_is_of_the_gap_that_there_was_and_of_a_trifle_none_is_told():
    bins = planted()
    mean_square = 60.0 / np.nan_to_num(bins.values["distance"], nan=np.inf)
    before = gap_size(bins, noise(bins) + 5.0 * mean_square, TRAINING)
    alone, beside = (
        spline_terms(bins, noise(bins) + mean_square, TRAINING, size)[0]
        for size in (gap_size(bins, noise(bins) + mean_square, TRAINING), before)
    )
    assert alone.closed > 0.75
    # What was named took four fifths of the gap before.
    assert beside.closed == pytest.approx(alone.closed / 5.0, rel=0.1)
    assert spline_terms(bins, noise(bins), TRAINING, gap_size(bins, 1.02 * noise(bins), TRAINING)) == ()


def test_two_coordinates_are_needed_for_a_patch():
    bins = planted()
    row, column = bins.values["row"], bins.values["column"]
    patch = np.exp(-((row - 8.0) ** 2 + (column - 22.0) ** 2) / 40.0)
    terms = terms_of(bins, noise(bins) - 0.8 * patch * bins.light_dn)
    assert (terms[0].covariate, terms[0].form) == ("row, column", "times_light")
    assert terms[0].closed > 0.6


def test_what_nuisances_did_in_vain_is_undone_first():
    bins = planted()
    slope = bins.arc_dn / 20.0 * np.sin(bins.values["column"] / 8.0)
    bent = replace(bins, tangents=np.column_stack([slope, *[0.0 * slope] * 8]).astype(np.float32))
    gap = 2.0 * np.sin(bins.values["gray_level"] / 40.0)
    # The fit has taken the nuisance to 0.4 though it is 0: that lies within its prior.
    bent = replace(bent, anchor=np.array([0.4, *[0.0] * 8]))
    r = noise(bins) + gap - 0.4 * slope
    bent_fit, blind_fit = CrossValidation.of(bent, r), CrossValidation.of(bins, r)
    X = hat_basis(bent_fit.covariates.values["gray_level"])
    assert bent_fit.excess_share(bent_fit.gain(X)) > 0.9
    assert blind_fit.excess_share(blind_fit.gain(X)) < 0.8


def test_a_nuisance_that_each_frame_has_its_own_value_of_hides_no_function():
    """As the seam's: fitted to other frames it makes a frame's residuals worse than they were."""
    bins = planted()
    sway = np.sin(1.3 * bins.values["row"]).astype(np.float32)
    swaying = replace(bins, tangents=np.column_stack([sway, *[0.0 * sway] * 8]).astype(np.float32))
    fold = (bins.frame % 4).astype(np.int64)
    gap = np.sin(bins.values["gray_level"] / 40.0)
    r = noise(bins) + gap + np.where(fold < 2, 1.0, -1.0) * sway
    fit, without = CrossValidation.of(swaying, r, fold), CrossValidation.of(bins, r, fold)
    X = hat_basis(fit.covariates.values["gray_level"])
    fitted = fit.gain_from_moments(*fit.moments(fit.covariates.tangents))
    assert fitted < -0.2
    assert fit.gain_from_moments(*fit.moments(np.hstack([fit.covariates.tangents, X]))) < 0.7 * fit.gain(X)
    assert fit.gain(X) == pytest.approx(without.gain(X), rel=1e-3)
    assert fit.gain(X) == pytest.approx(np.var(gap), rel=0.2)


def test_nuisances_stay_within_their_bounds_unless_let_go():
    bins = planted()
    slope = (bins.arc_dn / 10.0).astype(np.float32)
    tangents = np.zeros((len(slope), 9), dtype=np.float32)
    tangents[:, 0] = slope
    narrow = (Parameter("level", "", 0.0, 0.1, -0.3, 0.3, 0.01), *bins.nuisances[1:])
    bins = replace(bins, tangents=tangents, nuisances=narrow)
    r = noise(bins) + 2.0 * slope

    def moved(fit):
        A, b = fit.moments(fit.covariates.tangents)
        return fit.coefficients(A.sum(axis=0), b.sum(axis=0))[0]

    assert moved(CrossValidation.of(bins, r)) == pytest.approx(0.3)
    assert moved(CrossValidation.of(bins, r, free=(0,))) == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("cycle", [1, 2, 3, 4, 5, 6])
def test_every_fold_has_frames_of_every_stratum(cycle):
    values = replace(planted(24, (2, 3)), stratum=(np.repeat(np.arange(24), 6) % cycle).astype(np.int8))
    fold = folds_by_turn(values)
    for k in range(SPLINE_FOLDS):
        frames = np.unique(values.frame[fold == k])
        assert len(frames) == 6
        assert set(frames % cycle) == set(range(cycle)) or 24 // cycle < SPLINE_FOLDS
        # Nor are they all of one end of the recording.
        assert frames.min() < 8
        assert frames.max() >= 16

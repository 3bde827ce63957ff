from dataclasses import replace

import numpy as np
import pytest

from sim_to_real.locate.residual_structure import (
    banded_means,
    curve_along,
    image_shares,
    locate,
    strata_gaps,
)
from sim_to_real.locate.spline_term import CrossValidation
from tests.sim_to_real.planted import planted

Z = np.zeros((2, 2), dtype=np.float32)


def noise(values, seed=1):
    return np.random.default_rng(seed).standard_normal(len(values.frame))


def shares(values, r):
    return image_shares(values, r, CrossValidation.of(values, r))


@pytest.mark.parametrize("name", ["half_angle", "row", "gray_level", "time"])
def test_the_covariate_that_was_planted_comes_first_with_its_share(name):
    bins = planted()
    value = bins.values[name]
    along = (value - value.mean()) / value.std()
    # As much again lies along nothing: other numbers in each bin.
    r = 2.0 * along + np.random.default_rng(5).normal(0.0, np.sqrt(1.0 + 4.0), len(value))
    where = locate(bins, r, "sensor", Z)
    assert where.covariates[0].name == name
    assert where.covariates[0].r2 == pytest.approx(0.5, abs=0.05)
    assert where.covariates[1].r2 < 0.3
    assert (where.stage, where.z is Z) == ("sensor", True)


def test_noise_lies_nowhere_and_its_bands_cover_nought():
    bins = planted()
    where = locate(bins, noise(bins), "source", Z)
    assert max(curve.r2 for curve in where.covariates) < 0.05
    covered = np.concatenate([(c.low <= 0.0) & (c.high >= 0.0) for c in where.covariates])
    assert covered.mean() > 0.8
    assert {name for name, gap in where.strata.items() if gap > 0.15} == set()
    assert max(value for name, value in where.image.items() if name != "stripe_band") < 0.05


def test_frames_own_levels_are_no_function_of_time_and_widen_the_band():
    bins = planted()
    level = 2.0 * np.random.default_rng(11).standard_normal(bins.n_frames)[bins.frame]
    r = noise(bins) + level
    curve = curve_along("half_angle", bins, r, CrossValidation.of(bins, r))
    in_group = np.full(len(curve.centers), len(r) / len(curve.centers))
    naive = 2.0 * 1.96 * r.std() / np.sqrt(in_group)
    assert ((curve.high - curve.low) > 5.0 * naive * 0.5).all()
    assert curve_along("time", bins, r, CrossValidation.of(bins, r)).r2 < 0.25


def test_a_band_is_that_of_the_frames_means():
    draw = np.random.default_rng(2)
    n_frames, n = 40, 500
    frame = np.repeat(np.arange(n_frames), n)
    level = draw.standard_normal(n_frames)
    mean, low, high = banded_means(level[frame], np.zeros(len(frame), dtype=np.int64), 1, frame)
    assert mean == pytest.approx([level.mean()])
    # 95 % of a mean of 40 independent frames.
    assert high - low == pytest.approx([2.0 * 1.96 * level.std() / np.sqrt(n_frames)], rel=0.2)
    of_none = banded_means(level[frame], np.full(len(frame), -1), 0, frame)
    assert [len(part) for part in of_none] == [0, 0, 0]


def test_curves_tell_the_mean_and_the_ratio_of_light():
    bins = planted()
    r = 0.2 * bins.light_dn + 0.0 * noise(bins)
    curve = curve_along("distance", bins, r, CrossValidation.of(bins, r))
    assert np.nanmedian(curve.log_ratio) == pytest.approx(np.log(1.2), abs=1e-4)
    chosen = np.isfinite(bins.values["distance"])
    assert (curve.mean @ np.ones(len(curve.mean))) / len(curve.mean) == pytest.approx(
        r[chosen].mean(), rel=0.01
    )
    dark = replace(bins, arc_dn=0.0 * bins.arc_dn, laser_dn=0.0 * bins.laser_dn)
    assert np.isnan(curve_along("distance", dark, r, CrossValidation.of(dark, r)).log_ratio).all()


def test_strata_are_told_apart():
    bins = planted()
    r = noise(bins) + np.where(bins.in_stripe, 5.0, 0.0)
    gaps = strata_gaps(bins, r)
    assert gaps["stripe_band"] == pytest.approx(5.0, abs=0.1)
    assert gaps["rest"] < 0.15
    assert gaps["dark"] < 0.2 < gaps["laser"] < gaps["stripe_band"]
    no_dark = replace(bins, stratum=np.maximum(bins.stratum, 1).astype(np.int8))
    assert np.isnan(strata_gaps(no_dark, r)["dark"])


def test_patterns_of_the_image_are_told_apart():
    bins = planted()
    numbers = np.random.default_rng(9).standard_normal(bins.shape[0] * bins.shape[1])
    ghost = np.stack([bins.image(f, bins.light_dn)[::-1, ::-1] for f in range(bins.n_frames)]).reshape(-1)
    for name, pattern in {
        "row": 3.0 * np.sin(bins.values["row"] / 3.0),
        "column": 3.0 * np.sin(bins.values["column"] / 4.0),
        "radial": 3.0 * np.cos(bins.values["radius"] / 2.0),
        "mirrored": 0.08 * ghost,
        "fixed": 3.0 * numbers[bins.bins],
        "stripe_band": np.where(bins.in_stripe, 8.0 * noise(bins, 4), 0.0),
    }.items():
        result = shares(bins, noise(bins) + pattern)
        # A pattern of rows or columns is one of each bin too.
        others = {other: value for other, value in result.items() if other not in (name, "fixed")}
        assert result[name] > 0.85, name
        assert max(others.values()) < result[name] - 0.1, name
    assert shares(bins, noise(bins) + 0.1 * bins.light_dn * numbers[bins.bins])["fixed"] > 0.8

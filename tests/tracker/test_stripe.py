"""The stripe kernels against their twins, and the fit's accuracy against the Cramer-Rao bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
import twins
from hypothesis import example, given, settings
from hypothesis import strategies as st

from noise_model.arrays import Bool, Float64
from tracker.stripe.fit import (
    BLOCK,
    CORRELATION_PX,
    N_FITTED,
    WIDTH_SIGMA_LN,
    WINDOW_SIGMAS,
    fit_lines,
    line_window,
    map_edge,
)
from tracker.stripe.normal_equations import moments_of, normal_equations, solve, variance_of
from tracker.stripe.viterbi import MANY_OFFSETS, OFFSET_STEP, best_path, matched_filter, peaks
from tracker.stripe.viterbi import bell as bell_of

CELL = 8
READ_E, GAIN = 45.0, 80.0
DARK = READ_E**2 + GAIN**2 / 12.0
MAP_SIGMA, BASE_SIGMA = 0.05, 24.0
WIDTHS, AMPLITUDES, ARC_SHARES = (2.0, 4.0, 7.0), (500.0, 2000.0, 8000.0), (0.0, 0.25, 1.0, 4.0)
seeds = st.integers(0, 2**32 - 1)


def fit(
    charge: Float64,
    background: Float64,
    start: Float64,
    width: float,
    *,
    censored: Bool | None = None,
    lows: Float64 | None = None,
    map_sigma: float = MAP_SIGMA,
    base_sigma: float = BASE_SIGMA,
    speckle: float = 0.0,
) -> tuple[Float64, Bool]:
    n = len(charge)
    fits, saturated = np.full((n, N_FITTED), -1.0), np.ones(n, dtype=bool)
    fit_lines(
        charge.astype(np.float32),
        background.astype(np.float32),
        np.zeros(charge.shape, bool) if censored is None else censored,
        start.astype(np.float64),
        np.full(n, width),
        np.zeros(-(-n // CELL), np.int64) if lows is None else lows,
        CELL,
        1.0,
        DARK,
        speckle,
        map_sigma,
        base_sigma,
        fits,
        saturated,
    )
    return fits, saturated


class Lines:
    """n scan lines of the model that the fit assumes, its background off by what the priors allow."""

    def __init__(
        self, seed: int, n: int, amplitude: float, width: float, level: float, *, depth: int | None = None
    ) -> None:
        rng = np.random.default_rng(seed)
        depth = math.ceil(2.0 * (4.5 * width + 3.0)) if depth is None else depth
        self.width, self.level = width, level
        self.true_px = depth / 2.0 + rng.uniform(-0.5, 0.5, n)
        ln_width = math.log(width) + rng.normal(0.0, WIDTH_SIGMA_LN, n)
        smooth = math.hypot(MAP_SIGMA * level, BASE_SIGMA)
        offset, slope = rng.normal(0.0, smooth, n), rng.normal(0.0, smooth / CORRELATION_PX, n)
        away = np.arange(depth) - self.true_px[:, None]
        mean = amplitude * np.exp(-0.5 * (away / np.exp(ln_width)[:, None]) ** 2) + level
        mean += offset[:, None] + slope[:, None] * away
        # A black level that is off may take away what light does not.
        electrons = rng.poisson(np.maximum(mean, 0.0)) + np.minimum(mean, 0.0)
        electrons += rng.normal(0.0, READ_E, mean.shape)
        self.charge = np.rint(electrons / GAIN) * GAIN
        self.background = np.full(mean.shape, level)
        self.start = np.rint(self.true_px + rng.normal(0.0, 1.0, n))

    def fit(self) -> tuple[Float64, Float64, Float64]:
        """Errors, stated sigmas (px) of the lines where a stripe was found, and which those are."""
        fits, _ = fit(self.charge, self.background, self.start, self.width)
        found = np.isfinite(fits[:, 0])
        return fits[found, 0] - self.true_px[found], fits[found, 1], found


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_the_matched_filter_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_scan, depth = rng.integers(1, 20), rng.integers(12, 120)
    n_offsets = rng.integers(1, 2 * MANY_OFFSETS)
    residual = rng.normal(0.0, 100.0, (n_scan, depth)).astype(np.float32)
    residual[rng.random(residual.shape) < 0.05] = np.nan
    variance = rng.uniform(10.0, 1e4, residual.shape).astype(np.float32)
    variance[np.isnan(residual)] = np.nan
    lows = rng.integers(0, 5, -(-n_scan // CELL))
    center = rng.uniform(-10.0, depth + 10.0, n_scan)
    width = rng.uniform(0.6, 6.0, n_scan)
    offsets = rng.integers(-40, 40) + OFFSET_STEP * np.arange(n_offsets)
    score = np.full((n_scan, n_offsets), np.nan, dtype=np.float32)
    matched_filter(residual, variance, center, width, lows, CELL, offsets, score)
    twin = twins.matched_filter(residual, variance, center, width, np.repeat(lows, CELL), offsets)
    np.testing.assert_allclose(score, twin, rtol=2e-5, atol=2e-5)


@settings(deadline=None, max_examples=60)
@given(seeds, st.floats(0.0, 12.0))
def test_no_path_is_cheaper_than_the_best_path(seed: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    n_scan, n = rng.integers(1, 30), rng.integers(1, 25)
    score = (height * rng.normal(0.0, 1.0, (n_scan, n))).astype(np.float32)
    score[rng.random(n_scan) < 0.2] = 0.0
    choice = np.full(n_scan, 99)
    best_path(score, choice)
    assert ((choice >= -1) & (choice < n)).all()
    exact = score.astype(np.float64)
    assert twins.path_cost(exact, choice) == pytest.approx(twins.best_path_cost(exact), rel=1e-9, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(seeds, st.floats(-8.9, 8.9), st.integers(-1, 10))
def test_a_fit_starts_at_the_peak_that_the_path_is_on(seed: int, peak: float, choice: int) -> None:
    rng = np.random.default_rng(seed)
    offsets = np.arange(-10, 11, 2)
    centers = rng.uniform(50.0, 60.0, 4)
    # A parabola, so that the way between the offsets is exact.
    score = np.tile(100.0 - (offsets - peak) ** 2, (4, 1)).astype(np.float32)
    start = np.empty(4)
    peaks(score, np.full(4, choice), centers, offsets, start)
    want = np.rint(centers) + (np.nan if choice < 0 else peak)
    np.testing.assert_allclose(start, want, atol=1e-4)


def test_a_fit_starts_on_the_paths_own_hill() -> None:
    offsets = np.arange(-10, 11, 2)
    two_hills = np.maximum(9.0 - (offsets + 6.0) ** 2 / 4.0, 20.0 - (offsets - 6.0) ** 2 / 4.0)
    start = np.empty(2)
    peaks(np.tile(two_hills.astype(np.float32), (2, 1)), np.array([1, 8]), np.full(2, 30.0), offsets, start)
    np.testing.assert_allclose(start, [24.0, 36.0])


def test_a_single_offset_is_where_a_fit_starts() -> None:
    start = np.empty(1)
    peaks(np.ones((1, 1), np.float32), np.zeros(1, np.int64), np.full(1, 7.2), np.zeros(1, np.int64), start)
    assert start[0] == 7.0


def test_a_path_without_evidence_holds_no_stripe() -> None:
    choice = np.zeros(12, dtype=np.int64)
    best_path(np.zeros((12, 9), dtype=np.float32), choice)
    assert (choice == -1).all()


def test_the_bell_is_a_gaussian() -> None:
    t = np.linspace(-40.0, 40.0, 8001).astype(np.float32)
    bell = np.array([bell_of(one) for one in t])
    np.testing.assert_allclose(bell, np.exp(-0.5 * t.astype(np.float64) ** 2), rtol=0.0, atol=1e-6)


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(-6.0, 6.0))
def test_solve_is_the_linear_solver(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (5, 5)) + 2.0 * np.eye(5)
    scale = 10.0 ** np.linspace(0.0, decades, 5)
    H = (root @ root.T + 0.1 * np.eye(5)) * np.outer(scale, scale)
    g, step = scale * rng.normal(0.0, 1.0, 5), np.empty(5)
    factors = H.copy()
    gained = solve(factors, g.copy(), step)
    exact = np.linalg.solve(H, g)
    np.testing.assert_allclose(step * scale, exact * scale, rtol=1e-6, atol=1e-6)
    assert gained == pytest.approx(g @ exact, rel=1e-6)
    for which in range(5):
        variance = variance_of(factors, which, np.empty(5))
        assert variance == pytest.approx(np.linalg.inv(H)[which, which], rel=1e-6)


def test_solve_refuses_what_is_not_positive() -> None:
    assert math.isnan(solve(np.diag([1.0, 1.0, -1.0, 1.0, 1.0]), np.ones(5), np.empty(5)))
    assert math.isnan(solve(np.zeros((5, 5)), np.ones(5), np.empty(5)))


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(1.5, 8.0), st.sampled_from([0.0, 1.0]), st.sampled_from([0.0, 0.2]))
def test_the_normal_equations_are_those_of_numerical_derivatives(
    seed: int, width: float, shot: float, speckle: float
) -> None:
    rng = np.random.default_rng(seed)
    # The window that a fit reads. Farther out the bell, 1e-6 off, would weigh beside a stripe that is gone.
    depth = int(rng.integers(8, 60))
    low, end = line_window(depth / 2.0, width, depth)
    n = end - low
    r, background = np.arange(n, dtype=np.float64), rng.uniform(0.0, 4000.0, n)
    # Amplitude, position over width, ln width, offset, slope times width.
    x = np.array([rng.uniform(500.0, 9000.0), n / 2.0 / width, math.log(width), *rng.normal(0.0, 200.0, 2)])

    def mean(x: Float64) -> Float64:
        away = r - x[1] * width
        slope = x[4] / width
        return x[0] * np.exp(-0.5 * (away / np.exp(x[2])) ** 2) + background + x[3] + slope * away

    charge, censored = mean(x) + rng.normal(0.0, 100.0, n), rng.random(n) < 0.2
    steps = 1e-5 * np.diag(np.maximum(np.abs(x), 1.0))
    J = np.stack([(mean(x + step) - mean(x - step)) / (2.0 * step.sum()) for step in steps], axis=1)
    residual = charge - mean(x)
    counts = ~censored | (residual > 0.0)
    stripe = x[0] * np.exp(-0.5 * ((r - x[1] * width) / np.exp(x[2])) ** 2)
    weight = counts / (shot * np.maximum(mean(x), 0.0) + DARK + (speckle * stripe) ** 2)
    H, g = np.zeros((5, 5)), np.empty(5)
    single = (charge.astype(np.float32), background.astype(np.float32), censored, r.astype(np.float32))
    moments = moments_of(*single, x, width, shot, DARK, speckle)
    normal_equations(moments, x, H, g)
    exact = J.T @ (weight[:, None] * J)
    scale = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(H / np.outer(scale, scale), np.tril(exact / np.outer(scale, scale)), atol=5e-5)
    off = math.sqrt(np.sum(weight * residual**2))
    np.testing.assert_allclose(g / scale / off, J.T @ (weight * residual) / scale / off, atol=1e-4)
    assert moments.chi2 == pytest.approx(off**2, rel=1e-3)
    assert moments.used == counts.sum()


@given(st.floats(-20.0, 120.0), st.floats(0.5, 12.0), st.integers(2, 150))
def test_a_window_holds_the_stripe_in_whole_blocks(start: float, width: float, depth: int) -> None:
    low, end = line_window(start, width, depth)
    assert 0 <= low < end <= depth
    assert end - low == depth or (end - low) % BLOCK == 0
    reach = WINDOW_SIGMAS * width
    assert low <= max(0.0, start - reach + 1.0)
    assert end >= min(depth, start + reach)


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_the_map_edge_is_its_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    background = rng.uniform(0.0, 1e4, (rng.integers(1, 30), rng.integers(2, 20))).astype(np.float32)
    background[rng.random(background.shape) < 0.05] = np.nan
    lows = rng.integers(0, 6, -(-len(background) // CELL))
    s, position = rng.integers(0, len(background)), rng.uniform(0.0, 30.0)
    change = map_edge(background, lows, CELL, s, position)
    here = background[s, np.clip(int(position) - lows[s // CELL], 0, background.shape[1] - 1)]
    if np.isfinite(here):
        assert change == pytest.approx(twins.map_edge(background, np.repeat(lows, CELL), s, position))


@pytest.mark.slow
@example(1921, 2.625, 800.0, 1.7421875, np.inf)
@example(6690504, 6.96875, 800.0, 2.81640625, 0.9)
@settings(deadline=None, max_examples=25)
@given(
    seeds,
    st.floats(1.5, 8.0),
    st.floats(800.0, 15000.0),
    st.floats(0.0, 3.0),
    st.sampled_from([np.inf, 0.9]),
)
def test_the_fit_is_the_most_likely_one(
    seed: int, width: float, amplitude: float, arc_share: float, full_well: float
) -> None:
    lines = Lines(seed, 1, amplitude, width, arc_share * amplitude)
    tilt = np.linspace(0.9, 1.1, lines.charge.shape[1])
    full_e = full_well * lines.charge.max()
    charge, background = np.minimum(lines.charge, full_e), lines.background * tilt
    censored = charge >= full_e
    fits, saturated = fit(charge, background, lines.start, width, censored=censored)
    position, sigma, height, fitted_width, _, offset_e, slope_e = fits[0]
    if not np.isfinite(position):
        return
    assert saturated[0] == censored.any()
    start = int(lines.start[0])
    low, end = line_window(start, width, len(tilt))
    window = (low, end - 1)
    model = twins.LineModel(
        charge[0], background[0], censored[0], width, DARK, MAP_SIGMA, BASE_SIGMA, 0.0, window
    )
    likeliest = model.fit(np.array([height, position, math.log(fitted_width), 0.0, 0.0]))
    bound = math.sqrt(np.linalg.inv(model.information(likeliest))[1, 1])
    assert position == pytest.approx(likeliest[1], abs=0.01 * bound)
    assert fitted_width == pytest.approx(math.exp(likeliest[2]), rel=1e-3)
    scatter = np.sqrt(np.diag(np.linalg.inv(model.information(likeliest))))
    assert offset_e == pytest.approx(likeliest[3], abs=0.02 * scatter[3])
    assert slope_e == pytest.approx(likeliest[4], abs=0.02 * scatter[4])
    assert sigma >= 0.98 * bound


@pytest.mark.parametrize("width", WIDTHS)
def test_the_fit_reaches_the_bound_and_says_so(width: float) -> None:
    """1.4826 median|error| over the bound at most 1.1, chi2 of the stated sigma 0.9 to 1.1, no bias."""
    n, all_scaled, report = 2000, [], []
    for amplitude in AMPLITUDES:
        for share in ARC_SHARES:
            lines = Lines(7, n, amplitude, width, share * amplitude)
            error, sigma, found = lines.fit()
            bound, wide = (
                twins.line_bound(amplitude, width, lines.level, DARK, MAP_SIGMA, BASE_SIGMA, reach)
                for reach in (WINDOW_SIGMAS, 6.0)
            )
            spread, chi2 = 1.4826 * np.median(np.abs(error)), np.mean((error / sigma) ** 2)
            report.append(
                f"width {width}, stripe {amplitude:.0f} e-, arc x{share}: bound {bound:.4f} px, error / it "
                f"{spread / bound:.3f} (of +-6 widths {spread / wide:.3f}), chi2 {chi2:.3f}, "
                f"bias {error.mean() / bound:+.3f}"
            )
            all_scaled.append(error / bound)
            assert found.mean() > 0.995, report[-1]
            assert spread <= 1.1 * bound, report[-1]
            assert 0.9 <= chi2 <= 1.1, report[-1]
            assert abs(error.mean()) < 0.2 * bound, report[-1]
    print("\n".join(report))
    scaled = np.concatenate(all_scaled)
    assert abs(scaled.mean()) < 4.0 / math.sqrt(len(scaled))


def test_the_place_within_the_pixel_does_not_matter() -> None:
    lines = Lines(3, 8000, 4000.0, 2.0, 1000.0)
    error, _, found = lines.fit()
    phase = np.remainder(lines.true_px[found], 1.0)
    bound = twins.line_bound(4000.0, 2.0, 1000.0, DARK, MAP_SIGMA, BASE_SIGMA, WINDOW_SIGMAS)
    bias = [error[np.digitize(phase, np.linspace(0.0, 1.0, 9)) == i].mean() for i in range(1, 9)]
    print("sub-pixel bias over the bound:", np.round(np.array(bias) / bound, 3))
    assert np.max(np.abs(bias)) < 0.2 * bound


@pytest.mark.parametrize("full_e", [20000.0, 9000.0])
def test_the_flanks_of_a_saturated_stripe_locate_it(full_e: float) -> None:
    lines = Lines(11, 3000, 30000.0, 4.0, 2000.0)
    censored = lines.charge >= full_e
    fits, saturated = fit(
        np.minimum(lines.charge, full_e), lines.background, lines.start, 4.0, censored=censored
    )
    found = np.isfinite(fits[:, 0])
    error = fits[found, 0] - lines.true_px[found]
    print(
        f"censored at {full_e:.0f} e-: {found.mean():.3f} found, rms {error.std():.4f} px, "
        f"chi2 {np.mean((error / fits[found, 1]) ** 2):.3f}, mean {error.mean():.5f}"
    )
    assert saturated[found].all()
    assert found.mean() > 0.99
    assert abs(error.mean()) < 2.0 * error.std() / math.sqrt(len(error))
    assert np.mean((error / fits[found, 1]) ** 2) < 1.1


@pytest.mark.parametrize("width", [2.0, 7.0])
def test_arc_light_alone_is_no_stripe(width: float) -> None:
    for level in (0.0, 2000.0, 10000.0):
        lines = Lines(5, 4000, 0.0, width, level)
        _, _, found = lines.fit()
        assert found.sum() == 0, f"arc {level}: {found.sum()} of {len(found)} lines hold a stripe"


def test_lines_without_a_start_or_a_map_are_nan() -> None:
    lines = Lines(9, 16, 4000.0, 3.0, 1000.0)
    lines.start[3], lines.start[4], lines.start[5] = np.nan, -50.0, 1e4
    lines.background[6, lines.background.shape[1] // 2] = np.nan
    fits, saturated = fit(lines.charge, lines.background, lines.start, 3.0)
    missing = np.isin(np.arange(16), [3, 4, 5, 6])
    assert np.isnan(fits[missing]).all()
    assert np.isfinite(fits[~missing]).all()
    assert not saturated.any()


def test_a_band_that_begins_elsewhere_gives_the_same_places() -> None:
    lines = Lines(9, 20, 4000.0, 3.0, 1000.0)
    lows = np.array([0, 7, 400])
    here, _ = fit(lines.charge, lines.background, lines.start, 3.0)
    begins = np.repeat(lows, CELL)[:20]
    there, _ = fit(lines.charge, lines.background, lines.start + begins, 3.0, lows=lows)
    np.testing.assert_array_equal(there[:, 0], here[:, 0] + begins)
    np.testing.assert_array_equal(there[:, 1:], here[:, 1:])


def test_a_perfect_black_level_and_no_arc_leave_the_fit_its_footing() -> None:
    lines = Lines(9, 8, 4000.0, 3.0, 0.0)
    fits, _ = fit(lines.charge, lines.background, lines.start, 3.0, base_sigma=0.0)
    np.testing.assert_allclose(fits[:, 0], lines.true_px, atol=0.2)

"""The stripe kernels against their twins, and the fit's accuracy against the Cramer-Rao bound."""

from __future__ import annotations

import math

import numpy as np
import pytest
import twins
from hypothesis import example, given, settings
from hypothesis import strategies as st

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.lanes import N_LANES, load, spread, store, where
from tracker.stripe.fit_band import MIN_BINNED_SIGMA, bin_for, offsets_within
from tracker.stripe.line_fit.block import CORRELATION_PX, WIDTH_SIGMA_LN, WINDOW_SIGMAS
from tracker.stripe.line_fit.first_guess import BLOCK, PixelVariance, line_window
from tracker.stripe.line_fit.lines import LineFits, Scans, fit_lines, fit_room, map_edge
from tracker.stripe.line_fit.normal_equations import (
    BEYOND,
    COUNTS,
    HIDDEN,
    Block,
    Equations,
    PixelNoise,
    Prior,
    Unknowns,
    moments_of,
    normal_equations,
    solve,
)
from tracker.stripe.line_fit.residuals import CORE_SIGMAS, SATURATED_SIGMAS
from tracker.stripe.viterbi import (
    JUMP_COST,
    MANY_OFFSETS,
    OFFSET_STEP,
    best_path,
    matched_filter,
    middles,
    peaks,
)
from tracker.stripe.viterbi import bell as bell_of

READ_E, GAIN = 45.0, 80.0
DARK = READ_E**2 + GAIN**2 / 12.0
MAP_SIGMA, BASE_SIGMA = 0.05, 24.0
WIDTHS, AMPLITUDES, ARC_SHARES = (2.0, 4.0, 7.0), (500.0, 2000.0, 8000.0), (0.0, 0.25, 1.0, 4.0)
seeds = st.integers(0, 2**32 - 1)


def line_fits(
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
    n_lines: Float64 | None = None,
) -> LineFits:
    """All that `fit_lines` writes."""
    n = len(charge)
    fits = LineFits.empty(n)
    scans = Scans(
        charge.astype(np.float32),
        background.astype(np.float32),
        np.zeros(charge.shape, bool) if censored is None else censored,
        start.astype(np.float64),
        np.full(n, width),
        np.ones(n) if n_lines is None else n_lines,
        np.zeros(-(-n // CELL), np.int64) if lows is None else lows,
    )
    fit_lines(scans, PixelVariance(1.0, DARK, map_sigma, base_sigma, speckle, speckle), fit_room(n), fits)
    return fits


def fit(
    charge: Float64,
    background: Float64,
    start: Float64,
    width: float,
    *,
    censored: Bool | None = None,
    lows: Float64 | None = None,
    base_sigma: float = BASE_SIGMA,
) -> tuple[Float64, Bool]:
    """The fits of lines that hold a stripe, and which are saturated."""
    fits = line_fits(charge, background, start, width, censored=censored, lows=lows, base_sigma=base_sigma)
    return fits.fits, fits.saturated


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
@given(seeds, st.sampled_from([1, 2, 4, 8]))
def test_the_matched_filter_is_its_twin(seed: int, bin_px: int) -> None:
    rng = np.random.default_rng(seed)
    n_scan, depth = rng.integers(1, 20), rng.integers(12, 120)
    n_offsets = rng.integers(1, 2 * MANY_OFFSETS)
    background = rng.uniform(-50.0, 1e4, (n_scan, depth)).astype(np.float32)
    background[rng.random(background.shape) < 0.05] = np.nan
    charge = background + rng.normal(0.0, 100.0, background.shape).astype(np.float32)
    residual, variance = charge - background, np.maximum(background, 0.0) + np.float32(60.0)
    lows = rng.integers(0, 5, -(-n_scan // CELL))
    center = rng.uniform(-10.0, depth + 10.0, n_scan)
    width = bin_px * rng.uniform(0.6, 6.0, n_scan)
    offsets = bin_px * (rng.integers(-40, 40) + OFFSET_STEP * np.arange(n_offsets))
    score = np.full((n_scan, n_offsets), np.nan, dtype=np.float32)
    around = np.empty(n_scan)
    middles(center, lows, bin_px, around)
    assert (np.abs(around - center) <= 0.5 * bin_px).all()
    matched_filter(charge, background, 1.0, 60.0, around, width, lows, offsets, bin_px, score)
    begins = np.repeat(lows, CELL)[:n_scan]
    twin = twins.matched_filter(residual, variance, center, width, begins, offsets, bin_px)
    np.testing.assert_allclose(score, twin, rtol=2e-5, atol=2e-5)


@given(st.floats(0.3, 60.0), st.floats(1.0, 300.0))
def test_bins_of_a_wide_stripe_keep_its_score_and_reach_as_far(sigma_px: float, reach_px: float) -> None:
    bin_px = bin_for(np.array([math.nan, sigma_px, 2.0 * sigma_px]))
    assert bin_px == 1 or sigma_px >= MIN_BINNED_SIGMA * bin_px
    assert sigma_px < 2.0 * MIN_BINNED_SIGMA * bin_px
    offsets = offsets_within(reach_px, bin_px)
    assert (np.diff(offsets) == OFFSET_STEP * bin_px).all()
    assert (offsets % bin_px == 0).all()
    assert offsets[0] == -offsets[-1]
    assert math.floor(reach_px) <= offsets[-1] < math.floor(reach_px) + bin_px


@pytest.mark.parametrize("sigma_px", [5.0, 9.9, 12.0, 40.0])
def test_bins_lose_less_than_a_percent_of_a_wide_stripes_score(sigma_px: float) -> None:
    """Held against the best filter over the same pixels, at the middle of a bin."""
    bin_px, depth = bin_for(np.array([sigma_px])), 64 * math.ceil(sigma_px / 4.0)
    place = np.full(1, 0.5 * depth + 0.5 * (bin_px - 1))
    bell = 1e3 * np.exp(-0.5 * ((np.arange(depth) - place) / sigma_px) ** 2)
    charge, score = bell.astype(np.float32)[None], np.empty((1, 1), np.float32)
    around, lows, offsets = np.empty(1), np.zeros(1, np.int64), np.zeros(1, np.int64)
    middles(place, lows, bin_px, around)
    width = np.full(1, sigma_px)
    matched_filter(charge, np.zeros_like(charge), 0.0, 1.0, around, width, lows, offsets, bin_px, score)
    half_px = bin_px * (math.ceil(2.5 * sigma_px / bin_px) + 0.5)
    within = bell[np.abs(np.arange(depth) - place) < half_px]
    best = np.sqrt(np.sum((within - within.mean()) ** 2))
    assert 0.99 * best < score[0, 0] <= best * (1.0 + 1e-5)


@settings(deadline=None, max_examples=60)
@given(seeds, st.floats(0.0, 12.0))
def test_no_path_is_cheaper_than_the_best_path(seed: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    n_scan, n = rng.integers(1, 30), rng.integers(1, 25)
    score = (height * rng.normal(0.0, 1.0, (n_scan, n))).astype(np.float32)
    score[rng.random(n_scan) < 0.2] = 0.0
    choice = np.full(n_scan, 99)
    best_path(score, JUMP_COST, choice)
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
    want = centers + (np.nan if choice < 0 else peak)
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
    assert start[0] == 7.2


def test_a_path_without_evidence_holds_no_stripe() -> None:
    choice = np.zeros(12, dtype=np.int64)
    best_path(np.zeros((12, 9), dtype=np.float32), JUMP_COST, choice)
    assert (choice == -1).all()


def test_the_bell_is_a_gaussian() -> None:
    t = np.linspace(-40.0, 40.0, 8001).astype(np.float32)
    bell = np.array([bell_of(one) for one in t])
    np.testing.assert_allclose(bell, np.exp(-0.5 * t.astype(np.float64) ** 2), rtol=0.0, atol=1e-6)


@kernel
def solved(h: Float32, g: Float32, out: Float32) -> None:
    """Solve sixteen equations of lower triangles h (15, N_LANES) and gradients g (5, N_LANES)."""
    equations = Equations(
        load(h[0], 0), load(h[1], 0), load(h[2], 0), load(h[3], 0), load(h[4], 0), load(h[5], 0),
        load(h[6], 0), load(h[7], 0), load(h[8], 0), load(h[9], 0), load(h[10], 0), load(h[11], 0),
        load(h[12], 0), load(h[13], 0), load(h[14], 0),
        load(g[0], 0), load(g[1], 0), load(g[2], 0), load(g[3], 0), load(g[4], 0),
    )  # fmt: skip
    s = solve(equations)
    numbers = (s.step_0, s.step_1, s.step_2, s.step_3, s.step_4, s.gained, s.variance_0, s.variance_1)
    for k in range(len(numbers)):
        store(out[k], 0, numbers[k])
    store(out[8], 0, where(s.is_positive, spread(1.0), spread(0.0)))


LOWER = np.tril_indices(5)
"""The elements of `Equations`, in its order."""


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(-6.0, 6.0))
def test_solve_is_the_linear_solver_in_every_lane(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (N_LANES, 5, 5)) + 2.0 * np.eye(5)
    scale = 10.0 ** np.linspace(0.0, decades, 5)
    plain = root @ root.swapaxes(1, 2) + 0.3 * np.eye(5)
    H, g = plain * np.outer(scale, scale), scale * rng.normal(0.0, 1.0, (N_LANES, 5))
    out = np.empty((9, N_LANES), np.float32)
    solved(H[:, *LOWER].T.astype(np.float32).copy(), g.T.astype(np.float32).copy(), out)
    for lane in range(N_LANES):
        exact, inverse = np.linalg.solve(H[lane], g[lane]), np.linalg.inv(H[lane])
        digits = 3e-6 * np.linalg.cond(plain[lane])
        size = np.abs(exact * scale).max()
        np.testing.assert_allclose(out[:5, lane] * scale, exact * scale, rtol=0.0, atol=digits * size)
        assert out[5, lane] == pytest.approx(g[lane] @ exact, rel=digits)
        assert out[6:8, lane] == pytest.approx(np.diag(inverse)[:2], rel=digits)
        assert out[8, lane] == 1.0


def test_solve_refuses_what_is_not_positive_in_its_own_lane_alone() -> None:
    H = np.repeat(np.eye(5)[None], N_LANES, axis=0)
    H[3, 2, 2], H[7] = -1.0, 0.0
    out = np.empty((9, N_LANES), np.float32)
    solved(H[:, *LOWER].T.astype(np.float32).copy(), np.ones((5, N_LANES), np.float32), out)
    np.testing.assert_array_equal(out[8] > 0.0, ~np.isin(np.arange(N_LANES), [3, 7]))


@kernel
def equations_of(block: Block, n: int, x: Float32, noise: Float32, out: Float32) -> None:
    """Write the equations (20, N_LANES) of lines at x (5, N_LANES), with their chi2 and used pixels."""
    place, width = load(x[1], 0), load(x[2], 0)
    unknowns = Unknowns(load(x[0], 0), place, load(x[3], 0), load(x[4], 0))
    law = PixelNoise(spread(noise[0]), spread(noise[1]), spread(noise[2]))
    m = moments_of(block, n, unknowns, spread(1.0) / width, law)
    nothing = Prior(spread(0.0), spread(0.0), spread(0.0), spread(0.0))
    equations = normal_equations(m, unknowns, nothing)
    for k in range(len(equations)):
        store(out[k], 0, equations[k])
    store(out[20], 0, m.chi2)
    store(out[21], 0, m.used)


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

    charge, kind = (
        mean(x) + rng.normal(0.0, 100.0, n),
        rng.choice([COUNTS, HIDDEN, BEYOND], n, p=[0.7, 0.2, 0.1]),
    )
    steps = 1e-5 * np.diag(np.maximum(np.abs(x), 1.0))
    J = np.stack([(mean(x + step) - mean(x - step)) / (2.0 * step.sum()) for step in steps], axis=1)
    residual = charge - mean(x)
    counts = (kind == COUNTS) | ((kind == HIDDEN) & (residual > 0.0))
    stripe = x[0] * np.exp(-0.5 * ((r - x[1] * width) / np.exp(x[2])) ** 2)
    weight = counts / (shot * np.maximum(mean(x), 0.0) + DARK + (speckle * stripe) ** 2)
    # The line is in one lane, and others are elsewhere.
    lane = int(rng.integers(N_LANES))
    pixels = [rng.uniform(0.0, 9000.0, (n, N_LANES)) for _ in range(2)] + [np.ones((n, N_LANES))]
    for lines, line in zip(pixels, (charge, background, kind), strict=True):
        lines[:, lane] = line
    block = Block(*(lines.astype(np.float32).ravel() for lines in pixels))
    at = np.tile(x[:, None], N_LANES)
    at[2] = width
    out = np.empty((22, N_LANES), np.float32)
    equations_of(block, n, at.astype(np.float32), np.array([shot, DARK, speckle], np.float32), out)
    H, g = np.zeros((5, 5)), out[15:20, lane]
    H[LOWER] = out[:15, lane]
    exact = J.T @ (weight[:, None] * J)
    scale = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(H / np.outer(scale, scale), np.tril(exact / np.outer(scale, scale)), atol=5e-5)
    off = math.sqrt(np.sum(weight * residual**2))
    np.testing.assert_allclose(g / scale / off, J.T @ (weight * residual) / scale / off, atol=1e-4)
    assert out[20, lane] == pytest.approx(off**2, rel=1e-3)
    assert out[21, lane] == counts.sum()


@settings(deadline=None, max_examples=20)
@given(seeds, st.integers(1, 40))
def test_a_line_is_fitted_the_same_whatever_lines_stand_beside_it(seed: int, n: int) -> None:
    """Bit for bit: lines of other brightness, and lines that hold nothing, share its vector."""
    rng = np.random.default_rng(seed)
    drawn = [Lines(seed + k, 1, rng.uniform(300.0, 9000.0), 4.0, rng.uniform(0.0, 9000.0)) for k in range(n)]
    charge, background, start = (
        np.concatenate([getattr(line, name) for line in drawn]) for name in ("charge", "background", "start")
    )
    start[rng.random(n) < 0.2] = np.nan
    # An even map has no edges, which would be those of the lines beside.
    background[:] = 500.0
    together, order = fit(charge, background, start, 4.0)[0], rng.permutation(n)
    np.testing.assert_array_equal(fit(charge[order], background, start[order], 4.0)[0], together[order])


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(0.0, 0.3))
def test_what_scatters_about_the_bells_is_its_twin(seed: int, contrast: float) -> None:
    rng = np.random.default_rng(seed)
    n, depth, width = 40, 64, float(rng.uniform(2.0, 5.0))
    true_px, amplitude = rng.uniform(22.0, 42.0, n), rng.uniform(1e3, 9e3, n)
    bell = amplitude[:, None] * np.exp(-0.5 * ((np.arange(depth) - true_px[:, None]) / width) ** 2)
    background = rng.uniform(0.0, 1e3, (n, 1)) * np.ones(depth)
    charge = bell * (1.0 + contrast * rng.normal(size=bell.shape)) + background
    charge += rng.normal(0.0, np.sqrt(bell + background + DARK))
    censored = rng.random(bell.shape) < 0.05
    found = line_fits(charge, background, np.rint(true_px), width, censored=censored)
    position, _, height, sigma = found.fits.T[:4, :, None]
    t = (np.arange(depth) - position) / sigma
    fitted = height * np.exp(-0.5 * t**2)
    over = (charge - background - fitted) ** 2 - np.maximum(fitted + background, 0.0) - DARK
    counts = (np.abs(t) <= CORE_SIGMAS) & ~censored
    with np.errstate(invalid="ignore"):
        twin = np.where(counts, over, 0.0).sum(1) / np.where(counts, fitted**2, 0.0).sum(1)
    held = np.isfinite(found.fits[:, 0])
    assert held.sum() > 30
    np.testing.assert_allclose(found.core[held], twin[held], rtol=1e-2, atol=1e-5)
    assert np.isnan(found.core[~held]).all()
    near = np.abs(np.arange(depth) - position) <= SATURATED_SIGMAS * width
    np.testing.assert_array_equal(found.saturated[held], (near & censored).any(axis=1)[held])


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
    change = map_edge(background, lows, s, position)
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

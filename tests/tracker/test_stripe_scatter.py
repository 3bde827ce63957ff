"""The scatter that lines show themselves: kernels against NumPy twins, and frames whose setup states none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import rendered
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from noise_model.arc.scene import make_scene
from noise_model.arrays import Float64
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import SensorGeometry
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe
from tracker.stripe.scatter import (
    BRIGHTNESS_LAGS,
    CORE_SIGMAS,
    LAGS,
    LENGTHS,
    MAX_WIDTH_LIMIT_LN,
    MEDIAN_CHI2,
    MIN_DIFFERENCES,
    MIN_MEANS,
    MIN_PER_FAR_LAG,
    MIN_PER_LAG,
    MIN_SEEN_SHARE,
    MIN_WIDTH_LIMIT_LN,
    NO_SCATTER,
    REMEMBERED,
    FrameScatter,
    Scatter,
    differences,
    frame_scatter,
    own_sigma,
    speckle_squared,
)
from tracker.tracker import Tracker

CELL = 8
seeds = st.integers(0, 2**32 - 1)


def shown(of: Float64, sigma: Float64, amplitude: Float64) -> tuple[Float64, Float64, Float64]:
    """What `differences` shows of centres off their expected places."""
    by_lag, by_length = np.empty(len(LAGS)), np.empty(len(LENGTHS))
    brightness = np.empty(len(BRIGHTNESS_LAGS))
    # Columns of the lines' fits: of another layout it would be compiled once more.
    centers, amplitudes = np.column_stack([of, amplitude]).T
    expected = np.zeros(len(of))
    lags = LAGS, LENGTHS, BRIGHTNESS_LAGS
    differences(centers, expected, sigma, amplitudes, *lags, MIN_MEANS, by_lag, by_length, brightness)
    return by_lag, by_length, brightness


def beyond(second: Float64, own: Float64, weight: float, least: float) -> float:
    """The variance that second differences (n,) show beyond the lines' own, as the module's text has it."""
    known = np.isfinite(second)
    if known.sum() < least:
        return math.nan
    return float(np.median(weight * second[known] ** 2 / 6.0) / MEDIAN_CHI2 - np.median(own[known]))


def of_three(values: Float64, lag: int) -> Float64:
    return values[: -2 * lag] - 2.0 * values[lag:-lag] + values[2 * lag :]


def own_of_three(variance: Float64, lag: int) -> Float64:
    return (variance[: -2 * lag] + 4.0 * variance[lag:-lag] + variance[2 * lag :]) / 6.0


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(30, 900), st.floats(0.0, 0.5))
def test_differences_are_their_twin(seed: int, n: int, lost: float) -> None:
    rng = np.random.default_rng(seed)
    off, sigma = rng.normal(0.0, 0.3, n), rng.uniform(0.01, 0.3, n)
    amplitude = rng.uniform(500.0, 900.0, n)
    gone = rng.random(n) < lost
    off[gone], sigma[gone], amplitude[gone] = np.nan, np.nan, np.nan
    by_lag, by_length, brightness = shown(off, sigma, amplitude)
    for found, lag in zip(by_lag, LAGS.tolist(), strict=True):
        twin = beyond(of_three(off, lag), own_of_three(sigma**2, lag), 1.0, MIN_PER_LAG * lag)
        assert found == pytest.approx(twin, nan_ok=True)
    for found, length in zip(by_length, LENGTHS.tolist(), strict=True):
        runs = [values[: n // length * length].reshape(-1, length) for values in (off, sigma**2)]
        enough = np.isfinite(runs[0]).sum(axis=1) >= MIN_SEEN_SHARE * length
        mean, own = (
            np.where(enough, np.nansum(run, axis=1), np.nan) / np.maximum(np.isfinite(run).sum(axis=1), 1)
            for run in runs
        )
        twin = beyond(of_three(mean, 1), own_of_three(own, 1), float(length), MIN_MEANS)
        assert found == pytest.approx(twin, nan_ok=True)
    least = [MIN_DIFFERENCES] * len(LAGS) + [MIN_PER_FAR_LAG * int(BRIGHTNESS_LAGS[-1])]
    bright = [
        beyond(of_three(amplitude, lag), np.zeros(max(n - 2 * lag, 0)), 1.0, enough)
        for lag, enough in zip(BRIGHTNESS_LAGS.tolist(), least, strict=True)
    ]
    assert brightness == pytest.approx(np.array(bright) / np.nanmedian(amplitude) ** 2, nan_ok=True)


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(-40.0, 40.0), st.floats(-0.3, 0.3))
def test_where_a_straight_stripe_lies_is_no_scatter(seed: int, offset: float, slope: float) -> None:
    rng = np.random.default_rng(seed)
    off, sigma, amplitude = rng.normal(0.0, 0.1, 640), np.full(640, 0.1), rng.uniform(500.0, 900.0, 640)
    moved = off + offset + slope * np.arange(640)
    for found, same in zip(shown(moved, sigma, amplitude), shown(off, sigma, amplitude), strict=True):
        np.testing.assert_allclose(found, same, atol=1e-9)


@pytest.mark.parametrize("grain", [0.0, 1.5])
def test_the_variance_that_lines_share_is_what_was_drawn(grain: float) -> None:
    """White scatter of 0.2 px and, with a grain, neighbours off alike: their correlation's sum counts."""
    rng, seen = np.random.default_rng(4), []
    n, own, shared = 1280, 0.1, 0.2
    reach = np.arange(-8.0, 9.0)
    kernel = np.exp(-0.5 * (reach / max(grain, 1e-3)) ** 2)
    kernel /= np.linalg.norm(kernel)
    for _ in range(60):
        off = own * rng.normal(size=n) + shared * np.convolve(rng.normal(size=n + 16), kernel, "valid")
        by_lag, by_length, _ = shown(off, np.full(n, own), np.ones(n))
        seen.append((by_lag, by_length))
    by_lag, by_length = (np.mean(values, axis=0) for values in zip(*seen, strict=True))
    alike = 1.0 if grain == 0.0 else float(kernel.sum() ** 2)
    assert by_lag[-1] == pytest.approx(shared**2, rel=0.1)
    # A mean over 16 lines holds some grains whole and cuts those at its ends.
    assert by_length[-1] == pytest.approx(alike * shared**2, rel=0.3)


def test_means_of_a_joint_that_is_searched_tell_nothing_by_themselves() -> None:
    """While it is searched, a joint's corners may be anywhere among few means."""
    rng = np.random.default_rng(5)
    fits = np.column_stack([rng.normal(size=640), np.ones((640, 6))])
    ones = np.ones(640)
    settled = frame_scatter(fits, np.zeros(640), ones, ones, 0.0, False)
    searched = frame_scatter(fits, np.zeros(640), ones, ones, 0.0, True)
    assert np.isfinite(settled.by_length).all()
    np.testing.assert_array_equal(searched.by_length[:-1], settled.by_length[:-1])
    assert math.isnan(searched.by_length[-1])


@pytest.mark.parametrize("n", [160, 320, 640])
def test_a_joint_that_is_off_its_expected_place_is_no_scatter(n: int) -> None:
    """A V of a seventh of the view, off by an eighth of its width: four corners bend what lies beside."""
    rng, s, half = np.random.default_rng(5), np.arange(n), n / 14.0
    own, most = 0.05, []
    for _ in range(40):
        deep = [100.0 * np.maximum(1.0 - np.abs(s - n / 2.0 - off) / half, 0.0) for off in (0.0, half / 4.0)]
        off = deep[1] - deep[0] + own * rng.normal(size=n)
        scatter = NO_SCATTER.with_frame(
            FrameScatter(*shown(off, np.full(n, own), np.ones(n)), *(np.array(math.nan),) * 3)
        )
        most.append(scatter.mean_variance_px2 / own**2)
    print(f"{n} lines: {np.mean(most):.2f} of the lines' own variance, {np.max(most):.2f} at most")
    # Alone the lines have one; a joint may feign up to two more.
    assert np.mean(most) < 2.0


@settings(deadline=None, max_examples=20)
@given(seeds, st.floats(0.0, 0.3))
def test_speckle_squared_is_its_twin(seed: int, contrast: float) -> None:
    rng = np.random.default_rng(seed)
    n, depth, dark = 40, 48, 900.0
    lows = rng.integers(0, 20, -(-n // CELL))
    low = np.repeat(lows, CELL)[:n]
    centre, width = low + rng.uniform(12.0, 36.0, n), rng.uniform(2.0, 5.0, n)
    amplitude = rng.uniform(1e3, 9e3, n)
    t = (np.arange(depth) + low[:, None] - centre[:, None]) / width[:, None]
    bell = amplitude[:, None] * np.exp(-0.5 * t**2)
    background = rng.uniform(0.0, 1e3, (n, depth)).astype(np.float32)
    charge = bell * (1.0 + contrast * rng.normal(size=bell.shape)) + background
    charge = (charge + rng.normal(0.0, np.sqrt(bell + background + dark))).astype(np.float32)
    censored = rng.random(bell.shape) < 0.1
    fits = np.column_stack([centre, np.full(n, 0.1), amplitude, width, np.ones(n)])
    fits[rng.random(n) < 0.2] = np.nan
    over = (charge.astype(float) - background - bell) ** 2 - np.maximum(bell + background, 0.0) - dark
    counts = (np.abs(t) <= CORE_SIGMAS) & ~censored
    squares = (np.where(counts, over, 0.0).sum(1) / np.where(counts, bell**2, 0.0).sum(1))[
        np.isfinite(fits[:, 0])
    ]
    twin = np.median(squares) if len(squares) >= MIN_DIFFERENCES else math.nan
    found = speckle_squared(charge, background, censored, fits, lows, CELL, 1.0, dark)
    assert found == pytest.approx(twin, rel=1e-3, abs=1e-6, nan_ok=True)


def frame(value: float) -> FrameScatter:
    sizes = len(LAGS), len(LENGTHS), len(BRIGHTNESS_LAGS)
    return FrameScatter(*(np.full(n, value) for n in sizes), *(np.array(value) for _ in range(3)))


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.8])
def test_neighbours_brightness_is_as_alike_as_it_was_drawn(alike: float) -> None:
    rng, n, contrast = np.random.default_rng(11), 4000, 0.2
    scatter = [rng.standard_normal()]
    for drawn in rng.standard_normal(n - 1):
        scatter.append(alike * scatter[-1] + math.sqrt(1.0 - alike**2) * drawn)
    amplitude = 1000.0 * (1.0 + contrast * np.array(scatter))
    seen = shown(np.zeros(n), np.ones(n), amplitude)
    learned = NO_SCATTER.with_frame(FrameScatter(*seen, *(np.array(math.nan),) * 3))
    assert learned.brightness_contrast == pytest.approx(contrast, rel=0.15)
    assert learned.brightness_alike == pytest.approx(alike, abs=0.1)


def test_grains_that_reach_far_add_what_they_move_centres_together() -> None:
    """An isotropic texture beneath a sheet: twice the covariances of centroids 9 to 16 lines apart."""
    rng, n, half, width = np.random.default_rng(12), 2000, 12, 3.0
    across = np.arange(-half, half + 1.0)
    bell = np.exp(-0.5 * (across / width) ** 2)
    seen, apart = [], []
    for _ in range(8):
        field = gaussian_filter(rng.normal(size=(n, 4 * half)), 9.0, mode="wrap")[:, : 2 * half + 1]
        light = np.exp(0.15 * field / field.std()) * bell
        amplitude = light.sum(axis=1)
        centroid = light @ across / amplitude
        centroid -= centroid.mean()
        seen.append(shown(centroid, np.full(n, 1e-3), 1e4 * amplitude))
        apart.append([np.mean(centroid[r:] * centroid[: n - r]) for r in range(9, 17)])
    learned = NO_SCATTER
    for of_frame in seen:
        learned = learned.with_frame(FrameScatter(*of_frame, *(np.array(math.nan),) * 3))
    nothing = np.zeros(1)
    together = learned.widened(nothing, width)[1] ** 2 - learned.widened(nothing, 0.0)[1] ** 2
    assert together[0] == pytest.approx(2.0 * np.mean(apart, axis=0).sum(), rel=0.3)


def test_the_first_frame_counts_whole_and_old_ones_fade() -> None:
    assert NO_SCATTER.with_frame(frame(0.25)).line_variance_px2 == 0.25
    scatter = NO_SCATTER
    for n in range(REMEMBERED):
        scatter = scatter.with_frame(frame(float(n)))
    # So many frames count alike.
    assert scatter.line_variance_px2 == pytest.approx((REMEMBERED - 1) / 2.0)
    steel = scatter.line_variance_px2
    for _ in range(3 * REMEMBERED):
        scatter = scatter.with_frame(frame(0.0))
    assert scatter.line_variance_px2 == pytest.approx(steel * (1.0 - 1.0 / REMEMBERED) ** (3 * REMEMBERED))


def test_a_frame_that_shows_nothing_changes_nothing() -> None:
    before = NO_SCATTER.with_frame(frame(0.04))
    after = before.with_frame(frame(math.nan))
    for one, other in zip(before.average, after.average, strict=True):
        np.testing.assert_array_equal(one, other)
    blank = NO_SCATTER.with_frame(frame(math.nan))
    sigma = np.array([0.1, 0.2, np.nan])
    for scatter in (NO_SCATTER, blank):
        assert (scatter.line_variance_px2, scatter.mean_variance_px2) == (0.0, 0.0)
        assert (scatter.weighing_contrast, scatter.brightness_contrast) == (0.0, 0.0)
        assert (scatter.width_factor, scatter.width_limit_ln) == (1.0, MIN_WIDTH_LIMIT_LN)
        for widened in scatter.widened(sigma, 3.0):
            np.testing.assert_allclose(widened, sigma)


@given(st.floats(-1.0, 1.0), st.floats(-0.1, 4.0))
def test_a_scatter_keeps_its_bounds(ln_width: float, variance: float) -> None:
    """Less than none is chance; a stripe that is far wider is another light."""
    seen = frame(variance)._replace(ln_width=np.array(ln_width))
    scatter = NO_SCATTER.with_frame(seen)
    assert scatter.line_variance_px2 == max(variance, 0.0)
    assert scatter.mean_variance_px2 >= scatter.line_variance_px2
    assert MIN_WIDTH_LIMIT_LN <= scatter.width_limit_ln <= MAX_WIDTH_LIMIT_LN
    assert math.exp(-0.5) <= scatter.width_factor <= math.exp(0.5)


def test_a_misfit_of_all_lines_is_left_to_the_scatter() -> None:
    fits = np.column_stack([np.zeros(50), np.full(50, 0.3), np.ones(50), np.ones(50), np.full(50, 9.2)])
    expected = np.full(50, 4.0)
    excess = 9.2 - 0.25
    fits[:, 1] = 0.1 * math.sqrt(excess)
    np.testing.assert_allclose(own_sigma(fits, expected), 0.1)
    # A line that fits better is as sure as its photons let it be; a worse one keeps what it is worse by.
    fits[3, 1:] = 0.1, 1.0, 1.0, 1.0
    assert own_sigma(fits, expected)[3] == pytest.approx(0.1)
    fits[7, 1:] = 0.1 * math.sqrt(4.0 * excess), 1.0, 1.0, 4.0 * excess + 0.25
    assert own_sigma(fits, expected)[7] == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "grain_px"), [(0.0, 1.0), (0.1, 1.0), (0.2, 0.5), (0.2, 2.0)])
def test_centres_scatter_by_their_sigma_though_no_speckle_is_stated(contrast: float, grain_px: float) -> None:
    """Laser speckle is drawn that the tracker's setup does not state."""
    plain = rendered.small_setup("v_groove")
    setup = replace(plain, effects={"laser_speckle": {"contrast": contrast, "grain_px": grain_px}})
    pose, renderer, rng = rendered.pose_at(0.0), Renderer(), np.random.default_rng(5)
    expected = expect_stripe(SensorGeometry.of(plain), make_scene(plain, pose.T_base_tool))
    assert expected is not None
    true = expected.position_px + expected.bias_px
    bend = np.abs(np.gradient(np.gradient(expected.position_px))) > 0.02
    face = np.convolve(bend, np.ones(41), "same") == 0.0
    tracker, own, together = Tracker(plain), [], []
    for n in range(14):
        condition = Condition(1.0, 1.0, rendered.EXPOSURE_S)
        image = draw_frame(setup, pose.T_base_tool, condition, rng, renderer=renderer)
        drawn = Frame(n, 0.1 * n, image, rendered.EXPOSURE_S, rendered.CURRENT_A)
        stripe = tracker.step(drawn, pose).stripe
        assert stripe is not None
        if n >= 2:
            own.append(((stripe.position_px - true) / stripe.sigma_px)[face])
            together.append(((stripe.smooth_px - true) / stripe.smooth_sigma_px)[face])
    pulls = [math.sqrt(np.nanmean(np.square(pull))) for pull in (own, together)]
    print(f"contrast {contrast}, grain {grain_px} px: pulls {pulls[0]:.2f}, with neighbours {pulls[1]:.2f}")
    assert 0.8 <= pulls[0] <= 1.25
    assert 0.7 <= pulls[1] <= 1.25


def test_a_tracker_learns_and_keeps_its_scatter() -> None:
    setup = rendered.small_setup("v_groove")
    tracker, scatter = Tracker(setup), []
    for drawn, pose in rendered.walk(setup, 3):
        tracker.step(drawn, pose)
        scatter.append(tracker.state.scatter)
    assert [one.frames for one in scatter] == [1, 2, 3]
    assert all(isinstance(one, Scatter) for one in scatter)
    # A frame without laser shows nothing.
    dark = replace(drawn, index=3, timestamp_s=9.0, laser_on=False)
    tracker.step(dark, pose)
    assert tracker.state.scatter is scatter[-1]

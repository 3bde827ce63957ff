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
from noise_model.compiled.arrays import Float32, Float64
from noise_model.compiled.median import numbers_for
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import SensorGeometry
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe
from tracker.stripe.frame_scatter import (
    MEDIAN_CHI2,
    MIN_DIFFERENCES,
    MIN_MEANS,
    MIN_PER_FAR_LAG,
    MIN_PER_LAG,
    MIN_SEEN_SHARE,
    N_SCRATCH,
    differences,
    frame_scatter,
    own_sigma,
)
from tracker.stripe.line_fit.lines import N_FITTED
from tracker.stripe.scatter import (
    BRIGHTNESS_LAGS,
    FAR_LAG,
    LAGS,
    LENGTHS,
    LN_WIDTH,
    MAX_WIDTH_LIMIT_LN,
    MIN_WIDTH_LIMIT_LN,
    N_NUMBERS,
    NO_SCATTER,
    REMEMBERED,
    SPECKLE,
    WIDTH_VARIANCE,
    FrameScatter,
    Scatter,
    add_frame,
    brightness_correlation,
    brightness_plateau,
    brightness_share,
    centre_share,
    line_variance_px2,
    mean_variance_px2,
    widen,
)
from tracker.stripe.smooth import smoothed
from tracker.tracker import Tracker

seeds = st.integers(0, 2**32 - 1)


NOTHING = tuple(np.array(math.nan) for _ in range(3))


def room_for(n: int) -> tuple[Float32, Float64]:
    """Scratch for a frame of so many lines."""
    return np.empty(numbers_for(n), np.float32), np.empty((N_SCRATCH, n))


def shown(
    off: Float64,
    sigma: Float64,
    amplitude: Float64,
    n_lines: Float64 | None = None,
    learned: Scatter = NO_SCATTER,
) -> tuple[Float64, Float64, Float64]:
    """What `differences` shows of centres off their expected places."""
    n, seen = len(off), np.empty(N_NUMBERS)
    fits, read = np.zeros((n, N_FITTED)), np.ones(n) if n_lines is None else n_lines
    fits[:, 0], fits[:, 2] = off, amplitude
    smooth, known = np.ones(n, np.bool_), learned.average.numbers
    differences(fits, np.zeros(n), sigma, read, smooth, known, 1, MIN_MEANS, *room_for(n), seen)
    return FrameScatter.of(seen)[:3]


def own_of(fits: Float64, expected: Float64) -> Float64:
    """The lines' own 1 sigma."""
    own = np.empty(len(fits))
    own_sigma(fits, expected, np.ones(len(fits)), room_for(len(fits))[0], own)
    return own


def widened(scatter: Scatter, own: Float64, sheet_px: float) -> tuple[Float64, Float64]:
    """The lines' 1 sigma with the scatter, alone and among neighbours."""
    sigma, beside = np.empty((2, len(own)))
    widen(scatter.average.numbers, own, np.ones(len(own)), sheet_px, sigma, beside)
    return sigma, beside


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
        least = MIN_PER_LAG * lag if lag >= FAR_LAG else MIN_DIFFERENCES
        twin = beyond(of_three(off, lag), own_of_three(sigma**2, lag), 1.0, least)
        assert found == pytest.approx(twin, rel=1e-6, abs=1e-7, nan_ok=True)
    for found, length in zip(by_length, LENGTHS.tolist(), strict=True):
        runs = [values[: n // length * length].reshape(-1, length) for values in (off, sigma**2)]
        enough = np.isfinite(runs[0]).sum(axis=1) >= MIN_SEEN_SHARE * length
        mean, own = (
            np.where(enough, np.nansum(run, axis=1), np.nan) / np.maximum(np.isfinite(run).sum(axis=1), 1)
            for run in runs
        )
        twin = beyond(of_three(mean, 1), own_of_three(own, 1), float(length), MIN_MEANS)
        assert found == pytest.approx(twin, rel=1e-6, abs=1e-7, nan_ok=True)
    enough_each = [MIN_DIFFERENCES] * len(LAGS) + [MIN_PER_FAR_LAG * int(BRIGHTNESS_LAGS[-1])]
    bright = [
        beyond(of_three(amplitude, lag), np.zeros(max(n - 2 * lag, 0)), 1.0, enough)
        for lag, enough in zip(BRIGHTNESS_LAGS.tolist(), enough_each, strict=True)
    ]
    assert brightness == pytest.approx(np.array(bright) / np.nanmedian(amplitude) ** 2, nan_ok=True)


def plain_share(variances: Float64, plateau: float) -> float:
    """The share of a line's variance that two neighbours' mean has, from the covariances of lines apart."""
    C_4 = np.clip(0.75 * (plateau - variances[2]), 0.0, plateau)
    C_2 = np.clip(0.75 * (plateau - variances[1] + C_4 / 3.0), 0.0, plateau)
    C_1 = np.clip(0.75 * (plateau - variances[0] + C_2 / 3.0), 0.0, plateau)
    return float((plateau + C_1) / (2.0 * plateau)) if plateau > 0.0 else 0.5


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(200, 900))
def test_pairs_among_lines_are_compared_as_their_twin(seed: int, n: int) -> None:
    """Near ones where they were read alone, far ones by the share that a pair has of a line's variance."""
    rng = np.random.default_rng(seed)
    known = frame(0.0)._replace(
        by_lag=rng.uniform(0.0, 0.1, len(LAGS)), brightness=rng.uniform(0.0, 0.1, len(BRIGHTNESS_LAGS))
    )
    learned = with_frame(NO_SCATTER, known)
    line = max(known.by_lag[-2:].max(), 0.0)
    of_centres = plain_share(known.by_lag, line)
    of_light = plain_share(known.brightness, known.brightness[: len(LAGS)].max())
    assert centre_share(learned.average.numbers) == pytest.approx(of_centres)
    assert brightness_share(learned.average.numbers) == pytest.approx(of_light)
    off, own, amplitude = rng.normal(0.0, 0.3, n), np.full(n, 0.2), rng.uniform(500.0, 900.0, n)
    n_lines = np.repeat(rng.choice([1.0, 2.0], n // 2 + 1), 2)[:n]
    by_lag, _, brightness = shown(off, own, amplitude, n_lines, learned)
    pair = n_lines == 2
    share = np.where(pair, (0.5 * own**2 + of_centres * line) / (own**2 + line), 1.0)
    light = np.where(pair, of_light, 1.0)
    for k, lag in enumerate(LAGS.tolist()):
        is_far = lag >= FAR_LAG
        least, read = MIN_PER_LAG * lag if is_far else MIN_DIFFERENCES, [off, amplitude]
        read = [values if is_far else np.where(pair, np.nan, values) for values in read]
        second = of_three(read[0], lag) / np.sqrt(own_of_three(share, lag))
        twin = beyond(second, own_of_three(own**2, lag), 1.0, least)
        assert by_lag[k] == pytest.approx(twin, rel=1e-5, abs=1e-6, nan_ok=True)
        second = of_three(read[1], lag) / np.sqrt(own_of_three(light, lag))
        twin = beyond(second, np.zeros(n - 2 * lag), 1.0, MIN_DIFFERENCES) / np.median(amplitude) ** 2
        assert brightness[k] == pytest.approx(twin, rel=1e-5, nan_ok=True)


def test_what_is_not_known_of_neighbours_makes_a_pair_no_surer_than_a_line() -> None:
    known = frame(0.0)._replace(by_lag=np.array([math.nan, 0.03, 0.04, 0.04]))
    assert centre_share(with_frame(NO_SCATTER, known).average.numbers) == 1.0
    assert centre_share(NO_SCATTER.average.numbers) == 0.5


def test_a_pairs_sigma_is_its_own_and_what_it_scatters_by() -> None:
    known = frame(0.0)._replace(
        by_lag=np.array([0.02, 0.03, 0.04, 0.04]), by_length=np.full(len(LENGTHS), 0.1)
    )
    learned, n_lines = with_frame(NO_SCATTER, known), np.array([1.0, 2.0])
    sigma, beside = np.empty((2, 2))
    widen(learned.average.numbers, np.full(2, 0.2), n_lines, 0.0, sigma, beside)
    np.testing.assert_allclose(sigma**2, [0.04 + 0.04, 0.02 + centre_share(learned.average.numbers) * 0.04])
    np.testing.assert_allclose(beside**2, 0.04 + 0.1)


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
    """White scatter of 0.2 px and, with a grain, neighbours off in common: their correlation's sum counts."""
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
    correlation = 1.0 if grain == 0.0 else float(kernel.sum() ** 2)
    assert by_lag[-1] == pytest.approx(shared**2, rel=0.1)
    # A mean over 16 lines holds some grains whole and cuts those at its ends.
    assert by_length[-1] == pytest.approx(correlation * shared**2, rel=0.3)


def test_means_of_a_joint_that_is_searched_tell_nothing_by_themselves() -> None:
    """While it is searched, a joint's corners may be anywhere among few means."""
    rng = np.random.default_rng(5)
    fits = np.column_stack([rng.normal(size=640), np.ones((640, 6))])
    ones = np.ones(640)
    core, room = np.zeros(640, np.float32), room_for(640)
    alone = np.ones(640), ones > 0.0, NO_SCATTER.average.numbers
    settled, searched = np.empty((2, N_NUMBERS))
    frame_scatter(fits, np.zeros(640), ones, ones, core, *alone, False, *room, settled)
    frame_scatter(fits, np.zeros(640), ones, ones, core, *alone, True, *room, searched)
    assert np.isfinite(FrameScatter.of(settled).by_length).all()
    np.testing.assert_array_equal(
        FrameScatter.of(searched).by_length[:-1], FrameScatter.of(settled).by_length[:-1]
    )
    assert math.isnan(FrameScatter.of(searched).by_length[-1])


@pytest.mark.parametrize("n", [160, 320, 640])
def test_a_joint_that_is_off_its_expected_place_is_no_scatter(n: int) -> None:
    """A V of a seventh of the view, off by an eighth of its width: four corners bend what lies beside."""
    rng, s, half = np.random.default_rng(5), np.arange(n), n / 14.0
    own, most = 0.05, []
    for _ in range(40):
        deep = [100.0 * np.maximum(1.0 - np.abs(s - n / 2.0 - off) / half, 0.0) for off in (0.0, half / 4.0)]
        off = deep[1] - deep[0] + own * rng.normal(size=n)
        scatter = with_frame(NO_SCATTER, FrameScatter(*shown(off, np.full(n, own), np.ones(n)), *NOTHING))
        most.append(mean_variance_px2(scatter.average.numbers) / own**2)
    print(f"{n} lines: {np.mean(most):.2f} of the lines' own variance, {np.max(most):.2f} at most")
    # Alone the lines have one; a joint may feign up to two more.
    assert np.mean(most) < 2.0


@settings(deadline=None, max_examples=20)
@given(seeds, st.integers(0, 60))
def test_speckle_and_width_are_the_lines_medians(seed: int, n: int) -> None:
    rng, seen = np.random.default_rng(seed), np.empty(N_NUMBERS)
    fits = np.column_stack([rng.normal(size=(n, 3)), rng.uniform(2.0, 5.0, n), np.ones((n, 3))])
    core = rng.normal(0.02, 0.01, n).astype(np.float32)
    gone = rng.random(n) < 0.3
    fits[gone], core[gone] = np.nan, np.nan
    width, ones = rng.uniform(3.0, 4.0, n), np.ones(n)
    alone = np.ones(n), ones > 0.0, NO_SCATTER.average.numbers
    frame_scatter(fits, ones, width, ones, core, *alone, False, *room_for(n), seen)
    if n - gone.sum() < MIN_DIFFERENCES:
        assert np.isnan(seen[SPECKLE:]).all()
        return
    ln_width = np.log(fits[:, 3] / width)[~gone]
    variance = np.median((ln_width - np.median(ln_width)) ** 2) / MEDIAN_CHI2
    assert seen[SPECKLE] == pytest.approx(np.nanmedian(core))
    assert seen[LN_WIDTH] == pytest.approx(np.median(ln_width), rel=1e-6, abs=1e-7)
    assert seen[WIDTH_VARIANCE] == pytest.approx(variance, rel=1e-5, abs=1e-9)


def with_frame(scatter: Scatter, seen: FrameScatter) -> Scatter:
    """The scatter with one more frame."""
    after = np.empty(N_NUMBERS)
    add_frame(scatter.average.numbers, scatter.frames, seen.numbers, after)
    return Scatter(FrameScatter.of(after), scatter.frames + 1)


def frame(value: float) -> FrameScatter:
    sizes = len(LAGS), len(LENGTHS), len(BRIGHTNESS_LAGS)
    return FrameScatter(*(np.full(n, value) for n in sizes), *(np.array(value) for _ in range(3)))


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_neighbours_brightness_has_the_drawn_correlation(correlation: float) -> None:
    rng, n, contrast = np.random.default_rng(11), 4000, 0.2
    scatter = [rng.standard_normal()]
    for drawn in rng.standard_normal(n - 1):
        scatter.append(correlation * scatter[-1] + math.sqrt(1.0 - correlation**2) * drawn)
    amplitude = 1000.0 * (1.0 + contrast * np.array(scatter))
    seen = shown(np.zeros(n), np.ones(n), amplitude)
    learned = with_frame(NO_SCATTER, FrameScatter(*seen, *NOTHING))
    assert math.sqrt(brightness_plateau(learned.average.numbers)) == pytest.approx(contrast, rel=0.15)
    assert brightness_correlation(learned.average.numbers) == pytest.approx(correlation, abs=0.1)


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
        learned = with_frame(learned, FrameScatter(*of_frame, *NOTHING))
    nothing = np.zeros(1)
    together = widened(learned, nothing, width)[1] ** 2 - widened(learned, nothing, 0.0)[1] ** 2
    assert together[0] == pytest.approx(2.0 * np.mean(apart, axis=0).sum(), rel=0.3)


def test_the_first_frame_counts_whole_and_old_ones_fade() -> None:
    assert line_variance_px2(with_frame(NO_SCATTER, frame(0.25)).average.numbers) == 0.25
    scatter = NO_SCATTER
    for n in range(REMEMBERED):
        scatter = with_frame(scatter, frame(float(n)))
    # So many frames count alike.
    assert line_variance_px2(scatter.average.numbers) == pytest.approx((REMEMBERED - 1) / 2.0)
    steel = line_variance_px2(scatter.average.numbers)
    for _ in range(3 * REMEMBERED):
        scatter = with_frame(scatter, frame(0.0))
    assert line_variance_px2(scatter.average.numbers) == pytest.approx(
        steel * (1.0 - 1.0 / REMEMBERED) ** (3 * REMEMBERED)
    )


def test_a_frame_that_shows_nothing_changes_nothing() -> None:
    before = with_frame(NO_SCATTER, frame(0.04))
    after = with_frame(before, frame(math.nan))
    for one, other in zip(before.average, after.average, strict=True):
        np.testing.assert_array_equal(one, other)
    blank = with_frame(NO_SCATTER, frame(math.nan))
    sigma = np.array([0.1, 0.2, np.nan])
    for scatter in (NO_SCATTER, blank):
        assert (line_variance_px2(scatter.average.numbers), mean_variance_px2(scatter.average.numbers)) == (
            0.0,
            0.0,
        )
        assert (scatter.weighing_contrast, brightness_plateau(scatter.average.numbers)) == (0.0, 0.0)
        assert (scatter.width_factor, scatter.width_limit_ln) == (1.0, MIN_WIDTH_LIMIT_LN)
        for wider in widened(scatter, sigma, 3.0):
            np.testing.assert_allclose(wider, sigma)


@given(st.floats(-1.0, 1.0), st.floats(-0.1, 4.0))
def test_a_scatter_keeps_its_bounds(ln_width: float, variance: float) -> None:
    """Less than none is chance; a stripe that is far wider is another light."""
    seen = frame(variance)._replace(ln_width=np.array(ln_width))
    scatter = with_frame(NO_SCATTER, seen)
    assert line_variance_px2(scatter.average.numbers) == max(variance, 0.0)
    assert mean_variance_px2(scatter.average.numbers) >= line_variance_px2(scatter.average.numbers)
    assert MIN_WIDTH_LIMIT_LN <= scatter.width_limit_ln <= MAX_WIDTH_LIMIT_LN
    assert math.exp(-0.5) <= scatter.width_factor <= math.exp(0.5)


def test_a_misfit_of_all_lines_is_left_to_the_scatter() -> None:
    fits = np.column_stack([np.zeros(50), np.full(50, 0.3), np.ones(50), np.ones(50), np.full(50, 9.2)])
    expected = np.full(50, 4.0)
    excess = 9.2 - 0.25
    fits[:, 1] = 0.1 * math.sqrt(excess)
    np.testing.assert_allclose(own_of(fits, expected), 0.1)
    # A line that fits better is as sure as its photons let it be; a worse one keeps what it is worse by.
    fits[3, 1:] = 0.1, 1.0, 1.0, 1.0
    assert own_of(fits, expected)[3] == pytest.approx(0.1)
    fits[7, 1:] = 0.1 * math.sqrt(4.0 * excess), 1.0, 1.0, 4.0 * excess + 0.25
    assert own_of(fits, expected)[7] == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "grain_px"), [(0.0, 1.0), (0.1, 1.0), (0.2, 0.5), (0.2, 2.0)])
def test_centres_scatter_by_their_sigma_though_no_speckle_is_stated(contrast: float, grain_px: float) -> None:
    """Laser speckle is drawn that the tracker's setup does not state."""
    plain = rendered.small_setup("v_groove")
    setup = replace(plain, effects={"laser_speckle": {"contrast": contrast, "grain_px": grain_px}})
    pose, renderer = rendered.pose_at(0.0), Renderer()
    expected = expect_stripe(SensorGeometry.of(plain), make_scene(plain, pose.T_base_tool))
    assert expected is not None
    true = expected.position_px + expected.bias_px
    bend = np.abs(np.gradient(np.gradient(expected.position_px))) > 0.02
    face = np.convolve(bend, np.ones(41), "same") == 0.0
    own, together = [], []
    # Grains reach over many lines, so that few of them are independent: six runs tell more than one.
    for seed in range(5, 11):
        rng, tracker = np.random.default_rng(seed), Tracker(plain)
        for n in range(14):
            condition = Condition(1.0, 1.0, rendered.EXPOSURE_S)
            image = draw_frame(setup, pose.T_base_tool, condition, rng, renderer=renderer)
            drawn = Frame(n, 0.1 * n, image, rendered.EXPOSURE_S, rendered.CURRENT_A)
            stripe = tracker.step(drawn, pose).stripe
            assert stripe is not None
            if n >= 2:
                smooth = smoothed(stripe)
                own.append(((stripe.position_px - true) / stripe.sigma_px)[face])
                together.append(((smooth.position_px - true) / smooth.sigma_px)[face])
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
    np.testing.assert_equal(tracker.state.scatter, scatter[-1])

"""Two scan lines read as one: which they are, that it is their mean, and that its sigma is honest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import rendered
from hypothesis import given, settings
from hypothesis import strategies as st
from test_stripe import DARK, line_fits
from test_stripe_scatter import NOTHING, shown, with_frame

from noise_model.arc.scene import make_scene
from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.condition import Condition
from noise_model.forward import Renderer, draw_frame
from tracker.geometry import TRACK_REACH_MM
from tracker.state import Frame
from tracker.stripe.expected import expect_stripe
from tracker.stripe.line_fit.lines import LineFits
from tracker.stripe.neighbours import (
    AGREES_LINES,
    ALONE,
    CLEAR_SIGMAS,
    EVERY,
    MAX_STEP_WIDTHS,
    mark_pairs,
    tell_both,
)
from tracker.stripe.scatter import NO_SCATTER, FrameScatter, Scatter, centre_share, widen
from tracker.tracker import Tracker

seeds = st.integers(0, 2**32 - 1)
WIDTH_PX, REACH_PX = 3.0, 11.0
BOTH_ON = Condition(1.0, 1.0, rendered.EXPOSURE_S)


def marked(choice: Int64, face: Int64, expected: Float64) -> tuple[Int64, Bool]:
    """With how many lines each is read, and where the surface is smooth."""
    n = len(choice)
    n_lines, smooth = np.zeros(n, np.float64), np.zeros(n, np.bool_)
    mark_pairs(choice, face, expected, np.full(n, WIDTH_PX), REACH_PX, n_lines, smooth)
    return n_lines, smooth


def plainly_smooth(choice: Int64, face: Int64, expected: Float64) -> Bool:
    """Where two lines may be read as one, pair by pair from masks."""
    n, smooth = len(choice), np.zeros(len(choice), np.bool_)
    corners = np.flatnonzero(face[1:] != face[:-1]) + 0.5
    for s in range(0, n - 1, 2):
        near = choice[max(s - AGREES_LINES, 0) : s + 2 + AGREES_LINES]
        agrees = len(near) == 2 + 2 * AGREES_LINES and near.min() >= 0 and np.ptp(near) <= 1
        clear = math.ceil(REACH_PX + CLEAR_SIGMAS * WIDTH_PX)
        is_clear = all((np.abs(corners - line) > clear - 0.5).all() for line in (s, s + 1))
        is_level = abs(expected[s + 1] - expected[s]) <= MAX_STEP_WIDTHS * WIDTH_PX
        smooth[s : s + 2] = agrees and is_clear and is_level
    return smooth


@settings(deadline=None, max_examples=60)
@given(seeds, st.integers(60, 400))
def test_pairs_lie_clear_of_corners_where_the_path_agrees(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    choice, face = np.full(n, 7), np.searchsorted(np.sort(rng.integers(0, n, 2)), np.arange(n), "right")
    choice[rng.random(n) < 0.02], choice[rng.random(n) < 0.02] = -1, 9
    expected = 0.4 * np.arange(n) + np.where(rng.random(n) < 0.02, 3.0, 0.0)
    n_lines, smooth = marked(choice, face, expected)
    np.testing.assert_array_equal(smooth, plainly_smooth(choice, face, expected))
    np.testing.assert_array_equal(n_lines == 2, smooth & (np.arange(n) // 2 * 2 % EVERY >= ALONE))


def two_by_two(seed: int, amplitude: float, speckle: float) -> tuple[Float64, LineFits, LineFits]:
    """The true place of each of two lines that show the same; their fits one by one, and as pairs."""
    rng, n, level, depth = np.random.default_rng(seed), 2000, 1500.0, 40
    true_px = np.repeat(0.5 * depth + rng.uniform(-0.5, 0.5, n // 2), 2)
    bell = amplitude * np.exp(-0.5 * ((np.arange(depth) - true_px[:, None]) / WIDTH_PX) ** 2)
    light = level + bell * np.maximum(1.0 + speckle * rng.normal(size=bell.shape), 0.0)
    charge = rng.poisson(light) + rng.normal(0.0, math.sqrt(DARK), bell.shape)
    background, start, twos = np.full(charge.shape, level), np.rint(true_px), np.full(n, 2, np.float64)
    contrast = speckle / math.sqrt(2.0)
    each = line_fits(charge, background, start, WIDTH_PX, speckle=speckle, map_sigma=0.0)
    pair = line_fits(charge, background, start, WIDTH_PX, speckle=contrast, map_sigma=0.0, n_lines=twos)
    tell_both(np.zeros(n), twos, 0.5, pair)
    return true_px, each, pair


@pytest.mark.parametrize("speckle", [0.0, 0.3])
@pytest.mark.parametrize("amplitude", [800.0, 6000.0])
def test_a_pairs_fit_is_the_mean_of_its_lines(amplitude: float, speckle: float) -> None:
    true_px, each, pair = two_by_two(5, amplitude, speckle)
    mean, sigma = each.fits.reshape(-1, 2, 7).mean(axis=1), pair.fits[::2, 1] / math.sqrt(2.0)
    held = np.isfinite(mean[:, 0])
    assert held.mean() > 0.99
    apart = (pair.fits[::2, 0] - mean[:, 0])[held] / sigma[held]
    assert np.sqrt(np.mean(apart**2)) < 0.15
    # Its numbers are those that one line alone would have.
    for k in (1, 2, 3):
        assert np.median(pair.fits[::2, k][held]) == pytest.approx(np.median(mean[held, k]), rel=0.02)
    assert np.median(pair.fits[::2, 4][held]) == pytest.approx(np.median(mean[held, 4]), rel=0.1)
    np.testing.assert_array_equal(pair.fits[::2], pair.fits[1::2])
    np.testing.assert_array_equal(pair.odd[::2], pair.odd[1::2])
    if speckle > 0.0:
        assert np.nanmedian(pair.core) == pytest.approx(np.nanmedian(each.core), rel=0.1)
    # Over many draws it errs by as much as it says.
    z = (pair.fits[::2, 0] - true_px[::2])[held] / sigma[held]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.08)


def test_lines_lie_along_the_stripe_about_their_pairs_centre() -> None:
    lines = LineFits.empty(6)
    for values in lines:
        values[:] = 0
    lines.fits[:, 0], lines.fits[:, 1], lines.tried[:, 0] = 20.0, 0.1, 20.0
    tell_both(0.5 * np.arange(6), np.array([1.0, 1.0, 2.0, 2.0, 1.0, 1.0]), 0.5, lines)
    np.testing.assert_allclose(lines.fits[:, 0], [20.0, 20.0, 19.75, 20.25, 20.0, 20.0])
    np.testing.assert_allclose(lines.fits[:, 1] / 0.1, [1.0, 1.0, math.sqrt(2.0), math.sqrt(2.0), 1.0, 1.0])
    np.testing.assert_array_equal(lines.tried[:, 0], lines.fits[:, 0])


@pytest.mark.slow
@pytest.mark.parametrize("grain", [0.0, 0.5, 0.7, 1.0])
def test_scatter_is_learned_from_pairs_as_from_lines(grain: float) -> None:
    """Pairs, and the few lines alone among them, tell the lines' variance; a pair's sigma is honest."""
    rng, n, own, shared = np.random.default_rng(4), 960, 0.1, 0.2
    kernel = np.exp(-0.5 * (np.arange(-8.0, 9.0) / max(grain, 1e-3)) ** 2)
    kernel /= np.linalg.norm(kernel)
    n_lines = np.where(np.arange(n) % EVERY < ALONE, 1, 2)
    apart, mixed, errors = NO_SCATTER, NO_SCATTER, []
    for turn in range(80):
        off = own * rng.normal(size=n) + shared * np.convolve(rng.normal(size=n + 16), kernel, "valid")
        means = np.repeat(off.reshape(-1, 2).mean(axis=1), 2)
        sigma, ones = np.full(n, own), np.ones(n)
        apart = learn(apart, shown(off, sigma, ones))
        # The first frame is read line by line.
        read = n_lines if turn > 0 else np.ones(n, np.float64)
        mixed = learn(mixed, shown(np.where(read > 1, means, off), sigma, ones, read, mixed))
        if turn > 10:
            errors.append(means[n_lines > 1][::2])
    true_share = 0.5 * (1.0 + float(kernel[1:] @ kernel[:-1]))
    for scatter in (apart, mixed):
        assert centre_share(scatter.average.numbers) == pytest.approx(true_share, abs=0.08)
        by_lag, by_length = scatter.average.by_lag, scatter.average.by_length
        assert by_lag[-1] == pytest.approx(shared**2, rel=0.15)
        np.testing.assert_allclose(by_length, apart.average.by_length, rtol=1e-6, atol=1e-9)
    stated, beside = np.empty((2, n))
    widen(mixed.average.numbers, np.full(n, own), n_lines, 0.0, stated, beside)
    assert np.std(errors) == pytest.approx(stated[n_lines > 1][0], rel=0.05)


def learn(scatter: Scatter, seen: tuple[Float64, Float64, Float64]) -> Scatter:
    """The scatter with what one more frame shows."""
    return with_frame(scatter, FrameScatter(*seen, *NOTHING))


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["v_groove", "lap", "butt"])
def test_lines_near_the_joint_are_read_one_by_one(joint: str) -> None:
    """A first frame's too, once a search has found the joint."""
    setup, pose = rendered.small_setup(joint), rendered.pose_at(0.0)
    tracker, rng, renderer = Tracker(setup), np.random.default_rng(3), Renderer()
    shares, expected = [], expect_stripe(tracker.geometry, make_scene(setup, pose.T_base_tool))
    assert expected is not None
    corners = np.flatnonzero(expected.face[1:] != expected.face[:-1])
    assert len(corners) > 0
    near = np.abs(np.arange(len(expected.face)) - corners[:, None]).min(axis=0)
    for n in range(3):
        image = draw_frame(setup, pose.T_base_tool, BOTH_ON, rng, renderer=renderer)
        track = tracker.step(Frame(n, 0.1 * n, image, rendered.EXPOSURE_S, rendered.CURRENT_A), pose)
        assert track.valid
        n_lines = tracker._work.room.n_lines
        shares.append(np.mean(n_lines == 2))
        assert (n_lines[near < tracker.geometry.reach_px(TRACK_REACH_MM)] == 1).all()
    print(f"{joint}: {', '.join(f'{share:.0%}' for share in shares)} of the lines are read two by two")
    assert min(shares) > 0.15


@pytest.mark.slow
@pytest.mark.parametrize("contrast", [0.0, 0.3])
def test_what_is_said_of_a_joint_stays_honest(contrast: float) -> None:
    """A groove's scatter over its sigma, and the fit's chi2, where more than half of the lines are pairs."""
    plain, pose = rendered.small_setup("v_groove", width=640), rendered.pose_at(0.0)
    setup = replace(plain, effects={"laser_speckle": {"contrast": contrast, "grain_px": 1.0}})
    seams, sigmas, chi2 = [], [], []
    tracker, rng, renderer = Tracker(plain), np.random.default_rng(8), Renderer()
    for n in range(40):
        image = draw_frame(setup, pose.T_base_tool, BOTH_ON, rng, renderer=renderer)
        track = tracker.step(Frame(n, 0.1 * n, image, rendered.EXPOSURE_S, rendered.CURRENT_A), pose)
        assert tracker.reading is not None
        joint = tracker.reading.joint
        if joint is None or n < 4:
            continue
        assert np.mean(tracker._work.room.n_lines == 2) > 0.5
        seams.append(track.seam_tool_mm[1:])
        sigmas.append(np.sqrt(np.diag(joint.covariance_mm2)))
        chi2.append(joint.chi2)
    scatter = np.std(seams, axis=0) / np.median(sigmas, axis=0)
    print(f"contrast {contrast}: scatter over sigma {scatter.round(2)}, chi2 {np.median(chi2):.2f}")
    assert len(seams) == 36
    assert (scatter < 1.3).all()
    # Tukey's weights leave 0.83 of Gaussian residuals.
    assert 0.55 < np.median(chi2) < 0.95

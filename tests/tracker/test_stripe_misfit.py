"""What unexpected light does to centres: kernels against twins, sigmas against drawn backgrounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from profiles import PX_MM, fit_joint, groove, measure
from rendered import SEED
from test_correlated_points import CAMERA_MM, JOINTS, LASER_MM
from test_stripe import line_fits

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.median import numbers_for
from tracker.stripe.line_fit.block import CORRELATION_PX, WINDOW_SIGMAS
from tracker.stripe.line_fit.first_guess import line_window
from tracker.stripe.line_fit.residuals import LAST_BIN, N_BINS
from tracker.stripe.neighbours import (
    CHANCE,
    MIN_LINES,
    MOVED,
    mean_square_near,
    misfit_sigma_px,
    write_centres_as_one,
)

DEPTH, N_LINES, WIDTH_PX, AMPLITUDE_E, ARC_E = 64, 30, 5.0, 3000.0, 4000.0


def plain_odd_parts(
    charge: Float64, background: Float64, censored: Bool, fits: Float64, windows: list[tuple[int, int]]
) -> Float64:
    """The odd residuals, bin by bin from masks."""
    odd = np.full((len(charge), N_BINS), math.nan)
    edges = np.linspace(0.0, WINDOW_SIGMAS, N_BINS + 1)
    reach = edges[-2] + LAST_BIN * (edges[1] - edges[0])
    for s, (position, _, amplitude, width, _, b0, b1) in enumerate(fits):
        window = slice(*windows[s])
        away = np.arange(window.start, window.stop) - position
        t = away / WIDTH_PX
        if not (t[0] <= -reach and t[-1] >= reach):
            continue
        mean = background[s, window] + amplitude * np.exp(-0.5 * (away / width) ** 2) + b0 + b1 * away
        residual = charge[s, window] - mean
        for k in range(N_BINS):
            near = (np.abs(t) >= edges[k]) & (np.abs(t) < edges[k + 1]) & ~censored[s, window]
            ahead, behind = residual[near & (t > 0.0)], residual[near & (t < 0.0)]
            if len(ahead) and len(behind):
                odd[s, k] = 0.5 * (ahead.mean() - behind.mean())
    return odd


def near(odd: Float64, half: int, as_one: float) -> Float64:
    """The kernel's mean square."""
    mean_square = np.empty(len(odd))
    mean_square_near(odd, half, np.full(len(odd), as_one), mean_square)
    return mean_square


def plain_mean_square_near(odd: Float64, half: int, as_one: float) -> Float64:
    """The mean square beyond chance, line by line."""
    near = np.zeros(len(odd))
    for i in range(len(odd)):
        for column in odd[max(i - half, 0) : i + half + 1].T:
            known = column[np.isfinite(column)]
            if len(known) >= MIN_LINES:
                noise = known.var(ddof=1) / len(known) * as_one
                near[i] += (known.mean() ** 2 - CHANCE * noise) / N_BINS
    return np.maximum(near, 0.0)


def test_odd_residuals_are_their_twins() -> None:
    rng = np.random.default_rng(SEED)
    n = 90
    true_px, amplitude = rng.uniform(14.0, 50.0, n), rng.uniform(1000.0, 9000.0, n)
    bell = amplitude[:, None] * np.exp(-0.5 * ((np.arange(DEPTH) - true_px[:, None]) / WIDTH_PX) ** 2)
    background = np.full((n, DEPTH), ARC_E)
    charge = (bell + background + rng.normal(0.0, 100.0, bell.shape)).astype(np.float32)
    censored, start = rng.random(charge.shape) < 0.05, np.rint(true_px)
    found = line_fits(charge, background, start, WIDTH_PX, censored=censored)
    windows = [line_window(float(place), WIDTH_PX, DEPTH) for place in start]
    expected = plain_odd_parts(charge.astype(float), background, censored, found.fits, windows)
    np.testing.assert_allclose(found.odd, expected, rtol=1e-3, atol=0.05)
    assert 0.5 < np.isfinite(found.odd).mean() < 0.95
    for half, as_one in ((3, 1.0), (15, 2.5)):
        np.testing.assert_allclose(
            near(found.odd, half, as_one),
            plain_mean_square_near(found.odd, half, as_one),
            rtol=1e-6,
            atol=1e-3,
        )


def test_how_many_lines_scatter_as_one_is_the_usual_number_of_their_kind() -> None:
    rng, n = np.random.default_rng(SEED), 61
    n_lines, sigma, effective = rng.integers(1, 3, n), rng.uniform(0.1, 0.3, n), rng.uniform(0.3, 0.6, n)
    sigma[rng.random(n) < 0.2] = np.nan
    as_one = np.empty(n)
    write_centres_as_one(sigma, effective, n_lines, np.empty(numbers_for(n), np.float32), as_one)
    for together in (1, 2):
        kind = n_lines == together
        usual = np.nanmedian((effective[kind] / sigma[kind]) ** 2 / together)
        np.testing.assert_allclose(as_one[kind], usual, rtol=1e-6)


def field(covariance: str, length_px: float, rng: np.random.Generator) -> Float64:
    """Draw a background's error over a scan line, of 1 sigma 1."""
    place = np.arange(DEPTH)
    a = np.abs(place[:, None] - place) / length_px
    rooted = math.sqrt(3.0) * a
    K = {"smooth": np.exp(-0.5 * a**2), "matern": (1.0 + rooted) * np.exp(-rooted), "rough": np.exp(-a)}
    values, vectors = np.linalg.eigh(K[covariance])
    return np.asarray(vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=DEPTH)))


def stretch(error_e: Float64, rng: np.random.Generator) -> tuple[float, float]:
    """Return by how much the centres of one stretch of lines are off together, and its stated 1 sigma, px."""
    at = DEPTH / 2 + rng.uniform(-0.5, 0.5)
    bell = AMPLITUDE_E * np.exp(-0.5 * ((np.arange(DEPTH) - at) / WIDTH_PX) ** 2)
    background = np.full((N_LINES, DEPTH), ARC_E)
    charge = rng.poisson(bell + ARC_E + error_e, background.shape) + rng.normal(0.0, 45.0, background.shape)
    found, sigma_px = line_fits(charge, background, np.full(N_LINES, at), WIDTH_PX), np.empty(N_LINES)
    misfit_sigma_px(found.odd, found.fits, np.ones(N_LINES), sigma_px)
    return float(np.mean(found.fits[:, 0]) - at), float(np.median(sigma_px))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("covariance", "length_px"), [("smooth", 10.0), ("matern", 10.0), ("matern", 30.0), ("rough", 30.0)]
)
def test_the_sigma_holds_for_backgrounds_of_any_smoothness(covariance: str, length_px: float) -> None:
    """Centres are off by the stated sigma, where errors of the background are well beyond noise."""
    rng = np.random.default_rng(SEED)
    drawn = [stretch(0.15 * ARC_E * field(covariance, length_px, rng), rng) for _ in range(60)]
    off, sigma = np.array(drawn).T
    assert (sigma > 0.0).mean() > 0.8
    ratio = float(np.sqrt(np.mean(off**2) / np.mean(sigma**2)))
    print(f"{covariance} {length_px} px: centres {np.sqrt(np.mean(off**2)):.3f} px, over sigma {ratio:.2f}")
    assert 0.6 < ratio < 1.4


def test_a_background_as_expected_adds_nothing() -> None:
    rng = np.random.default_rng(SEED)
    assert np.mean([stretch(np.zeros(DEPTH), rng)[1] > 0.0 for _ in range(60)]) < 0.1


def test_a_profile_that_is_no_bell_but_even_adds_little() -> None:
    """A flat-topped stripe's centre is where it was."""
    rng = np.random.default_rng(SEED)
    place = np.arange(DEPTH) - DEPTH / 2
    even = 600.0 * np.exp(-((place / 6.0) ** 4)) - 500.0 * np.exp(-((place / 4.0) ** 2))
    off, sigma = np.array([stretch(even, rng) for _ in range(20)]).T
    assert np.sqrt(np.mean(sigma**2)) < 0.1 * WIDTH_PX * MOVED * 200.0 / AMPLITUDE_E
    assert np.abs(off).max() < 0.15


@pytest.mark.slow
def test_a_joint_whose_centres_are_off_together_says_so() -> None:
    """The covariance with shared errors is honest against drawn ones, a running sum against dense algebra."""
    rng = np.random.default_rng(SEED)
    exact = measure(groove((30.0, 30.0), (4.0, 4.0), 1.0), (0.0, 0.0), rng, noise=False)
    apart = np.abs(exact.scan[:, None] - exact.scan)
    misfit_px = np.where(np.abs(exact.y_mm) < 3.0, 0.5, 0.1)
    values, vectors = np.linalg.eigh(np.exp(-apart / CORRELATION_PX))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    own = np.full(len(misfit_px), 0.15)
    squares, alone = [], []
    for _ in range(100):
        off = 0.15 * rng.normal(size=len(own)) + misfit_px * (root @ rng.normal(size=len(own)))
        y, z = exact.y_mm + PX_MM[0] * off, exact.z_mm + PX_MM[1] * off
        order = np.argsort(y, kind="stable")
        profile = replace(
            exact, y_mm=y[order], z_mm=z[order], sigma_px=own, beside_px=own, misfit_px=misfit_px[order],
            scan=exact.scan[order],
        )  # fmt: skip
        for told, into in ((profile, squares), (replace(profile, misfit_px=0.0), alone)):
            joint = fit_joint(told, JOINTS["v_groove"][0], CAMERA_MM, LASER_MM)
            assert joint is not None
            into.append(np.array([joint.y_mm, joint.z_mm]) ** 2 / np.diag(joint.covariance_mm2))
    honest, before = np.mean(squares, axis=0), np.mean(alone, axis=0)
    print(f"chi2 {honest}, without {before}")
    assert (np.abs(honest - 1.0) < 4.0 * math.sqrt(2.0 / 100.0)).all()
    assert (before > 2.0).any()

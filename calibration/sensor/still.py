"""Gain, read noise and black level from frames of a stripe that stands still.

A stripe has all brightnesses at once. With u = (mean - black) / swing, swing the codes from black to the top,
the variance in time is

    v = gamma^2 swing u^(2 - 1/gamma) / gain + gamma^2 u^(2 - 2/gamma) read_noise^2 / gain^2 + 1/12
        + j^2 |slope|^2 + r^2 (mean - black)^2,

for gamma 1 the line of the photon transfer. j is the shake of parts of the stripe, px, r the flicker of
single pixels' light, as of boiling speckle. Both are fitted too, so as not to pass for shot noise. Gamma and
full well are taken as stated: one exposure cannot determine them. Black is the level of the darkest pixels.
If ambient light falls there too, black lies lower and the read noise is smaller.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from calibration.sensor.code_moments import code_moments
from calibration.sensor.flat_fields import MIN_DARK_SIGMA_DN, IntervalEstimate
from calibration.sensor.speckle_pattern import SpecklePattern, fit_speckle_pattern
from calibration.sensor.still_frames import StillStatistics, still_statistics
from noise_model.compiled.arrays import Bool, Float64, Integers
from noise_model.fit import student_t
from noise_model.instrument.sensor import Sensor, saturation_dn

MAX_UNLIKE, CHANCE = 2.0, 0.5
"""The largest relative error of bins, and by how much chi2 per freedom may exceed 1 by chance."""

ROUNDS = 8
"""Rounds of the weights, which are those of the fitted variance."""

KEYS = ("gain_e_per_dn", "black_level_dn", "read_noise_e")
"""The keys of [sensor] that are found."""


@dataclass(frozen=True, eq=False)
class StillCalibration:
    """Sensor and speckle as calibrated from still frames.

    `covariance` (3, 3) is that of `KEYS`. `fitted_dn2` (b,) are the bins' variances as fitted, `shake_px` and
    `flicker_rel` the 1 sigma of shaking and boiling. `unlike_rel` is the bins' error beyond chance,
    `is_read_noise_hidden` whether rounding hides the read noise. `speckle` is None where the stripe shows too
    little of it.
    """

    estimates: dict[str, IntervalEstimate]
    covariance: Float64
    sensor: Sensor
    statistics: StillStatistics
    fitted_dn2: Float64
    shake_px: float
    flicker_rel: float
    unlike_rel: float
    is_read_noise_hidden: bool
    speckle: SpecklePattern | None

    def __getitem__(self, name: str) -> IntervalEstimate:
        return self.estimates[name]


def calibrate_still(frames_dn: Sequence[Integers], stated: Sensor) -> StillCalibration:
    """Find gain, read noise, black level and speckle of still frames; ValueError says what is missing."""
    # Frames that go beyond the stated saturation prove it wrong.
    brightest = max((int(frame.max()) for frame in frames_dn), default=0)
    top = float(saturation_dn(stated) if brightest <= saturation_dn(stated) else stated.max_dn)
    seen = still_statistics(frames_dn, top)
    shapes = _shapes(seen, stated.gamma, top)
    x, C, fitted, unlike = _weighted_fit(shapes, seen, _counts(seen, stated, top))
    inverse_gain, sigma = float(x[0]), math.sqrt(C[0, 0])
    if inverse_gain < 4.0 * sigma:
        raise ValueError(
            "the stripe's shot noise does not show: too few pixels are bright and below saturation; record "
            "a wider or a longer stripe, at an exposure that leaves its peak below saturation"
        )
    gain = 1.0 / inverse_gain
    black, dark = seen.black_dn, seen.dark_variance_dn2 - 1.0 / 12.0
    read, slopes = _read_noise(seen, gain, top, stated)
    dark_sigma = math.hypot(seen.dark_sigma_dn2, _rounding_dn2(dark), unlike * seen.dark_variance_dn2)
    is_hidden = math.sqrt(seen.dark_variance_dn2) < MIN_DARK_SIGMA_DN
    if is_hidden:
        # Rounding hides read noise from 0 to this (EMVA Standard 1288, section 6).
        hidden_dn = 0.4
        read, slopes, dark_sigma = 0.5 * hidden_dn * gain, [0.5 * hidden_dn, 0.0, gain], 0.0
    # Gain, black and the dark variance are hardly correlated: black and gain tie in the curve's foot alone.
    gain_sigma = gain**2 * sigma
    J = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], slopes])
    own = np.diag([gain_sigma**2, seen.black_sigma_dn**2, dark_sigma**2])
    covariance = J @ own @ J.T
    if is_hidden:
        covariance[2, 2] += (hidden_dn * gain) ** 2 / 12.0
    half = student_t(0.95, math.inf)
    estimates = {
        name: IntervalEstimate(value, s, value - half * s, value + half * s, unit)
        for name, value, s, unit in zip(
            KEYS,
            (gain, black, read),
            np.sqrt(np.diag(covariance)).tolist(),
            ("e-/DN", "DN", "e-"),
            strict=True,
        )
    }
    sensor = Sensor(stated.bits, gain, black, read, gain * (top - black), stated.gamma)
    return StillCalibration(
        estimates=estimates,
        covariance=covariance,
        sensor=sensor,
        statistics=seen,
        fitted_dn2=fitted,
        shake_px=math.sqrt(max(float(x[-2]), 0.0)),
        flicker_rel=math.sqrt(max(float(x[-1]), 0.0)),
        unlike_rel=unlike,
        is_read_noise_hidden=is_hidden,
        speckle=fit_speckle_pattern(seen),
    )


def _rounding_dn2(noise_dn2: float) -> float:
    """Return 1 sigma, DN^2, of what rounding does to a variance beyond its twelfth: the first harmonic's.

    Its phase is where the mean lies between two codes, which differs from pixel to pixel (Sheppard's series).
    """
    s2 = max(noise_dn2, 0.01)
    return math.exp(-2.0 * math.pi**2 * s2) * (4.0 * s2 + 1.0 / math.pi**2) / math.sqrt(2.0)


def _shapes(seen: StillStatistics, gamma: float, top_dn: float) -> Float64:
    """Return each part of the variance over the bins (k, b): shot and read noise, shake, flicker."""
    swing = top_dn - seen.black_dn
    light = seen.mean_dn - seen.black_dn
    if gamma == 1.0:
        return np.stack([light, np.ones_like(light), seen.gradient_dn2, light**2])
    u = np.maximum(light, 1.0) / swing
    shot, read = gamma**2 * swing * u ** (2.0 - 1.0 / gamma), gamma**2 * u ** (2.0 - 2.0 / gamma)
    return np.stack([shot, read, seen.gradient_dn2, light**2])


def _counts(seen: StillStatistics, stated: Sensor, top_dn: float) -> Bool:
    """Return the mask (b,) of bins that count: a response with gamma bends within the noise of faint ones."""
    # Below half a code rounding is no twelfth.
    counts = seen.variance_dn2 > 0.25
    if stated.gamma != 1.0:
        u = np.maximum(seen.mean_dn - seen.black_dn, 0.0) / (top_dn - seen.black_dn)
        # A response with gamma bends near black.
        counts &= stated.full_well_e * u ** (1.0 / stated.gamma) > 6.0 * stated.read_noise_e
    return np.asarray(counts)


def _weighted_fit(
    shapes: Float64, seen: StillStatistics, counts: Bool
) -> tuple[Float64, Float64, Float64, float]:
    """Return coefficients (k,), their covariance (k, k), fitted variances (b,), DN^2, and excess scatter.

    A variance's own variance is 2 v^2 / (freedom pixels), v as fitted. Where bins scatter more than that, all
    of them have an additional relative error (DerSimonian and Laird 1986): bins of 10^5 pixels would decide
    alone.
    """
    if counts.sum() <= len(shapes) + 1:
        raise ValueError(
            "too few pixels see the stripe below saturation: record a wider or a longer stripe, at a "
            "shorter exposure"
        )
    variance = seen.variance_dn2 - 1.0 / 12.0
    fitted, unlike = np.maximum(seen.variance_dn2, 0.1), 0.0
    for _ in range(ROUNDS):
        noise = fitted * np.sqrt(2.0 / (seen.freedom * seen.n_pixels))
        x, C, chi2 = _least_squares(shapes, variance, np.hypot(noise, unlike * fitted), counts)
        fitted = np.maximum(x @ shapes + 1.0 / 12.0, 0.1)
        unlike = _unlike(shapes, variance, noise, fitted, counts)
    return x, C * max(chi2, 1.0), fitted, unlike


def _least_squares(
    shapes: Float64, variance: Float64, sigma: Float64, counts: Bool
) -> tuple[Float64, Float64, float]:
    A = (shapes / sigma)[:, counts].T
    scale = 1.0 / np.sqrt(np.sum(A**2, axis=0))
    C = scale[:, np.newaxis] * np.linalg.pinv((A * scale).T @ (A * scale)) * scale
    x = C @ A.T @ (variance / sigma)[counts]
    freedom = max(int(counts.sum()) - len(x), 1)
    return x, C, float(np.sum(((variance - x @ shapes) / sigma)[counts] ** 2) / freedom)


def _unlike(shapes: Float64, variance: Float64, noise: Float64, fitted: Float64, counts: Bool) -> float:
    """Return the model's relative error in bins, with which chi2 per degree of freedom is 1."""

    def excess(unlike: float) -> float:
        return _least_squares(shapes, variance, np.hypot(noise, unlike * fitted), counts)[2] - 1.0

    if excess(0.0) <= CHANCE or excess(MAX_UNLIKE) >= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, MAX_UNLIKE, xtol=1e-5))


def _read_noise(
    seen: StillStatistics, gain: float, top_dn: float, stated: Sensor
) -> tuple[float, list[float]]:
    """Return the read noise, e-, of dark pixels, and its derivatives by gain, black and variance."""

    def read_at(gain: float, black: float, variance: float) -> float:
        dark = max(variance - 1.0 / 12.0, 1e-6)
        if stated.gamma == 1.0:
            return gain * math.sqrt(dark)
        full = gain * (top_dn - black)

        def excess(ln_read: float) -> float:
            sensor = Sensor(stated.bits, gain, black, math.exp(ln_read), full, stated.gamma)
            zero = np.zeros(1)
            return float(code_moments(zero, zero, sensor, np.array([True])).variance_dn2[0]) - variance

        return math.exp(brentq(excess, math.log(1e-6 * full), math.log(full)))

    here = (gain, seen.black_dn, seen.dark_variance_dn2)
    slopes = []
    for n, value in enumerate(here):
        step = 1e-4 * max(abs(value), 1e-3)
        low, high = (read_at(*(v + sign * step * (k == n) for k, v in enumerate(here))) for sign in (-1, 1))
        slopes.append((high - low) / (2.0 * step))
    return read_at(*here), slopes

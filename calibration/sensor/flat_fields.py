"""A sensor's calibration from flat and dark frames at several exposures: checks, fit, and what it says.

What the frames cannot determine is refused, with the frames that are missing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from calibration.sensor.levels import Level, LevelStatistics, check_steady, statistics
from calibration.sensor.photon_transfer import (
    NAMES,
    PhotonTransferFit,
    PhotonTransferProblem,
    fit_photon_transfer,
)
from calibration.sensor.response_model import Pattern, predict
from noise_model.compiled.arrays import Float64
from noise_model.fit import student_t

MIN_LEVELS = 5
"""Least number of lit levels below saturation that separate gain, gamma and linearity."""

MIN_SPAN = 4.0
"""Least ratio of the exposures of the brightest and the darkest of them."""

MAX_SATURATED_SHARE = 1e-3
"""A level of which a larger share is at the top code is left out."""

MIN_DARK_SIGMA_DN = 0.24
"""Dark noise below this is hidden by rounding (EMVA Standard 1288, section 6)."""

MISFIT_P = 1e-3
"""A fit less likely than this has sigmas scaled by the root of its chi2 per freedom (Birge 1932)."""

KEYS = ("gain_e_per_dn", "black_level_dn", "read_noise_e", "full_well_e", "gamma")
"""The keys of [sensor] that are found."""


@dataclass(frozen=True)
class IntervalEstimate:
    """A value, its 1 sigma, its 95 % interval, and its unit."""

    value: float
    sigma: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """Sensor as calibrated from flat and dark frames.

    `estimates` by name; `covariance` is that of `KEYS`. `left_out` are levels that are saturated;
    `well_is_seen` says whether one of them shows the full well, below the last code or at it. `chi2` is that
    of the fit per degree of freedom.
    """

    estimates: dict[str, IntervalEstimate]
    covariance: Float64
    fit: PhotonTransferFit
    levels: LevelStatistics
    left_out: tuple[str, ...]
    top_dn: float
    well_is_seen: bool

    def __getitem__(self, name: str) -> IntervalEstimate:
        return self.estimates[name]

    @property
    def chi2(self) -> float:
        """The fit's chi2 per degree of freedom."""
        return self.fit.chi2

    @property
    def chi2_is_likely(self) -> bool:
        """True if the model explains the frames; otherwise the sigmas are scaled."""
        return self.fit.p_value >= MISFIT_P

    def curve(self, charge_e: Float64) -> tuple[Float64, Float64]:
        """Return mean, DN, and variance, DN^2, (n,) of mean charges (n,) under the fitted sensor."""
        pattern = Pattern(0.0, 0.0, self.levels.shading_rel)
        predicted = predict(charge_e, np.full(len(charge_e), 2.0), pattern, self.fit.sensor)
        return predicted.mean_dn, predicted.variance_dn2


def calibrate_sensor(levels: Sequence[Level], bits: int, gamma: float | None = None) -> SensorCalibration:
    """Find a sensor's gain, noise and response from levels of even light; ValueError says what is missing.

    `gamma` is held where it is given.
    """
    dark = [level for level in levels if not level.is_lit]
    lit = sorted((level for level in levels if level.is_lit), key=lambda level: level.exposure_s)
    if not dark:
        raise ValueError(
            "there are no dark frames: cover the lens and take two or more at the shortest exposure"
        )
    black = float(np.mean([level.mean_dn.mean() for level in dark]))
    for level in (*dark, *lit):
        check_steady(level, black)
    top, n_full, well_is_seen = _top(lit, bits)
    usable = [level for level in lit[:n_full] if level.share_from(top - 0.5) <= MAX_SATURATED_SHARE]
    _check_levels(dark, lit, usable, black)
    kept = statistics([*dark, *usable])
    if kept.shading_rel > 0.2:
        raise ValueError(
            f"the light changes by {100.0 * kept.shading_rel:.0f} % over the image (1 sigma): put a "
            "diffuser before the lens, or take the lens off"
        )
    fit = fit_photon_transfer(PhotonTransferProblem(kept, bits, top, gamma))
    if not fit.is_settled:
        raise ValueError("no sensor explains the frames' noise: are the exposures those of the files?")
    left_out = tuple(level.name for level in lit if level not in usable)
    top_sigma = math.sqrt(1.0 / 12.0) if well_is_seen and top < 2**bits - 1 else 0.0
    estimates, covariance = _estimates(fit, kept, top, top_sigma)
    return SensorCalibration(estimates, covariance, fit, kept, left_out, top, well_is_seen)


def _top(lit: Sequence[Level], bits: int) -> tuple[float, int, bool]:
    """Return the code of saturation, how many levels lie before full wells, and whether one shows it."""
    last = float(2**bits - 1)
    noise = np.array([float(level.variance_dn2.mean()) for level in lit])
    for n in range(1, len(lit)):
        # The noise falls where wells are full.
        fell = noise[n] < 0.3 * noise[:n].max()
        if fell and lit[n].share_from(last) < 0.5:
            return float(np.median(lit[-1].mean_dn)), n, True
    return last, len(lit), any(level.share_from(last) > 0.5 for level in lit)


def _check_levels(dark: Sequence[Level], lit: Sequence[Level], usable: Sequence[Level], black: float) -> None:
    """Raise ValueError for levels that cannot determine a sensor."""
    saturated = [level for level in lit if level not in usable]
    if len(usable) < MIN_LEVELS:
        shorter = ""
        if saturated:
            shortest = 1e3 * min(level.exposure_s for level in saturated)
            shorter = f"; {len(saturated)} are saturated, from {shortest:g} ms on: take shorter ones"
        raise ValueError(
            f"{len(usable)} exposures of flat frames lie below saturation, {MIN_LEVELS} are needed, best "
            f"ten from a twentieth of saturation to nine tenths{shorter}"
        )
    span = usable[-1].exposure_s / usable[0].exposure_s
    if span < MIN_SPAN:
        raise ValueError(
            f"the longest exposure below saturation is {span:.1f} times the shortest, {MIN_SPAN:g} are "
            f"needed: take flat frames down to {1e3 * usable[-1].exposure_s / 20.0:.3g} ms"
        )
    means = [float(level.mean_dn.mean()) for level in usable]
    for n in range(1, len(usable)):
        if means[n] <= means[n - 1]:
            raise ValueError(
                f"{usable[n].name} are no brighter than those of {1e3 * usable[n - 1].exposure_s:g} ms: the "
                "light or the exposure was not as stated"
            )
    if max(float(level.mean_dn.mean()) for level in dark) >= means[0]:
        raise ValueError("the dark frames are as bright as the darkest flat frames: cover the lens for them")
    dark_sigma = math.sqrt(float(np.mean([level.variance_dn2.mean() for level in dark])))
    if dark_sigma < MIN_DARK_SIGMA_DN:
        raise ValueError(
            f"the dark frames' noise is {dark_sigma:.2f} DN, less than {MIN_DARK_SIGMA_DN}: rounding hides "
            "it; record with more bits, or with a higher gain"
        )


def _estimates(
    fit: PhotonTransferFit, levels: LevelStatistics, top_dn: float, top_sigma_dn: float
) -> tuple[dict[str, IntervalEstimate], Float64]:
    """Return the estimates and the covariance of `KEYS`."""
    x, sensor = fit.values, fit.sensor
    scale = fit.chi2 if fit.p_value < MISFIT_P else 1.0
    covariance = fit.covariance[: len(NAMES), : len(NAMES)] * scale
    gain, read = sensor.gain_e_per_dn, max(sensor.read_noise_e, 1e-3)
    J = np.zeros((5, len(NAMES)))
    J[0, 1] = gain
    J[1, 0] = 1.0
    J[2, 3] = 0.5 / read
    J[3, 0], J[3, 1] = -gain, sensor.full_well_e
    J[4, 2] = 1.0
    keys = J @ covariance @ J.T
    # The top code is known to a rounding: it moves gain and full well together where gamma ties them.
    share = np.array([(1.0 / x[2] - 1.0) * gain / (top_dn - x[0]), 0.0, 0.0, gain / x[2], 0.0])
    keys += np.outer(share, share) * top_sigma_dn**2
    values = (gain, float(x[0]), sensor.read_noise_e, sensor.full_well_e, float(x[2]))
    units = ("e-/DN", "DN", "e-", "e-", "")
    freedoms = fit.freedoms[[1, 0, 3, 1, 2]]
    estimates = {}
    for name, value, variance, unit, freedom in zip(
        KEYS, values, np.diag(keys), units, freedoms.tolist(), strict=True
    ):
        half = student_t(0.95, freedom)
        sigma = math.sqrt(max(float(variance), 0.0))
        estimates[name] = IntervalEstimate(value, sigma, value - half * sigma, value + half * sigma, unit)
    for name, n, unit in (("dsnu_e", 4, "e-"), ("prnu_rel", 5, "")):
        estimates[name] = _root(float(x[n]), math.sqrt(float(covariance[n, n])), unit)
    tau, freedom = fit.linearity_rel, fit.linearity_freedom
    low, high = (tau * math.sqrt(freedom / chi2_distribution.ppf(p, freedom)) for p in (0.975, 0.025))
    estimates["linearity_rel"] = IntervalEstimate(tau, tau / math.sqrt(2.0 * freedom), low, high, "")
    return estimates, keys


def _root(variance: float, sigma: float, unit: str) -> IntervalEstimate:
    """Return a standard deviation of a variance and its sigma; one that is not seen is 0."""
    half = student_t(0.95, math.inf)
    low, high = (math.sqrt(max(variance + sign * half * sigma, 0.0)) for sign in (-1.0, 1.0))
    root = math.sqrt(max(variance, 0.0))
    return IntervalEstimate(root, min(0.5 * sigma / max(root, 1e-12), math.sqrt(sigma)), low, high, unit)

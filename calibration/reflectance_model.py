"""The grey levels that a reflectance predicts for goniometer settings, and their weighted fit.

    G_j = black + (saturation - black) [(A_diff + A_spec lobe_j(c2)) cos(theta_i) I / a^2]^gamma,
    lobe(c2) = G(theta_i, theta_r, phi_r) / cos(theta_r) exp(-c2 alpha^2)             (Eq. 5, 7, 17, 20)

A_diff = s kappa_diff and A_spec = s kappa_spec, s the factor of `goniometer`. A white standard of an albedo
has s albedo / pi instead of the bracket's first factor. Grey levels are compared as they were read, for there
read noise and rounding are additive; gamma is undone for the first guess and for pictures.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from calibration.goniometer import NORMAL, GreyResponse, Readings
from calibration.reading_noise import ReadingNoise, estimate_noise, estimate_scatter, rounding_left
from noise_model.compiled.arrays import Bool, Float64
from noise_model.fit import Fit, Parameter, fit
from noise_model.surface.brdf import reflectance

NAMES = ("kappa_diff", "kappa_spec", "c2")
"""Names of the results."""

A_DIFF, A_SPEC, C2, SCALE = "s kappa_diff", "s kappa_spec", "c2", "s"
"""Names of the fitted parameters."""

C2_LOWEST, C2_HIGHEST = 0.01, 1e5
"""c2 is sought between these: the lobe's 1/e half angle alpha = 1/c is 570 and 0.18 deg there."""

FAINTEST = 20.0
"""The setting nearest the mirror direction must see e^-20 of the lobe's peak: c2 alpha^2 up to this."""

ROUNDS = 3
"""Number of alternations of noise and fit; the weights hardly change after the second."""


@dataclass(frozen=True, eq=False)
class White:
    """Readings of a diffuse white standard of an albedo, taken under the sample's source and camera."""

    readings: Readings
    albedo: float

    def __post_init__(self) -> None:
        if not 0 < self.albedo <= 1:
            raise ValueError(f"albedo = {self.albedo}: a white standard's lies in (0, 1]")


@dataclass(frozen=True, eq=False)
class ReadingsModel:
    """Sample and white standard stacked, (m,): E = A_diff diffuse + A_spec lobe e^(-c2 alpha2) + s white.

    `gray_level`, `repeats`, `variance` as in `Readings`; `white` is None without a standard. `is_whole` (m,)
    says of which settings all readings are whole numbers.
    """

    diffuse: Float64
    lobe: Float64
    alpha2: Float64
    white: Float64 | None
    gray_level: Float64
    repeats: Float64
    variance: Float64
    is_whole: Bool
    response: GreyResponse

    def level(self, p: Float64) -> Float64:
        """Return the mean grey levels (m,), DN, for A_diff, A_spec, c2 and, with a white standard, s."""
        light = p[0] * self.diffuse + p[1] * self.lobe * np.exp(-p[2] * self.alpha2)
        return self.response.gray_level(light if self.white is None else light + p[3] * self.white)

    @property
    def c2_highest(self) -> float:
        """The largest c2 that is sought: a lobe that no setting sees could be of any height."""
        nearest = float(np.min(self.alpha2[self.lobe > 0]))
        return min(C2_HIGHEST, FAINTEST / max(nearest, FAINTEST / C2_HIGHEST))

    def start(self) -> Float64:
        """Return the best of a range of c2 with non-negative least squares for the rest, gamma undone."""
        light = self.response.light(self.gray_level)
        best, best_rest = np.zeros(0), math.inf
        for c2 in np.geomspace(10.0 * C2_LOWEST, 0.1 * self.c2_highest, 36):
            columns = [self.diffuse, self.lobe * np.exp(-c2 * self.alpha2)]
            if self.white is not None:
                columns.append(self.white)
            parts, rest = nnls(np.column_stack(columns), light)
            if rest < best_rest:
                best, best_rest = np.insert(parts, 2, c2), rest
        return best

    def parameters(self, start: Float64) -> list[Parameter]:
        """Return the fitted parameters: light per cos(theta_i) I / a^2, >= 0, and c2 within its range."""
        irradiance = self.diffuse if self.white is None else self.diffuse + self.white
        step = 1e-5 * float(np.max(self.response.light(self.gray_level)) / np.max(irradiance))
        return [
            Parameter(C2, "", value, lower=C2_LOWEST, upper=self.c2_highest, step=1e-4 * value)
            if name == C2
            else Parameter(name, "", value, lower=0.0, step=step)
            for name, value in zip((A_DIFF, A_SPEC, C2, SCALE), start.tolist(), strict=False)
        ]


def readings_model(sample: Readings, response: GreyResponse, white: White | None) -> ReadingsModel:
    """Return the model of a sample's readings and those of a white standard, if there are any."""
    settings = sample.settings
    diffuse = settings.irradiance
    lobe = reflectance(settings.omega_i, settings.omega_r, NORMAL, 0.0, 1.0, 0.0) * diffuse
    alpha2 = settings.alpha**2
    is_whole = np.full(len(settings), sample.is_whole)
    if white is None:
        means = sample.gray_level, *_informative(sample.repeats, sample.variance), is_whole
        return ReadingsModel(diffuse, lobe, alpha2, None, *means, response)
    standard = white.readings
    repeats, variance = _informative(
        np.append(sample.repeats, standard.repeats), np.append(sample.variance, standard.variance)
    )
    dark, other = np.zeros(len(standard.settings)), np.zeros(len(settings))
    return ReadingsModel(
        diffuse=np.append(diffuse, dark),
        lobe=np.append(lobe, dark),
        alpha2=np.append(alpha2, dark),
        white=np.append(other, standard.settings.irradiance * white.albedo / math.pi),
        gray_level=np.append(sample.gray_level, standard.gray_level),
        repeats=repeats,
        variance=variance,
        is_whole=np.append(is_whole, np.full(len(standard.settings), standard.is_whole)),
        response=response,
    )


def _informative(repeats: Float64, variance: Float64) -> tuple[Float64, Float64]:
    """Return repeats and variances (m,) as they are, or as of single readings if no two of them differ.

    Then they are copies, or a mean that was written down again: they contain no noise.
    """
    if np.nansum(variance) > 0.0:
        return repeats, variance
    return np.ones_like(repeats), np.full_like(variance, np.nan)


@dataclass(frozen=True, eq=False)
class ReadingsFit:
    """A fit, the noise of a reading behind its weights, and the standard error (m,) of each mean, DN.

    `between` is what settings differ by beyond that noise, relative to their signals.
    """

    fit: Fit
    noise: ReadingNoise
    sigma: Float64
    between: float = 0.0


def fit_readings(model: ReadingsModel) -> ReadingsFit:
    """Fit A_diff, A_spec, c2 and s with weights by the noise of the readings.

    Repeats and residuals both determine the noise, each with its degrees of freedom (a residual has 1 -
    leverage), so readings without repeats need no other treatment. Signals are the model's, not the readings:
    a weight that follows its own reading's error biases the fit downwards.
    """
    start = model.start()
    signal = model.gray_level - model.response.black_dn
    fitted = _fit(model, start, signal, _noise_of_repeats(model, signal), 0.0)
    for _ in range(ROUNDS - 1):
        signal = model.level(fitted.fit.values) - model.response.black_dn
        noise, _ = _noise_of_all(model, signal, fitted, np.zeros_like(signal))
        fitted = _fit(model, fitted.fit.values, signal, noise, 0.0)
    return fitted


def fit_settings(model: ReadingsModel, fitted: ReadingsFit) -> ReadingsFit:
    """Fit once more, with weights that include the scatter between settings.

    A mean's variance is that of a reading over the repeats and (between x signal)^2: angles, light and
    texture change a setting's light in proportion, and no repeat makes that smaller. Without it settings that
    were read a hundred times would decide alone. Without repeats the two cannot be separated, nor need be.
    """
    if not (model.repeats > 1).any():
        return fitted
    for _ in range(ROUNDS):
        signal = model.level(fitted.fit.values) - model.response.black_dn
        noise, between = _noise_of_all(model, signal, fitted, model.repeats)
        fitted = _fit(model, fitted.fit.values, signal, noise, between)
    return fitted


def _fit(
    model: ReadingsModel, start: Float64, signal: Float64, noise: ReadingNoise, between: float
) -> ReadingsFit:
    of_repeats = noise.variance(signal) / model.repeats
    sigma = np.sqrt(of_repeats + _rounding(model, noise, signal) + (between * signal) ** 2)
    fitted = fit(model.parameters(start), lambda p: (model.gray_level - model.level(p)) / sigma)
    return ReadingsFit(fitted, noise, sigma, between)


def _rounding(model: ReadingsModel, noise: ReadingNoise, signal: Float64) -> Float64:
    """Return the rounding's variance (m,) in the means, DN^2; 0 without repeats: the residuals hold it."""
    if not (model.repeats > 1).any():
        return np.zeros_like(signal)
    return np.where(model.is_whole, rounding_left(noise.variance(signal)), 0.0)


def _noise_of_repeats(model: ReadingsModel, signal: Float64) -> ReadingNoise:
    if not (model.repeats > 1).any():
        return ReadingNoise(1.0, 0.0)
    return estimate_noise(signal, np.nan_to_num(model.variance), model.repeats - 1.0)


def _noise_of_all(
    model: ReadingsModel, signal: Float64, fitted: ReadingsFit, shares: Float64
) -> tuple[ReadingNoise, float]:
    """Return the noise, and what settings differ by, of which `shares` (m,) are in the residuals' squares."""
    residual_share = np.clip(1.0 - fitted.fit.leverage, 1e-9, 1.0)
    of_residuals = model.repeats * (fitted.fit.residuals * fitted.sigma) ** 2 / residual_share
    rounding = model.repeats * _rounding(model, fitted.noise, signal)
    return estimate_scatter(
        np.tile(signal, 2),
        np.append(np.nan_to_num(model.variance), of_residuals),
        np.append(model.repeats - 1.0, residual_share),
        np.append(np.zeros_like(signal), shares),
        np.append(np.zeros_like(signal), rounding),
    )

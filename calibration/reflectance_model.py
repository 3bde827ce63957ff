"""The grey levels that a reflectance predicts for goniometer settings, and their weighted fit.

    G_j = black + (saturation - black) [(A_diff + A_spec lobe_j(c2)) cos(theta_i) I / a^2]^gamma,
    lobe(c2) = G(theta_i, theta_r, phi_r) / cos(theta_r) exp(-c2 alpha^2)             (Eq. 5, 7, 17, 20)

A_diff = s kappa_diff and A_spec = s kappa_spec, s the factor of `goniometer`. A white standard of an albedo
has s albedo / pi instead of the bracket's first factor. Grey levels are compared as they were read, for there
read noise and rounding are additive; gamma is undone for the first guess and for pictures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from calibration.goniometer import NORMAL, Readings, Response
from calibration.reading_noise import ReadingNoise, estimate_noise
from noise_model.brdf import reflectance
from noise_model.fit import Fit, Parameter, fit
from noise_model.frames import Float64

NAMES = ("kappa_diff", "kappa_spec", "c2")
"""What is wanted."""

A_DIFF, A_SPEC, C2, SCALE = "s kappa_diff", "s kappa_spec", "c2", "s"
"""What is fitted."""

C2_LOWEST, C2_HIGHEST = 0.01, 1e5
"""c2 is sought between these: the lobe's 1/e half angle alpha = 1/c is 570 and 0.18 deg there."""

FAINTEST = 20.0
"""The setting nearest the mirror direction must see e^-20 of the lobe's peak: c2 alpha^2 up to this."""

N_STARTS = 36

ROUNDS = 3
"""How often noise and fit are taken in turn; the weights hardly change after the second."""


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

    `gray_level`, `repeats`, `variance` as in `Readings`; `white` is None without a standard.
    """

    diffuse: Float64
    lobe: Float64
    alpha2: Float64
    white: Float64 | None
    gray_level: Float64
    repeats: Float64
    variance: Float64
    response: Response

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
        best, least = np.zeros(0), math.inf
        for c2 in np.geomspace(10.0 * C2_LOWEST, 0.1 * self.c2_highest, N_STARTS):
            columns = [self.diffuse, self.lobe * np.exp(-c2 * self.alpha2)]
            if self.white is not None:
                columns.append(self.white)
            parts, rest = nnls(np.column_stack(columns), light)
            if rest < least:
                best, least = np.insert(parts, 2, c2), rest
        return best

    def parameters(self, start: Float64) -> list[Parameter]:
        """Return what is fitted: light per cos(theta_i) I / a^2, which is >= 0, and c2 within its range."""
        step = 1e-5 * float(np.max(self.response.light(self.gray_level)))
        return [
            Parameter(C2, "", value, lower=C2_LOWEST, upper=self.c2_highest, step=1e-4 * value)
            if name == C2
            else Parameter(name, "", value, lower=0.0, step=step)
            for name, value in zip((A_DIFF, A_SPEC, C2, SCALE), start.tolist(), strict=False)
        ]


def readings_model(sample: Readings, response: Response, white: White | None) -> ReadingsModel:
    """Return the model of a sample's readings and those of a white standard, if there are any."""
    settings = sample.settings
    diffuse = settings.irradiance
    lobe = reflectance(settings.omega_i, settings.omega_r, NORMAL, 0.0, 1.0, 0.0) * diffuse
    alpha2 = settings.alpha**2
    if white is None:
        means = sample.gray_level, sample.repeats, sample.variance
        return ReadingsModel(diffuse, lobe, alpha2, None, *means, response)
    standard = white.readings
    dark, other = np.zeros(len(standard.settings)), np.zeros(len(settings))
    return ReadingsModel(
        diffuse=np.append(diffuse, dark),
        lobe=np.append(lobe, dark),
        alpha2=np.append(alpha2, dark),
        white=np.append(other, standard.settings.irradiance * white.albedo / math.pi),
        gray_level=np.append(sample.gray_level, standard.gray_level),
        repeats=np.append(sample.repeats, standard.repeats),
        variance=np.append(sample.variance, standard.variance),
        response=response,
    )


@dataclass(frozen=True, eq=False)
class ReadingsFit:
    """A fit, the noise of a reading behind its weights, and the standard error (m,) of each mean, DN."""

    fit: Fit
    noise: ReadingNoise
    sigma: Float64


def fit_readings(model: ReadingsModel) -> ReadingsFit:
    """Fit A_diff, A_spec, c2 and s with weights by the noise.

    Repeats and residuals both tell the noise, each with its degrees of freedom (a residual has 1 - leverage),
    so that readings without repeats need no other treatment. Signals are the model's, not the readings: a
    weight that follows its own reading's error pulls the fit down.
    """
    start = model.start()
    signal = model.gray_level - model.response.black_dn
    noise = _noise_of_repeats(model, signal)
    fitted = _fit(model, start, signal, noise)
    for _ in range(ROUNDS - 1):
        start = fitted.fit.values
        signal = model.level(start) - model.response.black_dn
        fitted = _fit(model, start, signal, _noise_of_all(model, signal, fitted))
    return fitted


def _fit(model: ReadingsModel, start: Float64, signal: Float64, noise: ReadingNoise) -> ReadingsFit:
    sigma = np.sqrt(noise.variance(signal) / model.repeats)
    found = fit(model.parameters(start), lambda p: (model.gray_level - model.level(p)) / sigma)
    return ReadingsFit(found, noise, sigma)


def _noise_of_repeats(model: ReadingsModel, signal: Float64) -> ReadingNoise:
    if not (model.repeats > 1).any():
        return ReadingNoise(1.0, 0.0)
    return estimate_noise(signal, np.nan_to_num(model.variance), model.repeats - 1.0)


def _noise_of_all(model: ReadingsModel, signal: Float64, fitted: ReadingsFit) -> ReadingNoise:
    left = np.clip(1.0 - fitted.fit.leverage, 1e-9, 1.0)
    of_residuals = model.repeats * (fitted.fit.residuals * fitted.sigma) ** 2 / left
    return estimate_noise(
        np.tile(signal, 2),
        np.append(np.nan_to_num(model.variance), of_residuals),
        np.append(model.repeats - 1.0, left),
    )

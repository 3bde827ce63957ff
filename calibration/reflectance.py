"""kappa_diff, kappa_spec and c2 of a base metal from goniometer readings.

Readings determine s kappa_diff, s kappa_spec and c2 (`reflectance_model`): brightness has no unit. The
factor s is settled by

- readings of a white standard under the same source and camera, f_r = albedo / pi: kappas in 1/sr; or
- a convention, kappa_diff + kappa_spec = total, which is f_r in the mirror direction at normal incidence.
  Only their ratio was measured then, and their intervals are two views of its one.

The weights come from the noise of all repeats and residuals pooled and from what differs from setting to
setting (angles, texture, slow drift), which the repeats of one setting never see; the sigmas from the scatter
of the settings' means about the model with Student's t.
"""

import math
from dataclasses import dataclass

import numpy as np

from calibration.goniometer import GreyResponse, Readings
from calibration.goniometer_test import RepeatScatter, compare
from calibration.reading_noise import ReadingNoise
from calibration.reflectance_limits import refuse_if_dark, refuse_if_undetermined, refuse_if_unfit
from calibration.reflectance_model import White, fit_readings, fit_settings, readings_model
from noise_model.compiled.arrays import Float64
from noise_model.fit import Fit, correlation, student_t
from noise_model.surface.brdf import Material


@dataclass(frozen=True, eq=False)
class StandardResiduals:
    """Residuals of the (m,) settings of a white standard, as in `Reflectance`."""

    predicted: Float64
    residuals: Float64
    studentised: Float64
    scatter: RepeatScatter


@dataclass(frozen=True, eq=False)
class Reflectance:
    """The result: the material, its parameters' uncertainty, and how well the readings agree with it.

    `covariance` (3, 3) and `intervals` (3, 2), 95 %, are of kappa_diff, kappa_spec, c2. `absolute` if the
    kappas are in 1/sr by a white standard, else their sum is a convention. `scale` is s. `predicted` and
    `sigma` (m,) are the settings' mean grey levels by the fit and their standard errors by the scatter,
    `residuals` (m,) read less predicted, DN, `studentised` (m,) these over the sigma that the fit leaves
    them, NaN where it leaves nothing. `between` is what settings differ by beyond the noise of their repeats,
    relative. `white` says the same of a white standard's settings. `fit` is the one behind it, in s kappa.
    """

    material: Material
    absolute: bool
    scale: float
    covariance: Float64
    intervals: Float64
    predicted: Float64
    sigma: Float64
    residuals: Float64
    studentised: Float64
    noise: ReadingNoise
    between: float
    scatter: RepeatScatter
    white: StandardResiduals | None
    fit: Fit

    @property
    def values(self) -> Float64:
        """The three values (3,)."""
        return np.array([self.material.kappa_diff, self.material.kappa_spec, self.material.c2])

    @property
    def sigmas(self) -> Float64:
        """Their 1 sigma (3,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Float64:
        """Their correlations (3, 3)."""
        return correlation(self.covariance)


def identify_reflectance(
    sample: Readings,
    response: GreyResponse,
    *,
    white: White | None = None,
    total: float = 1.0,
    name: str = "sample",
) -> Reflectance:
    """Fit kappa_diff, kappa_spec and c2 to a sample's averaged readings.

    `white` makes the kappas absolute; without it kappa_diff + kappa_spec = `total`. The intervals are 95 %:
    value -+ t sigma for the kappas, cut at 0 and at a total, and value e^(-+ t sigma / value) for c2. Raises
    ValueError, which says why, if the readings cannot determine all three.
    """
    if not 0 < total < math.inf:
        raise ValueError(f"total = {total}: kappa_diff + kappa_spec must be > 0")
    refuse_if_unfit(sample, response)
    if white is not None:
        refuse_if_dark(white.readings, response)
    model = readings_model(sample, response, white)
    by_repeats = fit_readings(model)
    fitted = fit_settings(model, by_repeats)
    scaled = fitted.fit.scaled_by_scatter()
    values, jacobian = _in_kappas(scaled.values, total)
    covariance = jacobian @ scaled.covariance @ jacobian.T
    half = student_t(0.95, scaled.t_freedom) * np.sqrt(np.diag(covariance))
    m = len(sample.settings)
    scatter = compare(model, by_repeats, slice(m))
    refuse_if_undetermined(sample, model, fitted, scatter, values, half)
    sigma = fitted.sigma * math.sqrt(scaled.chi2)
    predicted = model.level(scaled.values)
    residuals = model.gray_level - predicted
    studentised = _studentised(residuals / sigma, scaled.leverage)
    standard = None
    if white is not None:
        of_white = compare(model, by_repeats, slice(m, None))
        standard = StandardResiduals(predicted[m:], residuals[m:], studentised[m:], of_white)
    return Reflectance(
        material=Material(name, *values.tolist()),
        absolute=white is not None,
        scale=float(scaled.values[3]) if white is not None else float(scaled.values[:2].sum()) / total,
        covariance=covariance,
        intervals=_intervals(values, half, math.inf if white is not None else total),
        predicted=predicted[:m],
        sigma=sigma[:m],
        residuals=residuals[:m],
        studentised=studentised[:m],
        noise=fitted.noise,
        between=fitted.between,
        scatter=scatter,
        white=standard,
        fit=scaled,
    )


def _in_kappas(p: Float64, total: float) -> tuple[Float64, Float64]:
    """Return kappa_diff, kappa_spec, c2 of what was fitted (k,) and the derivatives (3, k)."""
    a_diff, a_spec, c2 = p[:3]
    if len(p) == 4:
        s = p[3]
        values = np.array([a_diff / s, a_spec / s, c2])
        jacobian = [[1.0 / s, 0.0, 0.0, -a_diff / s**2], [0.0, 1.0 / s, 0.0, -a_spec / s**2], [0, 0, 1.0, 0]]
        return values, np.array(jacobian)
    both = a_diff + a_spec
    slope = total / both**2
    values = np.array([total * a_diff / both, total * a_spec / both, c2])
    return values, np.array(
        [[slope * a_spec, -slope * a_diff, 0.0], [-slope * a_spec, slope * a_diff, 0.0], [0.0, 0.0, 1.0]]
    )


def _intervals(values: Float64, half: Float64, total: float) -> Float64:
    lower, upper = np.maximum(values - half, 0.0), np.minimum(values + half, total)
    factor = math.exp(half[2] / values[2])
    lower[2], upper[2] = values[2] / factor, values[2] * factor
    return np.column_stack([lower, upper])


def _studentised(residuals: Float64, leverage: Float64) -> Float64:
    """Return residuals in sigmas over what the fit leaves of them; NaN where it takes a reading up whole."""
    residual_share = 1.0 - leverage
    return np.divide(
        residuals,
        np.sqrt(np.abs(residual_share)),
        out=np.full_like(residual_share, np.nan),
        where=residual_share > 1e-6,
    )

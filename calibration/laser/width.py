"""Thickness of the sheet over depth: proportional as in the setup's model, linear, or a beam's waist.

A tilted board shows the stripe wider, and the lens blurs it: with g mm off the plane per pixel across the
stripe, and the point-spread function's sigma b, sigma² = g² (s² - b²). The model's sheet widens in proportion
to the depth z below its origin, sigma = sigma_h z / h. A Gaussian beam has sigma² = w² (1 + ((z - z_0) /
z_R)²) with w at its waist (Siegman, Lasers, 1986, section 17.1): a parabola in z.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.stats import chi2

from calibration.laser.image_line import lines_together
from calibration.outliers import FALSE_ALARM
from noise_model.compiled.arrays import Float64
from noise_model.robust import spread

MIN_LINES = 15
"""Least number of scan lines that determine a width."""

SURE_SIGMAS = 4.0
"""A waist whose curvature is less sure may be none."""


class Law(StrEnum):
    """Law of the thickness over depth; each includes the one before."""

    MODEL = "in proportion to the depth below the origin, as the setup's model has it"
    STRAIGHT = "along a straight line"
    WAIST = "as a Gaussian beam about its waist"


@dataclass(frozen=True)
class Waist:
    """A beam's waist: its depth below the origin, sigma there, Rayleigh range, mm, each with 1 sigma."""

    depth_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    rayleigh_mm: tuple[float, float]


@dataclass(frozen=True)
class Width:
    """The sheet's thickness over depth.

    At `depth_mm` (k,) below the laser's origin, along the tool's axis, half the thickness has 1 sigma
    `sigma_mm` (k,), which is known within `error_mm` (k,). `law` is the leanest that holds; `coefficients`
    (m,) are of sigma (the first two laws) or sigma² (a waist) over powers of the depth. `at_height_mm` is the
    setup's `stripe_sigma_mm` with 1 sigma, None where the boards are far from tool height; `waist` is None
    where the boards do not determine one.
    """

    depth_mm: Float64
    sigma_mm: Float64
    error_mm: Float64
    law: Law
    coefficients: Float64
    covariance: Float64
    at_height_mm: tuple[float, float] | None
    waist: Waist | None

    def at(self, depth_mm: Float64) -> Float64:
        """Return the law's sigma at depths (n,), mm."""
        value = _powers(self.law, depth_mm) @ self.coefficients
        return np.asarray(np.sqrt(np.maximum(value, 0.0)) if self.law is Law.WAIST else value)


def width_of_pair(width_px: Float64, per_px_mm: Float64, blur_px: float) -> tuple[float, float] | None:
    """Return 1 sigma of half the sheet's thickness on a board, mm, and 1 sigma of that.

    `width_px` (n,) is the stripe's sigma in each scan line, NaN where unknown, `per_px_mm` (n,) the distance
    from the sheet per pixel on the board, `blur_px` the point-spread function's sigma. None where too few
    lines determine it, or where the blur makes the stripe.
    """
    known = np.isfinite(width_px)
    if known.sum() < MIN_LINES:
        return None
    square = (per_px_mm[known] * width_px[known]) ** 2 - (per_px_mm[known] * blur_px) ** 2
    variance = float(np.median(square))
    # Else the stated blur makes the width.
    if variance < 0.25 * float(np.median((per_px_mm[known] * width_px[known]) ** 2)):
        return None
    scatter = spread(square)
    independent = len(square) / lines_together(
        square.clip(variance - 5.0 * scatter, variance + 5.0 * scatter)
    )
    # A median's standard error is sqrt(pi / 2) times a mean's.
    error = math.sqrt(0.5 * math.pi) * scatter / math.sqrt(max(independent, 1.0))
    sigma = math.sqrt(variance)
    return sigma, max(0.5 * error / sigma, 1e-6 * sigma)


def fit_width(pairs: Mapping[float, tuple[float, float]], height_mm: float) -> Width | None:
    """Return the law of the thickness over depth, None without a pair.

    `pairs` maps the depth below the origin, mm, to sigma and its 1 sigma, mm; the origin is `height_mm` above
    the tool's.
    """
    if not pairs:
        return None
    depth = np.array([*pairs])
    sigma, error = np.array([*pairs.values()]).T
    law, fitted = Law.MODEL, _fit(Law.MODEL, depth, sigma, error)
    for richer in (Law.STRAIGHT, Law.WAIST):
        # A law is left where it fails and the next one has a pair to spare.
        if fitted is None or chi2.sf(fitted[2], fitted[3]) >= FALSE_ALARM:
            break
        better = _fit(richer, depth, sigma, error)
        if better is None or not _is_better(fitted, better):
            continue
        law, fitted = richer, better
    coefficients, covariance, squares, freedom = fitted if fitted is not None else _alone(depth, sigma, error)
    if freedom > 0 and chi2.sf(squares, freedom) < FALSE_ALARM:
        covariance = covariance * squares / freedom
    row = _powers(law, np.array([height_mm]))[0]
    value, value_error = float(row @ coefficients), math.sqrt(float(row @ covariance @ row))
    if law is Law.WAIST:
        value = math.sqrt(max(value, 1e-12))
        value_error = 0.5 * value_error / value
    beyond = max(float(depth.min()) - height_mm, height_mm - float(depth.max()), 0.0)
    # Beyond the boards another law holds for half of their range.
    is_near = law is Law.MODEL or beyond <= 0.5 * float(np.ptp(depth))
    at_height = (value, value_error) if is_near and value > SURE_SIGMAS * value_error else None
    waist = _waist(coefficients, covariance) if law is Law.WAIST else None
    return Width(
        depth_mm=depth,
        sigma_mm=sigma,
        error_mm=error,
        law=law,
        coefficients=coefficients,
        covariance=covariance,
        at_height_mm=at_height,
        waist=waist,
    )


_Fit = tuple[Float64, Float64, float, int]
"""Coefficients, their covariance, sum of squares over variance, degrees of freedom."""


def _powers(law: Law, depth_mm: Float64) -> Float64:
    exponents = {Law.MODEL: [1], Law.STRAIGHT: [0, 1], Law.WAIST: [0, 1, 2]}[law]
    return np.asarray(depth_mm[:, np.newaxis] ** np.array(exponents), dtype=np.float64)


def _fit(law: Law, depth: Float64, sigma: Float64, error: Float64) -> _Fit | None:
    """Return the least squares' fit; None without a pair to spare."""
    A = _powers(law, depth)
    freedom = len(depth) - A.shape[1]
    if freedom < 1:
        return None
    value, each = (sigma**2, 2.0 * sigma * error) if law is Law.WAIST else (sigma, error)
    A, value = A / each[:, np.newaxis], value / each
    scale = np.linalg.norm(A, axis=0)
    small = np.linalg.pinv((A / scale).T @ (A / scale)) / np.outer(scale, scale)
    coefficients = small @ A.T @ value
    return coefficients, small, float(np.sum((A @ coefficients - value) ** 2)), freedom


def _alone(depth: Float64, sigma: Float64, error: Float64) -> _Fit:
    return sigma / depth, np.array([[float(error[0] / depth[0]) ** 2]]), 0.0, 0


def _is_better(fitted: _Fit, richer: _Fit) -> bool:
    """Return True if a coefficient is significant by its F test, of one degree of freedom."""
    return fitted[2] - richer[2] > SURE_SIGMAS**2 * max(richer[2] / richer[3], 1.0)


def _waist(coefficients: Float64, covariance: Float64) -> Waist | None:
    c0, c1, c2 = coefficients.tolist()
    if not c2 > SURE_SIGMAS * math.sqrt(covariance[2, 2]):
        return None
    waist2 = c0 - c1**2 / (4.0 * c2)
    if not waist2 > 0.0:
        return None
    depth, sigma = -c1 / (2.0 * c2), math.sqrt(waist2)
    rayleigh = math.sqrt(waist2 / c2)
    by_waist2 = np.array([1.0, -c1 / (2.0 * c2), (c1 / (2.0 * c2)) ** 2])
    rows = (
        np.array([0.0, -1.0 / (2.0 * c2), c1 / (2.0 * c2**2)]),
        by_waist2 / (2.0 * sigma),
        (by_waist2 / c2 - np.array([0.0, 0.0, waist2 / c2**2])) / (2.0 * rayleigh),
    )
    errors = [math.sqrt(float(row @ covariance @ row)) for row in rows]
    return Waist((depth, errors[0]), (sigma, errors[1]), (rayleigh, errors[2]))

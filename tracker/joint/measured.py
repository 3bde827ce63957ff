"""What a joint's fit returns, and the robust least squares that the shapes share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from tracker.joint.section_fit import N_CORNERS, best_shift, corners_of, fit_section
from tracker.profile import Profile

SIGMA_FLOOR_PX = 0.05
"""What a stripe centre may be off beyond its noise: the surface's own roughness, pixels unlike each other."""

START_SIGMA_MM = 0.3
"""How far off the nominal shape a point may lie at first; halved with every step of the fit."""

PLACED_BY = 160
"""So many of a profile's points, evenly chosen, place a section."""


@dataclass(frozen=True)
class ShapeFit:
    """Parameters (p,), their covariance (p, p), chi2 per degree of freedom and the points' weights (n,).

    `corners_mm` (k, 2) are the fitted section's, as (y, z).
    """

    parameters: Float64
    covariance: Float64
    chi2: float
    weights: Float64
    corners_mm: Float64


@dataclass(frozen=True)
class MeasuredJoint:
    """The joint in its own frame, mm: the seam point, its covariance (2, 2) of (y, z), and its dimensions.

    `chi2` is the fit's per degree of freedom; `gap_mm` and `mismatch_mm` are NaN where the shape has none.
    `shape` is the fit of the section that they come from.
    """

    y_mm: float
    z_mm: float
    covariance_mm2: Float64
    gap_mm: float
    mismatch_mm: float
    chi2: float
    shape: ShapeFit


def fit_shape(
    profile: Profile,
    shape: int,
    start: Float64,
    prior_sigma: Float64,
    used: npt.NDArray[np.bool_] | None = None,
) -> ShapeFit | None:
    """Fit a shape of `section_fit` to a profile, in pixels of stripe centre, with priors about `start`.

    None where fewer points are `used` than the parameters need, and where the fit runs away. What `start` has
    beyond `prior_sigma` (p,) stays as it is.
    """
    sigma = np.hypot(profile.sigma_px, SIGMA_FLOOR_PX)
    mask = np.ones(len(profile.y_mm), dtype=bool) if used is None else used
    n = len(prior_sigma)
    if mask.sum() < n + 3:
        return None
    parameters, covariance = start.copy(), np.empty((n, n))
    weights = np.empty(len(profile.y_mm))
    wide = START_SIGMA_MM / max(float(np.median((np.abs(profile.dz_mm) * sigma)[mask])), 1e-6)
    chi2 = fit_section(
        shape,
        profile.y_mm,
        profile.z_mm,
        profile.dy_mm,
        profile.dz_mm,
        sigma,
        mask,
        wide,
        prior_sigma,
        parameters,
        covariance,
        weights,
    )
    if not math.isfinite(chi2):
        return None
    corners = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, parameters, corners)
    return ShapeFit(parameters[:n], covariance, chi2, weights, corners)


def place(profile: Profile, corners: Float64, step_mm: float, limit_mm: float) -> tuple[float, float]:
    """Return the shift (y, z) in mm of nominal corners (k, 2) that explains most of a profile.

    Lateral shifts are tried by steps of `step_mm` all along the profile, see `best_shift`.
    """
    shifts = np.arange(profile.y_mm[0], profile.y_mm[-1] + step_mm, step_mm)
    every = max(1, len(profile.y_mm) // PLACED_BY)
    return best_shift(profile.y_mm[::every], profile.z_mm[::every], corners, shifts, limit_mm)

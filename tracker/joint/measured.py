"""What a joint's fit returns, and the robust least squares that the shapes share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from tracker.profile import Profile

SIGMA_FLOOR_PX = 0.05
"""What a stripe centre may be off beyond its noise: the surface's own roughness, pixels unlike each other."""

STEP = 1e-5
"""The step of the numerical derivatives, in each parameter's unit."""

CONVERGED = 1e-5
"""A step smaller than this in every parameter's unit ends the fit."""

BISQUARE_WIDTH = 4.685
"""Tukey's tuning constant: 95 % efficiency on Gaussian residuals."""

START_SIGMA_MM = 0.3
"""How far off the nominal shape a point may lie at first; halved with every step of the fit."""


@dataclass(frozen=True)
class MeasuredJoint:
    """The joint in its own frame, mm: the seam point, its covariance (2, 2) of (y, z), and its dimensions.

    `chi2` is the fit's per degree of freedom; `gap_mm` and `mismatch_mm` are NaN where the shape has none.
    """

    y_mm: float
    z_mm: float
    covariance_mm2: Float64
    gap_mm: float
    mismatch_mm: float
    chi2: float


@dataclass(frozen=True)
class ShapeFit:
    """Parameters (p,), their covariance (p, p), chi2 per degree of freedom and the points' weights (n,)."""

    parameters: Float64
    covariance: Float64
    chi2: float
    weights: Float64


def fit_shape(
    profile: Profile,
    height: Callable[[Float64, Float64], Float64],
    start: Float64,
    prior_sigma: Float64,
    used: npt.NDArray[np.bool_] | None = None,
) -> ShapeFit | None:
    """Fit z = height(parameters, y) to a profile, in pixels of stripe centre, with priors about `start`.

    A point's residual is how far its stripe centre would have to move to lie on the shape: (z - f(y)) /
    (dz - f'(y) dy). Gauss-Newton with numerical derivatives, Tukey's bisquare weights about a robust scale.
    `height` must take parameters (p,), and (p, m, 1) for m sets of them at once. The scale begins wide: a
    narrow one would cut off the few points that tell, such as a root's, for good.
    """
    y, z = profile.y_mm, profile.z_mm
    sigma = np.hypot(profile.sigma_px, SIGMA_FLOOR_PX)
    mask = np.ones(len(y), dtype=bool) if used is None else used
    if mask.sum() < len(start) + 3:
        return None
    parameters = start.copy()
    h_y = 1e-4

    def sigma_z(p: Float64) -> Float64:
        slope = (height(p, y + h_y) - height(p, y - h_y)) / (2.0 * h_y)
        along = profile.dz_mm - slope * profile.dy_mm
        return np.where(np.abs(along) < 1e-6, 1e-6, along) * sigma

    weights = mask.astype(np.float64)
    information = np.eye(len(start))
    scale = 1.0
    wide = START_SIGMA_MM / max(float(np.median((np.abs(profile.dz_mm) * sigma)[mask])), 1e-6)
    for _ in range(20):
        at, unit = height(parameters, y), sigma_z(parameters)
        r = (z - at) / unit
        moved = parameters[:, None, None] + STEP * np.eye(len(start))[:, :, None]
        J = ((at - height(moved, y)) / (STEP * unit)).T
        scale = max(1.0, 1.4826 * float(np.median(np.abs(r[mask]))), wide)
        weights = np.where(mask, np.maximum(0.0, 1.0 - (r / (BISQUARE_WIDTH * scale)) ** 2) ** 2, 0.0)
        information = J.T @ (weights[:, None] * J) + np.diag((scale / prior_sigma) ** 2)
        gradient = J.T @ (weights * r) + (scale / prior_sigma) ** 2 * (parameters - start)
        step = np.linalg.solve(information, -gradient)
        parameters = parameters + step
        if wide < 1.0 and np.max(np.abs(step)) < CONVERGED:
            break
        wide /= 2.0
    r = (z - height(parameters, y)) / sigma_z(parameters)
    freedom = max(float(weights.sum()) - len(start), 1.0)
    chi2 = float(np.sum(weights * r**2) / freedom)
    covariance = np.asarray(np.linalg.inv(information) * max(1.0, chi2), dtype=np.float64)
    if not np.isfinite(parameters).all():
        return None
    return ShapeFit(parameters, covariance, chi2, np.asarray(weights, dtype=np.float64))


def place_by_template(
    profile: Profile, height: Callable[[Float64], Float64], step_mm: float, limit_mm: float
) -> tuple[float, float]:
    """Return the shift (y, z) in mm of a nominal section that explains most of a profile.

    Every lateral shift on a grid gets its height as the median of what is left over, and is judged by the sum
    of absolute residuals, each cut at `limit_mm`, so that spatter and false stripes count little.
    """
    y, z = profile.y_mm, profile.z_mm
    shifts = np.arange(y[0], y[-1] + step_mm, step_mm)
    every = max(1, len(y) // 160)
    y, z = y[::every], z[::every]
    left_over = z[None, :] - height(y[None, :] - shifts[:, None])
    rise = np.median(left_over, axis=1)
    cost = np.minimum(np.abs(left_over - rise[:, None]), limit_mm).sum(axis=1)
    best = int(np.argmin(cost))
    return float(shifts[best]), float(rise[best])

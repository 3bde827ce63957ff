"""Result of a joint's fit, and the robust least squares that the shapes share."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median
from tracker.joint.section_fit import (
    MIN_ALONG_MM,
    SIGMA_FLOOR_PX,
    ShapeFit,
    add_shared_errors,
    best_shift,
    fit_section,
)
from tracker.joint.section_shapes import N_CORNERS, corners_of, opening
from tracker.state import DY_MM, DZ_MM, N_LINES, NO_SHAPE, SIGMA_PX, Y_MM, Z_MM, JointShape, Pair

START_SIGMA_MM = 0.3
"""Largest initial distance of a point from the nominal shape; halved with every step of the fit."""

LEFT_OUT = 0.1
"""A point of less weight than this lies off the shape."""

OFF_SIGMAS = 5.0
"""A point farther than this off a sheet is not of the sheet's own surface."""

SURE_SIGMAS, SURE_MM = 2.0, 1.0
"""For a hidden bevel: distance from the visible side, in sigmas of the gap, of a point that is surely the
root's; distance from the mouth of one that is surely the plate's."""


_NO_CORNERS = np.empty((0, 2))


class MeasuredJoint(NamedTuple):
    """The joint in its own frame, mm: the seam point, its covariance (2, 2) of (y, z), and its dimensions.

    `chi2` is the fit's per degree of freedom; `gap_mm` and `mismatch_mm` are NaN where the shape has none.
    `corners_mm` (n, 2) is the fitted section as (y, z). `evidence_nats` is its evidence over a plate without
    a joint; `misfit_nats` that of another surface next to the seam, which hides an upright edge so far,
    `covered_mm`.
    """

    y_mm: float
    z_mm: float
    covariance_mm2: Float64
    gap_mm: float
    mismatch_mm: float
    chi2: float
    shape: JointShape = NO_SHAPE
    corners_mm: Float64 = _NO_CORNERS
    evidence_nats: float = math.nan
    misfit_nats: float = -math.inf
    covered_mm: float = 0.0


@kernel(allocates=True)
def fit_points(
    shape: int, points: Float64, used: Bool, start_sigma_mm: float, prior_sigma: Float64, start: Float64
) -> ShapeFit:
    """Fit a shape of `section_fit` to a section's points, in px of stripe centre, with priors about `start`.

    Those that are `used` (n,) count. A point may lie `start_sigma_mm` off the start. The fit's chi2 is NaN
    where fewer points are used than the parameters need, and where it runs away. What `start` has beyond
    `prior_sigma` (p,) stays as it is.
    """
    n, m, count = points.shape[1], prior_sigma.shape[0], 0
    sigma, moves = np.empty(n), np.empty(n)
    for i in range(n):
        sigma[i] = math.sqrt(points[SIGMA_PX, i] ** 2 + SIGMA_FLOOR_PX**2 / points[N_LINES, i])
        if used[i]:
            moves[count] = abs(points[DZ_MM, i]) * sigma[i]
            count += 1
    if count < m + 3:
        return ShapeFit(start[:m].copy(), np.empty((m, m)), math.nan, sigma)
    # No point's height is known better.
    wide = start_sigma_mm / max(exact_median(moves[:count]), 1e-6)
    fit = fit_section(shape, points, sigma, used, wide, prior_sigma, start)
    if math.isfinite(fit.chi2):
        add_shared_errors(shape, points, sigma, fit)
    return ShapeFit(fit.parameters[:m], fit.covariance, fit.chi2, fit.weights)


@kernel(allocates=True)
def shift_of(
    y_mm: Float64,
    z_mm: Float64,
    reach_mm: float,
    corners: Float64,
    lift_mm: float,
    step_mm: float,
    limit_mm: float,
) -> tuple[float, float]:
    """Return the shift (y, z) in mm of nominal corners (k, 2), lifted, that explains most of points (n,).

    Lateral shifts are tried by steps of `step_mm` within the points' reach, see `best_shift`.
    """
    # Number of a profile's points, evenly chosen, that place a section.
    every = max(1, y_mm.shape[0] // 160)
    n = (y_mm.shape[0] + every - 1) // every
    y, z, lifted = np.empty(n), np.empty(n), corners.copy()
    for i in range(n):
        y[i], z[i] = y_mm[i * every], z_mm[i * every]
    for k in range(lifted.shape[0]):
        lifted[k, 1] += lift_mm
    first_mm, last_mm = max(y_mm[0], -reach_mm), min(y_mm[-1], reach_mm)
    shifts = np.empty(max(math.ceil((last_mm + step_mm - first_mm) / step_mm), 0))
    for i in range(shifts.shape[0]):
        shifts[i] = first_mm + i * step_mm
    shift: tuple[float, float] = best_shift(y, z, lifted, shifts, limit_mm)
    return shift


class OnFace(NamedTuple):
    """Intersections of points' rays with a face: y (n,), mm, and dy by the face's height (n,)."""

    y_mm: Float64
    y_per_z: Float64


@kernel(allocates=True)
def meet_face(points: Float64, height_mm: Float64, slope: Float64) -> OnFace:
    """Return the places of points' rays on a face of heights (n,), mm, and slopes (n,) at their own y.

    A centre that is off by c px moves its point by c (dy, dz). On the face it would be at
    y - dy (z - height) / (dz - slope dy): which scan line lies where goes with the whole face's height, and
    not with the scatter of its own centre. From the side the two differ by much.
    """
    n = height_mm.shape[0]
    met_mm, y_per_z = np.empty(n), np.empty(n)
    for i in range(n):
        across = points[DZ_MM, i] - slope[i] * points[DY_MM, i]
        y_per_z[i] = points[DY_MM, i] / across if abs(across) > MIN_ALONG_MM else 0.0
        met_mm[i] = points[Y_MM, i] - y_per_z[i] * (points[Z_MM, i] - height_mm[i])
    return OnFace(met_mm, y_per_z)


@kernel(allocates=True)
def section_at(corners_mm: Float64, y_mm: Float64) -> tuple[Float64, Float64]:
    """Return height (n,), mm, and slope (n,) of a section of corners (k, 2) at places y (n,)."""
    n, last = y_mm.shape[0], corners_mm.shape[0] - 2
    height, slope = np.empty(n), np.empty(n)
    k = 0
    for i in range(n):
        # An upright edge is a step that no point lies on.
        while k > 0 and y_mm[i] < corners_mm[k, 0]:
            k -= 1
        while k < last and y_mm[i] >= corners_mm[k + 1, 0]:
            k += 1
        width = corners_mm[k + 1, 0] - corners_mm[k, 0]
        slope[i] = (corners_mm[k + 1, 1] - corners_mm[k, 1]) / width if width > 0.0 else 0.0
        height[i] = corners_mm[k, 1] + slope[i] * (y_mm[i] - corners_mm[k, 0])
    return height, slope


def off_section(points: Float64, joint: MeasuredJoint) -> Bool:
    """Return the points (n,) that lie off a joint's section by more than `OFF_SIGMAS` of their centre."""
    height_mm, slope = section_at(joint.corners_mm, points[Y_MM])
    moved = np.abs(points[DZ_MM] - slope * points[DY_MM]) * np.hypot(points[SIGMA_PX], SIGMA_FLOOR_PX)
    return np.asarray(np.abs(points[Z_MM] - height_mm) > OFF_SIGMAS * moved)


def two_angles(p: Float64, covariance: Float64, left: int, right: int) -> tuple[Pair, Pair]:
    """Return the angles, deg, whose tangents are two of a fit's parameters, and their 1 sigma."""
    first, second = float(p[left]), float(p[right])
    first_sigma = math.sqrt(covariance[left, left]) / (1.0 + first * first)
    second_sigma = math.sqrt(covariance[right, right]) / (1.0 + second * second)
    angles = math.degrees(math.atan(first)), math.degrees(math.atan(second))
    return angles, (math.degrees(first_sigma), math.degrees(second_sigma))


def section_corners(shape: int, p: Float64) -> Float64:
    """Return the corners (n, 2) of a shape as (y, z), mm, at its parameters."""
    corners_mm = np.empty((N_CORNERS[shape], 2))
    corners_of(shape, p, corners_mm)
    return corners_mm


def opening_area(shape: int, p: Float64, covariance: Float64) -> Pair:
    """Return the opening's area at parameters p, mm^2, and its 1 sigma by the covariance of the first m."""
    gradient = np.empty(len(p))
    area, slopes = opening(shape, p, gradient), gradient[: len(covariance)]
    return area, math.sqrt(slopes @ covariance @ slopes)

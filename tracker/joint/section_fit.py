"""A section's faces fitted to a profile: robust least squares in pixels of stripe centre, compiled.

A section is a polyline over y whose corners follow from a few parameters. Between two corners a face is
straight, z = (1 - s) z_a + s z_b with s = (y - y_a) / (y_b - y_a), and moves with its corners by

    dz = (1 - s) (dz_a - m dy_a) + s (dz_b - m dy_b),    m its slope.

So a face's points enter the normal equations by three sums of their weights, whatever the parameters are.

A fit to points with errors of covariance V, each taken at weight w / sigma^2 as if it were alone, scatters by

    H^-1 (J^T W V W J) H^-1,    H its information, J how the residuals change with the parameters

(the sandwich: Huber 1967, Proc. 5th Berkeley Symp. 1, 221). Where V reaches over few points only, along which
J hardly changes, the sum over a point's neighbours is that of their covariance with it, so V counts as a
diagonal: the variance with which a point counts among others, in the place of its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float64, Int64
from noise_model.compiled.cholesky import factorise, solve, write_inverse
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.median import exact_median, median_of, numbers_for
from noise_model.robust import MAD_SIGMA
from noise_model.surface.faces import face_under, slope_across
from tracker.joint.section_shapes import N_CORNERS, corners_of
from tracker.state import BESIDE_PX, DY_MM, DZ_MM, MISFIT_PX, N_LINES, SCAN, Y_MM, Z_MM
from tracker.stripe.line_fit.block import CORRELATION_PX

SIGMA_FLOOR_PX = 0.01
"""Error of a stripe centre beyond its noise: the surface's own roughness, pixels unlike each other."""

STEP = 1e-6
"""The step of the corners' derivatives, in each parameter's unit."""

BISQUARE_WIDTH = 4.685
"""Tukey's tuning constant: 95 % efficiency on Gaussian residuals."""

MAX_STEPS, CONVERGED = 20, 1e-5
"""Gauss-Newton steps at most; one smaller than this in every parameter's unit is the last."""

MIN_ALONG_MM = 1e-6
"""No point moves less than this off a face with 1 px of its stripe centre."""


@kernel
def corners_and_slopes(shape: int, p: Float64, corners: Float64, moved: Float64, slopes: Float64) -> None:
    """Write a section's corners (n, 2) at parameters p and their `slopes` (n, m, 2) by the first m of these.

    `moved` (n, 2) is scratch.
    """
    corners_of(shape, p, corners)
    for i in range(slopes.shape[1]):
        kept = p[i]
        p[i] = kept + STEP
        corners_of(shape, p, moved)
        p[i] = kept
        for k in range(corners.shape[0]):
            slopes[k, i, 0] = (moved[k, 0] - corners[k, 0]) / STEP
            slopes[k, i, 1] = (moved[k, 1] - corners[k, 1]) / STEP


@kernel(fastmath=REDUCTION)
def _residuals(
    points: Float64, sigma: Float64, corners: Float64, first: Int64, r: Float64, unit: Float64
) -> None:
    """Write the residual of each centre of points (n,) from its face, in its sigmas, and that unit in mm.

    `first` (k,) gets the first point, y rising, of each face, and behind the last one's last.
    """
    i, n = 0, points.shape[1]
    for k in range(len(first) - 1):
        first[k] = i
        while i < n and (k == len(first) - 2 or points[Y_MM, i] < corners[k + 1, 0]):
            i += 1
    first[-1] = n
    for k in range(len(first) - 1):
        slope = slope_across(k, corners)
        for i in range(first[k], first[k + 1]):
            along = points[DZ_MM, i] - slope * points[DY_MM, i]
            along = MIN_ALONG_MM if abs(along) < MIN_ALONG_MM else along
            unit[i] = along * sigma[i]
            r[i] = (points[Z_MM, i] - corners[k, 1] - slope * (points[Y_MM, i] - corners[k, 0])) / unit[i]


@kernel(allocates=True)
def _scale(r: Float64, used: Bool, min_scale: float) -> float:
    """Return a robust sigma of residuals (n,), by their median absolute deviation, or `min_scale` if more."""
    n, beyond, count = r.shape[0], 0, 0
    for i in range(n):
        count += used[i]
        beyond += used[i] and MAD_SIGMA * abs(r[i]) > min_scale
    # The median needs no sorting where it lies below.
    if 2 * beyond < count:
        return min_scale
    sizes = np.empty(count)
    count = 0
    for i in range(n):
        if used[i]:
            sizes[count] = abs(r[i])
            count += 1
    return max(min_scale, MAD_SIGMA * exact_median(sizes))


@kernel(fastmath=REDUCTION)
def _face_sums(
    y: Float64, r: Float64, unit: Float64, used: Bool, y_a: float, y_b: float, scale: float, weights: Float64
) -> tuple[float, float, float, float, float]:
    """Write Tukey's weights of a face's points (n,) and return its five sums.

    These are of w (1 - s)^2, w (1 - s) s and w s^2 over the unit's square, and of w r (1 - s) and w r s over
    the unit.
    """
    inverse, narrow = 1.0 / (y_b - y_a), 1.0 / (BISQUARE_WIDTH * scale)
    aa, ab, bb, at_a, at_b = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(y.shape[0]):
        t = r[i] * narrow
        kept = max(1.0 - t * t, 0.0)
        weights[i] = kept * kept if used[i] else 0.0
        s, per_unit = (y[i] - y_a) * inverse, 1.0 / unit[i]
        pull = weights[i] * r[i] * per_unit
        weight = weights[i] * per_unit * per_unit
        aa += weight * (1.0 - s) * (1.0 - s)
        ab += weight * (1.0 - s) * s
        bb += weight * s * s
        at_a += pull * (1.0 - s)
        at_b += pull * s
    return aa, ab, bb, at_a, at_b


@kernel
def _add_faces(
    y: Float64,
    used: Bool,
    corners: Float64,
    J: Float64,
    first: Int64,
    r: Float64,
    unit: Float64,
    scale: float,
    weights: Float64,
    room: tuple[Float64, Float64],
    information: Float64,
    gradient: Float64,
) -> None:
    """Add what the points of all faces say to the lower half of the normal equations, see `fit_section`.

    No array is made here, so that none is counted face by face. The `room` takes two rows (m,).
    """
    (at_a, at_b), n_corners, m = room, corners.shape[0], gradient.shape[0]
    for k in range(n_corners - 1):
        if first[k] == first[k + 1]:
            continue
        on = slice(first[k], first[k + 1])
        y_a, y_b = corners[k, 0], corners[k + 1, 0]
        aa, ab, bb, pull_a, pull_b = _face_sums(
            y=y[on], r=r[on], unit=unit[on], used=used[on], y_a=y_a, y_b=y_b, scale=scale, weights=weights[on]
        )
        slope = slope_across(k, corners)
        for i in range(m):
            at_a[i] = J[k, i, 1] - slope * J[k, i, 0]
            at_b[i] = J[k + 1, i, 1] - slope * J[k + 1, i, 0]
        for i in range(m):
            gradient[i] += pull_a * at_a[i] + pull_b * at_b[i]
            on_a, on_b = aa * at_a[i] + ab * at_b[i], ab * at_a[i] + bb * at_b[i]
            for j in range(i + 1):
                information[i, j] += on_a * at_a[j] + on_b * at_b[j]


class ShapeFit(NamedTuple):
    """Parameters (p,), their covariance (p, p), chi2 per degree of freedom and the points' weights (n,)."""

    parameters: Float64
    covariance: Float64
    chi2: float
    weights: Float64


@kernel(allocates=True)
def fit_section(
    shape: int,
    points: Float64,
    sigma: Float64,
    used: Bool,
    start_scale: float,
    prior_sigma: Float64,
    start: Float64,
) -> ShapeFit:
    """Fit a section to points (n,), y rising; its chi2 is NaN if it cannot be.

    A point moves by `DY_MM`, `DZ_MM` with 1 px of its stripe centre, whose 1 sigma is `sigma` (n,) px:
    its residual is how far the centre would have to move to lie on the face, (z - f) / (dz - m dy). Only
    `used` points count. The first len(prior_sigma) parameters have priors about `start` and are fitted; all
    are returned. The scale of Tukey's weights begins at `start_scale` sigmas and halves: a narrow one would
    cut off the few points that tell, such as a root's, for good.
    """
    n, m = points.shape[1], prior_sigma.shape[0]
    n_corners = N_CORNERS[shape]
    corners, moved = np.empty((n_corners, 2)), np.empty((n_corners, 2))
    p, J, first = start.copy(), np.empty((n_corners, m, 2)), np.empty(n_corners, dtype=np.int64)
    r, unit, weights, covariance = np.empty(n), np.empty(n), np.empty(n), np.empty((m, m))
    information, gradient = np.empty((m, m)), np.empty(m)
    at_a, at_b = np.empty(m), np.empty(m)
    wide = start_scale
    for _ in range(MAX_STEPS):
        corners_and_slopes(shape, p, corners, moved, J)
        _residuals(points, sigma, corners, first, r, unit)
        scale = _scale(r, used, max(1.0, wide))
        for i in range(m):
            known = (scale / prior_sigma[i]) ** 2
            for j in range(i):
                information[i, j] = 0.0
            information[i, i] = known
            gradient[i] = known * (start[i] - p[i])
        _add_faces(
            y=points[Y_MM],
            used=used,
            corners=corners,
            J=J,
            first=first,
            r=r,
            unit=unit,
            scale=scale,
            weights=weights,
            room=(at_a, at_b),
            information=information,
            gradient=gradient,
        )
        # The priors make it positive, but for a NaN.
        if not factorise(information):
            return ShapeFit(p, covariance, math.nan, weights)
        solve(information, gradient)
        largest, total = 0.0, 0.0
        for i in range(m):
            p[i] += gradient[i]
            largest = max(largest, abs(gradient[i]))
            total += gradient[i]
        if not math.isfinite(total):
            return ShapeFit(p, covariance, math.nan, weights)
        if wide < 1.0 and largest < CONVERGED:
            break
        wide /= 2.0
    corners_of(shape, p, corners)
    _residuals(points, sigma, corners, first, r, unit)
    total, freedom = 0.0, -float(m)
    for i in range(n):
        total += weights[i] * r[i] * r[i]
        freedom += weights[i]
    chi2 = total / max(freedom, 1.0)
    write_inverse(information, covariance)
    for i in range(m):
        for j in range(m):
            covariance[i, j] *= max(1.0, chi2)
    return ShapeFit(p, covariance, chi2, weights)


@kernel(allocates=True)
def best_shift(
    y: Float64, z: Float64, corners: Float64, shifts: Float64, limit_mm: float
) -> tuple[float, float]:
    """Return the shift (y, z), mm, of nominal corners (k, 2) that explains most of a profile (n,), y rising.

    Every lateral shift gets its height as the median of what is left over, and is judged by the sum of
    absolute residuals, each cut at `limit_mm`, so that spatter and false stripes count little.
    """
    n = y.shape[0]
    left_over, room = np.empty(n), np.empty(numbers_for(n), np.float32)
    slopes = np.empty(corners.shape[0] - 1)
    for k in range(len(slopes)):
        slopes[k] = slope_across(k, corners)
    best, best_shift_mm, best_rise = math.inf, 0.0, 0.0
    for shift in shifts:
        k = 0
        for i in range(n):
            y_nominal = y[i] - shift
            k = face_under(y_nominal, k, corners)
            left_over[i] = z[i] - corners[k, 1] - slopes[k] * (y_nominal - corners[k, 0])
        for i in range(n):
            room[i] = left_over[i]
        rise = median_of(room, n)
        cost = 0.0
        for i in range(y.shape[0]):
            cost += min(abs(left_over[i] - rise), limit_mm)
        if cost < best:
            best, best_shift_mm, best_rise = cost, shift, rise
    return best_shift_mm, best_rise


@kernel(allocates=True)
def _by_parameters(shape: int, points: Float64, sigma: Float64, p: Float64, m: int) -> Float64:
    """Return how the residuals of points (n,), in sigmas, change with the first m parameters, (n, m)."""
    n_corners = N_CORNERS[shape]
    corners, moved = np.empty((n_corners, 2)), np.empty((n_corners, 2))
    changed, J = np.empty((n_corners, m, 2)), np.empty((len(sigma), m))
    corners_and_slopes(shape, p, corners, moved, changed)
    k, y, dy, dz = 0, points[Y_MM], points[DY_MM], points[DZ_MM]
    for i in range(y.shape[0]):
        k = face_under(y[i], k, corners)
        slope = slope_across(k, corners)
        share = (y[i] - corners[k, 0]) / (corners[k + 1, 0] - corners[k, 0])
        along = max(abs(dz[i] - slope * dy[i]), MIN_ALONG_MM)
        for j in range(m):
            before = changed[k, j, 1] - slope * changed[k, j, 0]
            behind = changed[k + 1, j, 1] - slope * changed[k + 1, j, 0]
            J[i, j] = ((1.0 - share) * before + share * behind) / (along * sigma[i])
    return J


@kernel
def _add_sandwich(covariance: Float64, filling: Float64, room: Float64, over: float) -> None:
    """Add covariance times filling times covariance, each (m, m), over a number to the covariance."""
    m = covariance.shape[0]
    for i in range(m):
        for j in range(m):
            room[i, j] = 0.0
            for k in range(m):
                room[i, j] += covariance[i, k] * filling[k, j]
    for i in range(m):
        for j in range(m):
            filling[i, j] = 0.0
            for k in range(m):
                filling[i, j] += room[i, k] * covariance[k, j]
    for i in range(m):
        for j in range(m):
            covariance[i, j] += filling[i, j] / over


@kernel(allocates=True)
def add_shared_errors(shape: int, points: Float64, sigma: Float64, fit: ShapeFit) -> None:
    """Add to the covariance (m, m) of a fit what it leaves out of errors that points share.

    `sigma` (n,) px are the centres'. `BESIDE_PX` is the 1 sigma with which a point's
    centre counts among its neighbours. Unexpected light moves centres by 1 sigma `MISFIT_PX`. Two of these
    errors have the correlation exp(-|s - s'| / CORRELATION_PX) of their lines: a sum over all pairs is a
    running sum.
    """
    covariance, chi2, weights = fit.covariance, fit.chi2, fit.weights
    are_common, are_misfit, n, m = False, False, points.shape[1], covariance.shape[0]
    effective, misfit_px, scan = np.empty(n), points[MISFIT_PX], points[SCAN]
    for i in range(n):
        effective[i] = math.sqrt(points[BESIDE_PX, i] ** 2 + SIGMA_FLOOR_PX**2 / points[N_LINES, i])
        are_common |= effective[i] > sigma[i]
        are_misfit |= misfit_px[i] > 0.0
    if not (are_common or are_misfit):
        return
    J = _by_parameters(shape, points, sigma, fit.parameters, m)
    filling, room, before, here = np.zeros((m, m)), np.empty((m, m)), np.zeros(m), np.empty(m)
    if are_common:
        for i in range(n):
            weight = weights[i] * ((effective[i] / sigma[i]) ** 2 - 1.0)
            for j in range(m):
                for k in range(m):
                    filling[j, k] += weight * J[i, j] * J[i, k]
        _add_sandwich(covariance, filling, room, max(1.0, chi2))
    if not are_misfit:
        return
    for j in range(m):
        for k in range(m):
            filling[j, k] = 0.0
    for i in range(n):
        faded = math.exp(-abs(scan[i] - scan[i - 1]) / CORRELATION_PX) if i > 0 else 1.0
        counts = weights[i] > 0.0 and misfit_px[i] > 0.0
        for j in range(m):
            before[j] *= faded
            here[j] = J[i, j] * (weights[i] * misfit_px[i] / sigma[i]) if counts else 0.0
        for j in range(m):
            for k in range(m):
                filling[j, k] += here[j] * here[k] + here[j] * before[k] + before[j] * here[k]
        for j in range(m):
            before[j] += here[j]
    _add_sandwich(covariance, filling, room, max(1.0, chi2) ** 2)

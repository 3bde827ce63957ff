"""What it costs a joint's fit that neighbouring points are off alike: its covariance, not the fit itself.

A fit to points with errors of covariance V, each taken at weight w / sigma^2 as if it were alone, scatters by

    H^-1 (J^T W V W J) H^-1,    H its information, J how the residuals change with the parameters

(the sandwich: Huber 1967, Proc. 5th Berkeley Symp. 1, 221). Where V reaches over few points only, along which
J hardly changes, the sum over a point's neighbours is that of their covariance with it, so V counts as a
diagonal: the variance with which a point counts beside others, in the place of its own.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel
from noise_model.surface.faces import face_under, slope_across
from tracker.joint.section_fit import MIN_ALONG_MM, corners_and_slopes
from tracker.joint.section_shapes import N_CORNERS
from tracker.stripe.line_fit.block import CORRELATION_PX


@kernel(allocates=True)
def _by_parameters(
    shape: int, y: Float64, dy: Float64, dz: Float64, sigma: Float64, p: Float64, m: int
) -> Float64:
    """Return how the residuals of points (n,), in their sigmas, change with the first m parameters, (n, m).

    `y`, `dy`, `dz`, `sigma` (n,) and the parameters `p` are those of a fit of `section_fit`.
    """
    n_corners = N_CORNERS[shape]
    corners, moved = np.empty((n_corners, 2)), np.empty((n_corners, 2))
    changed, J = np.empty((n_corners, m, 2)), np.empty((y.shape[0], m))
    corners_and_slopes(shape, p, corners, moved, changed)
    k = 0
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


@kernel(allocates=True)
def _add_alike(
    J: Float64, sigma: Float64, beside: Float64, weights: Float64, chi2: float, covariance: Float64
) -> None:
    """Add to the covariance (m, m) of a fit what it leaves out of errors that are alike.

    `J` (n, m) is that of `_by_parameters`, `sigma`, `weights` (n,) and `chi2` are the fit's; `beside` (n,) px
    is the 1 sigma with which each point's centre counts beside its neighbours.
    """
    m = covariance.shape[0]
    more = np.zeros((m, m))
    for i in range(J.shape[0]):
        weight = weights[i] * ((beside[i] / sigma[i]) ** 2 - 1.0)
        for j in range(m):
            for other in range(m):
                more[j, other] += weight * J[i, j] * J[i, other]
    covariance += covariance @ more @ covariance / max(1.0, chi2)


@kernel(allocates=True)
def _add_misfit(
    J: Float64,
    scan: Float64,
    sigma: Float64,
    misfit_px: Float64,
    weights: Float64,
    chi2: float,
    covariance: Float64,
) -> None:
    """Add to the covariance (m, m) of a fit what unexpected light does to its points together.

    Two centres' errors, of 1 sigma `misfit_px` (n,), have the correlation exp(-|s - s'| / CORRELATION_PX),
    `scan` (n,) their lines: a sum over all pairs is a running sum. The rest is as `_add_alike` has it.
    """
    m = covariance.shape[0]
    more, before, here = np.zeros((m, m)), np.zeros(m), np.empty(m)
    for i in range(J.shape[0]):
        if i > 0:
            before *= math.exp(-abs(scan[i] - scan[i - 1]) / CORRELATION_PX)
        if not (weights[i] > 0.0 and misfit_px[i] > 0.0):
            continue
        here[:] = J[i]
        here *= weights[i] * misfit_px[i] / sigma[i]
        for j in range(m):
            for other in range(m):
                more[j, other] += here[j] * here[other] + here[j] * before[other] + before[j] * here[other]
        before += here
    covariance += covariance @ more @ covariance / max(1.0, chi2) ** 2


@kernel(allocates=True)
def add_shared_errors(
    shape: int,
    y: Float64,
    dy: Float64,
    dz: Float64,
    scan: Float64,
    sigma: Float64,
    beside: Float64,
    misfit_px: Float64,
    weights: Float64,
    p: Float64,
    chi2: float,
    covariance: Float64,
) -> None:
    """Add to the covariance (m, m) of a fit of `section_fit` what it leaves out of errors that points share.

    `y`, `dy`, `dz`, `sigma`, `weights` (n,), the parameters `p` and `chi2` are the fit's; `scan` (n,) are the
    points' lines. `beside` (n,) px is the 1 sigma with which a point's centre counts beside its neighbours,
    `misfit_px` (n,) that of what unexpected light does to it.
    """
    is_alike, is_misfit = False, False
    for i in range(y.shape[0]):
        is_alike |= beside[i] > sigma[i]
        is_misfit |= misfit_px[i] > 0.0
    if not (is_alike or is_misfit):
        return
    J = _by_parameters(shape, y, dy, dz, sigma, p, covariance.shape[0])
    if is_alike:
        _add_alike(J, sigma, beside, weights, chi2, covariance)
    if is_misfit:
        _add_misfit(J, scan, sigma, misfit_px, weights, chi2, covariance)

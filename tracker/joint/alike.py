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
from tracker.stripe.fit import CORRELATION_PX


@kernel
def _by_parameters(
    on: tuple[float, float, float],
    slope: float,
    share: float,
    k: int,
    changed: Float64,
    J: Float64,
) -> None:
    """Write how a point's residual, in its sigmas, changes with the parameters (m,).

    `on` holds by how much it moves across y and up with its centre, dy and dz, and that centre's sigma; the
    face k has a `slope`, and the point lies at a `share` of it; `changed` are the corners' slopes.
    """
    along = max(abs(on[1] - slope * on[0]), MIN_ALONG_MM)
    for j in range(J.shape[0]):
        before = changed[k, j, 1] - slope * changed[k, j, 0]
        behind = changed[k + 1, j, 1] - slope * changed[k + 1, j, 0]
        J[j] = ((1.0 - share) * before + share * behind) / (along * on[2])


@kernel(allocates=True)
def add_alike(
    shape: int,
    y: Float64,
    dy: Float64,
    dz: Float64,
    sigma: Float64,
    beside: Float64,
    weights: Float64,
    p: Float64,
    chi2: float,
    covariance: Float64,
) -> None:
    """Add to the covariance (m, m) of a fit of `section_fit` what it leaves out of errors that are alike.

    `y`, `dy`, `dz`, `sigma`, `weights` (n,), the parameters `p` and `chi2` are the fit's; `beside` (n,) px is
    the 1 sigma with which each point's centre counts beside its neighbours.
    """
    m, n_corners = covariance.shape[0], N_CORNERS[shape]
    corners, moved = np.empty((n_corners, 2)), np.empty((n_corners, 2))
    changed, J = np.empty((n_corners, m, 2)), np.empty(m)
    corners_and_slopes(shape, p, corners, moved, changed)
    more = np.zeros((m, m))
    k = 0
    for i in range(y.shape[0]):
        k = face_under(y[i], k, corners)
        slope = slope_across(k, corners)
        share = (y[i] - corners[k, 0]) / (corners[k + 1, 0] - corners[k, 0])
        _by_parameters((dy[i], dz[i], sigma[i]), slope, share, k, changed, J)
        weight = weights[i] * ((beside[i] / sigma[i]) ** 2 - 1.0)
        for j in range(m):
            for other in range(m):
                more[j, other] += weight * J[j] * J[other]
    covariance += covariance @ more @ covariance / max(1.0, chi2)


@kernel(allocates=True)
def add_misfit(
    shape: int,
    y: Float64,
    dy: Float64,
    dz: Float64,
    scan: Float64,
    sigma: Float64,
    misfit_px: Float64,
    weights: Float64,
    p: Float64,
    chi2: float,
    covariance: Float64,
) -> None:
    """Add to the covariance (m, m) of a fit what unexpected light does to its points together.

    Two centres' errors, of 1 sigma `misfit_px` (n,), have the correlation exp(-|s - s'| / CORRELATION_PX),
    `scan` (n,) their lines: a sum over all pairs is a running sum. The rest is as `add_alike` has it.
    """
    m, n_corners = covariance.shape[0], N_CORNERS[shape]
    corners, moved = np.empty((n_corners, 2)), np.empty((n_corners, 2))
    changed, J = np.empty((n_corners, m, 2)), np.empty(m)
    corners_and_slopes(shape, p, corners, moved, changed)
    more, before = np.zeros((m, m)), np.zeros(m)
    k = 0
    for i in range(y.shape[0]):
        k = face_under(y[i], k, corners)
        slope = slope_across(k, corners)
        share = (y[i] - corners[k, 0]) / (corners[k + 1, 0] - corners[k, 0])
        _by_parameters((dy[i], dz[i], sigma[i]), slope, share, k, changed, J)
        if i > 0:
            before *= math.exp(-abs(scan[i] - scan[i - 1]) / CORRELATION_PX)
        if not weights[i] > 0.0 or math.isnan(misfit_px[i]):
            continue
        J *= weights[i] * misfit_px[i] / sigma[i]
        for j in range(m):
            for other in range(m):
                more[j, other] += J[j] * J[other] + J[j] * before[other] + before[j] * J[other]
        before += J
    covariance += covariance @ more @ covariance / max(1.0, chi2) ** 2

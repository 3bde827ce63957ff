"""Noise of the corners, from their residuals: one sigma for each image, and the outliers.

An image that is blurred or dark has noisier corners, so each has its own sigma. One image alone determines it
to some 7 % from a hundred corners, so it is shrunk towards the others as far as their scatter warrants
(Smyth, Linear models and empirical Bayes methods, 2004, section 6).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import digamma, polygamma
from scipy.stats import f

from calibration.camera.adjustment import BoardScene, adjust, with_prior
from calibration.camera.normal_equations import scaled_inverse
from calibration.camera.sightings import Sightings
from calibration.outliers import FALSE_ALARM, TAIL
from noise_model.compiled.arrays import Bool, Float64

ROBUST_ROUNDS, NOISE_ROUNDS = 30, 4
SETTLED = 1e-3

MIN_SIGMA_PX = 1e-9
"""Corners without noise occur in tests alone; their weights stay finite."""


@dataclass(frozen=True)
class CornerNoise:
    """Noise of the corners: `sigma_px` (V,) per image and axis.

    `prior_dof` are the degrees of freedom with which all images together state each sigma.
    """

    sigma_px: Float64
    prior_dof: float

    def weight(self, seen: Sightings) -> Float64:
        """Return 1 / sigma of each corner (N,), 1/px."""
        return np.asarray(1.0 / self.sigma_px[seen.view])


def fit_robust(scene: BoardScene, seen: Sightings) -> BoardScene:
    """Return the scene that explains most corners: the maximum likelihood of Student's t.

    Each round weighs a corner by (t + 2) / (t + r²/s²), and takes s from the weighted squares.
    """
    square = np.sum(scene.residuals(seen) ** 2, axis=1)
    scale = max(float(np.median(square)) / (2.0 * math.log(2.0)), MIN_SIGMA_PX**2)
    for _ in range(ROBUST_ROUNDS):
        weight = (TAIL + 2.0) / (TAIL + square / scale)
        scene = adjust(scene, seen, np.sqrt(weight / scale))
        square = np.sum(scene.residuals(seen) ** 2, axis=1)
        before = scale
        scale = max(float(np.mean(weight * square)) / 2.0, MIN_SIGMA_PX**2)
        if abs(scale / before - 1.0) < SETTLED:
            break
    return scene


def robust_noise(scene: BoardScene, seen: Sightings) -> CornerNoise:
    """Return the noise of each image from the median of its squares: some wrong corners hardly move it.

    The squares of a corner's residual are chi² of two degrees of freedom.
    """
    square = np.sum(scene.residuals(seen) ** 2, axis=1) / _free_share(scene, seen)
    medians = np.array([np.median(square[part]) for part in seen.slices]) / (2.0 * math.log(2.0))
    variance, prior_dof = shrink_variances(medians, _median_dof(seen))
    return CornerNoise(np.sqrt(np.maximum(variance, MIN_SIGMA_PX**2)), prior_dof)


def wrong_corners(scene: BoardScene, seen: Sightings) -> Bool:
    """Return the outliers (N,) among corners, at a scene that most corners agree on.

    Squares of residuals over twice the image's variance are F of two degrees of freedom and of those that the
    variance has.
    """
    noise = robust_noise(scene, seen)
    dof = noise.prior_dof + _median_dof(seen)
    limit = 2.0 * f.isf(FALSE_ALARM / len(seen), 2.0, dof) * noise.sigma_px**2
    square = np.sum(scene.residuals(seen) ** 2, axis=1) / _free_share(scene, seen)
    return np.asarray(square > limit[seen.view])


def _free_share(scene: BoardScene, seen: Sightings) -> float:
    """Return the share of the corners' coordinates that the fit does not spend."""
    spent = len(scene.lens.values) + 2 + 6 * len(seen.names)
    return max(1.0 - spent / (2.0 * len(seen)), 0.25)


def _median_dof(seen: Sightings) -> Float64:
    # The variance of the mean of such squares is ln(2)², or 0.48, of that of their median.
    return np.asarray(2.0 * 0.48 * seen.counts, dtype=np.float64)


def fit_scene(
    scene: BoardScene, seen: Sightings, print_sigma_mm: float = 0.0
) -> tuple[BoardScene, CornerNoise]:
    """Return the scene of maximum likelihood and the noise, each image with its own sigma.

    A sum of squares is divided by the corners' coordinates less what the image spends on its pose and on what
    is shared: 2 N_i - 6 - tr(S_i S^-1).
    """
    noise = CornerNoise(np.ones(len(seen.names)), 0.0)
    for _ in range(NOISE_ROUNDS):
        weight = noise.weight(seen)
        scene = adjust(scene, seen, weight, print_sigma_mm=print_sigma_mm)
        equations = with_prior(scene, seen, weight, print_sigma_mm)
        covariance = scaled_inverse(equations.information())
        spent = np.einsum("vij,ji->v", equations.view_information(), covariance)
        free = np.maximum(2.0 * seen.counts - 6.0 - spent, 1.0)
        square = np.sum(scene.residuals(seen) ** 2, axis=1)
        variance = np.array([square[part].sum() for part in seen.slices]) / free
        variance, prior_dof = shrink_variances(variance, free)
        before, noise = noise, CornerNoise(np.sqrt(np.maximum(variance, MIN_SIGMA_PX**2)), prior_dof)
        if np.allclose(noise.sigma_px, before.sigma_px, rtol=SETTLED):
            break
    return adjust(scene, seen, noise.weight(seen), print_sigma_mm=print_sigma_mm), noise


def corner_sigmas_px(scene: BoardScene, seen: Sightings, spent: float = 0.0) -> Float64:
    """Return 1 sigma of a corner in each image (V,), px, where the lens is held.

    Of the coordinates each image spends 6 on its pose, and `spent` on what all share.
    """
    square = np.sum(scene.residuals(seen) ** 2, axis=1)
    free = np.maximum(2.0 * seen.counts - 6.0 - spent, 1.0)
    variance, _ = shrink_variances(np.array([square[part].sum() for part in seen.slices]) / free, free)
    return np.asarray(np.sqrt(np.maximum(variance, MIN_SIGMA_PX**2)))


def shrink_variances(variance: Float64, dof: Float64) -> tuple[Float64, float]:
    """Return variances (V,) shrunk towards each other as far as their scatter warrants, and the prior's d0.

    They are (d0 s0² + d v) / (d0 + d), where v has d degrees of freedom; d0 and s0² follow from mean and
    variance of the log variances. d0 is as good as infinite where the estimates scatter no more than they
    must.
    """
    if len(variance) < 2 or not (variance > 0.0).all():
        return variance, 0.0
    shifted = np.log(variance) - digamma(0.5 * dof) + np.log(0.5 * dof)
    mean = float(shifted.mean())
    excess = float(shifted.var(ddof=1) - polygamma(1, 0.5 * dof).mean())
    max_dof = 1e6
    prior_dof = max_dof
    if excess > float(polygamma(1, 0.5 * max_dof)):
        prior_dof = 2.0 * float(brentq(lambda half: polygamma(1, half) - excess, 1e-3, 0.5 * max_dof))
    prior = math.exp(mean + float(digamma(0.5 * prior_dof)) - math.log(0.5 * prior_dof))
    return np.asarray((prior_dof * prior + dof * variance) / (prior_dof + dof)), prior_dof

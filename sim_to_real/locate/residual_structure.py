"""Where the gap lies: along physical covariates, in patterns of the image, in strata."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from noise_model.arrays import Bool, Float32, Float64, Int64, Integers
from sim_to_real.data.binned import STRATA
from sim_to_real.diagnosis import Curve, Where
from sim_to_real.locate.covariates import UNITS, Covariates
from sim_to_real.locate.spline_term import (
    SPLINE_FOLDS,
    SPLINE_FORMS,
    CrossValidation,
    excess_share,
    folds_by_turn,
    hat_basis,
)

N_GROUPS = 12
"""Groups of equally many bins along a covariate."""

N_BOOTSTRAP, BAND_PERCENT = 300, (2.5, 97.5)
"""Bootstrap draws of frames for a band, and the band's ends, %."""

BOOTSTRAP_SEED = 20240117
"""The seed of these draws."""

IMAGE_FUNCTIONS = (("row", "row"), ("column", "column"), ("radial", "radius"))
"""Patterns in the image that are functions of one covariate."""

MIN_LIGHT_SIGMAS = 5.0
"""A ratio is formed only of light that stands out by so many sigmas."""


def locate(covariates: Covariates, residuals: Float64, stage: str, z: Float32) -> Where:
    """Return where whitened residuals (n,) lie; `stage` and `z` (H, W) are passed on, see `Where`."""
    fit = CrossValidation.of(covariates, residuals)
    curves = [curve_along(name, covariates, residuals, fit) for name in UNITS]
    return Where(
        stage,
        tuple(sorted(curves, key=lambda curve: -curve.r2)),
        image_shares(covariates, residuals, fit),
        strata_gaps(covariates, residuals),
        z,
    )


def strata_gaps(covariates: Covariates, residuals: Float64) -> dict[str, float]:
    """Return sqrt(max(mean r^2 - 1, 0)) of each stratum's frames, of the stripe's band and of the rest.

    NaN for a stratum that the recording does not have.
    """
    chosen = {name: covariates.stratum == n for n, name in enumerate(STRATA)}
    chosen |= {"stripe_band": covariates.in_stripe, "rest": ~covariates.in_stripe}

    def gap(members: Bool) -> float:
        if not members.any():
            return float("nan")
        return math.sqrt(max(float(np.mean(residuals[members] ** 2)) - 1.0, 0.0))

    return {name: gap(members) for name, members in chosen.items()}


def curve_along(name: str, covariates: Covariates, residuals: Float64, fit: CrossValidation) -> Curve:
    """Return the residual along a covariate.

    `r2` is the share of the excess over noise that a function of the covariate explains, on frames that it
    was not fitted to. The function adds DN or multiplies a source's light, whichever explains more. Bands are
    from a bootstrap of whole frames: bins of one frame are not independent.
    """
    group, centers = _groups(covariates.values[name])
    mean, low, high = banded_means(residuals, group, len(centers), covariates.frame)
    log_ratio = _log_ratios(covariates, residuals, group, len(centers))
    r2 = _share_of(fit, name)
    return Curve(name, UNITS[name], r2, centers, mean, low, high, log_ratio)


def _share_of(fit: CrossValidation, name: str) -> float:
    """Return the share of the excess that a function of a covariate explains, in the best of its forms."""
    basis, chosen = hat_basis(fit.covariates.values[name]), fit.covariates
    gained = max(
        fit.gain(basis * (weight(chosen) / chosen.sigma_dn)[:, np.newaxis]) for _, weight in SPLINE_FORMS
    )
    return fit.excess_share(gained)


def _groups(values: Float32) -> tuple[Int64, Float64]:
    """Return each value's group (n,), -1 for NaN, and the groups' median values (g,)."""
    known = np.isfinite(values)
    group = np.full(len(values), -1, dtype=np.int64)
    if not known.any():
        return group, np.empty(0)
    distinct = np.unique(values[known])
    if len(distinct) <= N_GROUPS:
        group[known] = np.searchsorted(distinct, values[known])
        return group, distinct.astype(np.float64)
    edges = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, N_GROUPS + 1)))
    group[known] = np.clip(np.searchsorted(edges, values[known], side="right") - 1, 0, len(edges) - 2)
    # Equal values of many bins may leave a group empty.
    filled, group[known] = np.unique(group[known], return_inverse=True)
    centers = [float(np.median(values[group == g])) for g in range(len(filled))]
    return group, np.array(centers)


def banded_means(
    residuals: Float64, group: Int64, n_groups: int, frame: Integers
) -> tuple[Float64, Float64, Float64]:
    """Return means (g,) of groups and the ends of their 95 % bands, by a bootstrap over frames.

    Kuensch (1989, Annals of Statistics 17(3) 1217-1241), a frame being a block. Group -1 does not count.
    """
    known = group >= 0
    of_frame, position = np.unique(frame[known], return_inverse=True)
    n_frames = len(of_frame)
    place = position * n_groups + group[known]
    size = n_frames * n_groups
    counts = np.bincount(place, minlength=size).reshape(n_frames, n_groups).astype(np.float64)
    sums = np.bincount(place, residuals[known], size).reshape(n_frames, n_groups)
    if n_frames == 0:
        return np.empty(0), np.empty(0), np.empty(0)
    draws = np.random.default_rng(BOOTSTRAP_SEED).multinomial(
        n_frames, np.full(n_frames, 1.0 / n_frames), N_BOOTSTRAP
    )
    drawn = draws @ counts
    # A draw without the frames that see a group says nothing about it.
    means = np.where(drawn > 0.0, draws @ sums / np.maximum(drawn, 1.0), np.nan)
    low, high = np.nanpercentile(means, BAND_PERCENT, axis=0)
    return sums.sum(axis=0) / counts.sum(axis=0), low, high


def _log_ratios(covariates: Covariates, residuals: Float64, group: Int64, n_groups: int) -> Float64:
    """Return the median of ln(recorded / predicted light) in groups (g,), NaN where it is dark."""
    light, noise = covariates.light_dn, covariates.sigma_dn
    # A bin hit by a streak has infinite noise and a residual of 0.
    recorded = light + np.where(np.isfinite(noise), residuals, 0.0) * np.nan_to_num(noise, posinf=0.0)
    clear = (light > MIN_LIGHT_SIGMAS * noise) & (recorded > MIN_LIGHT_SIGMAS * noise)
    log_ratio = np.log(np.where(clear, recorded / np.where(clear, light, 1.0), 1.0))
    medians = np.full(n_groups, np.nan)
    for g in range(n_groups):
        chosen = clear & (group == g)
        if chosen.any():
            medians[g] = np.median(log_ratio[chosen])
    return medians


def image_shares(covariates: Covariates, residuals: Float64, fit: CrossValidation) -> dict[str, float]:
    """Return the shares of the excess that patterns of the image explain, on frames not used to find them.

    `row`, `column` and `radial` are functions of these. `mirrored` is the light at the place mirrored at the
    image's middle, as of a ghost. `fixed` is a number for each bin, the same in all frames, that adds or
    multiplies. `stripe_band` is the share of the excess that lies in the stripe's band.
    """
    shares = {name: _share_of(fit, covariate) for name, covariate in IMAGE_FUNCTIONS}
    ghost = (_mirrored(covariates) / covariates.sigma_dn)[fit.chosen, np.newaxis]
    shares["mirrored"] = fit.excess_share(fit.gain(ghost))
    mean_square = float(np.mean(residuals**2))
    per_dn = 1.0 / covariates.sigma_dn
    fixed = max(_fixed(covariates, residuals, weight) for weight in (per_dn, covariates.light_dn * per_dn))
    shares["fixed"] = excess_share(fixed, mean_square)
    in_band = np.where(covariates.in_stripe, residuals**2 - 1.0, 0.0)
    shares["stripe_band"] = excess_share(float(np.mean(in_band)), mean_square)
    return shares


def _mirrored(covariates: Covariates) -> Float32:
    """Return the predicted light (n,), DN, at the place of each bin mirrored at the image's middle."""
    mirrored = np.empty_like(covariates.light_dn)
    for frame in np.unique(covariates.frame):
        of_frame = covariates.frame == frame
        image = covariates.image(int(frame), covariates.light_dn)
        mirrored[of_frame] = filled(image)[::-1, ::-1].reshape(-1)[covariates.bins[of_frame]]
    return mirrored


def filled(image: Float32) -> Float32:
    """Return an image (h, w) whose NaNs take the nearest value that is none."""
    _, (rows, columns) = distance_transform_edt(np.isnan(image), return_indices=True)
    return np.asarray(image[rows, columns])


def _fixed(covariates: Covariates, residuals: Float64, weight: Float32) -> float:
    """Return by how much a number for each bin, learnt from other frames, lowers the mean square.

    Each number is shrunk with a normal prior for those of all bins (James and Stein). The prior's variance is
    the excess of the training frames' squares over noise.
    """
    n_bins = covariates.shape[0] * covariates.shape[1]
    place = folds_by_turn(covariates) * n_bins + covariates.bins
    size = SPLINE_FOLDS * n_bins
    A = np.bincount(place, weight.astype(np.float64) ** 2, size).reshape(SPLINE_FOLDS, n_bins)
    b = np.bincount(place, weight * residuals, size).reshape(SPLINE_FOLDS, n_bins)
    gained = 0.0
    for k in range(SPLINE_FOLDS):
        train_A, train_b = A.sum(axis=0) - A[k], b.sum(axis=0) - b[k]
        seen = train_A > 0.0
        if not seen.any():
            continue
        excess = float(np.mean(train_b[seen] ** 2 / train_A[seen])) - 1.0
        variance = max(excess, 0.0) / float(np.mean(train_A[seen]))
        numbers = variance * train_b[seen] / (variance * train_A[seen] + 1.0)
        gained += float(np.sum(2.0 * numbers * b[k, seen] - numbers**2 * A[k, seen]))
    return gained / len(residuals)

"""Where the gap lies: along physical covariates, in patterns of the image, in strata."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from noise_model.arrays import Bool, Float32, Float64, Int64, Integers
from sim_to_real.data.binned import STRATA, THIN
from sim_to_real.diagnosis import Curve, Where
from sim_to_real.fit.gauss_newton import MAD_SIGMA
from sim_to_real.locate.covariates import UNITS, Covariates
from sim_to_real.locate.spline_term import FOLDS, FORMS, LEAST_EXCESS, HeldOut, folds_by_turn, hats, share

GROUPS = 12
"""Groups of equally many bins along a covariate."""

RESAMPLED, BAND = 300, (2.5, 97.5)
"""How often frames are drawn anew for a band, and its ends, %."""

SEED = 20240117
"""Of those draws."""

IMAGE_FUNCTIONS = (("row", "row"), ("column", "column"), ("radial", "radius"))
"""Patterns that are functions of one covariate."""

CLEAR = 5.0
"""By how many sigmas light must stand out for a ratio of it to be told."""

SPARK = 5.0
"""Beyond so many robust sigmas a difference between neighbours is a spark's."""

LEAST_PAIRS = 200
"""Of fewer pairs of neighbours nothing is told."""

SMOOTHED_BINS = 3.0
"""1 sigma of the Gaussian that smooths the image of residuals."""


def locate(covariates: Covariates, residuals: Float64, stage: str, z: Float32) -> Where:
    """Return where whitened residuals (n,) lie; `stage` and `z` (H, W) are handed on, see `Where`."""
    fit = HeldOut.of(covariates, residuals)
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
    return {
        name: float(np.sqrt(max(np.mean(residuals[of] ** 2) - 1.0, 0.0))) if of.any() else float("nan")
        for name, of in chosen.items()
    }


def curve_along(name: str, covariates: Covariates, residuals: Float64, fit: HeldOut) -> Curve:
    """Return the residual along a covariate.

    `r2` is the share of the excess over noise that a function of the covariate explains on frames that it was
    not fitted to, be it that it adds DN or that it multiplies a source's light. Bands draw whole frames anew:
    bins of one frame are not independent.
    """
    group, centers = _groups(covariates.values[name])
    mean, low, high = banded_means(residuals, group, len(centers), covariates.frame)
    log_ratio = _log_ratios(covariates, residuals, group, len(centers))
    r2 = _share_of(fit, name)
    return Curve(name, UNITS[name], r2, centers, mean, low, high, log_ratio)


def _share_of(fit: HeldOut, name: str) -> float:
    """Return the share of the excess that a function of a covariate explains, whichever way it acts."""
    basis, of = hats(fit.covariates.values[name]), fit.covariates
    gained = max(fit.gain(basis * (weight(of) / of.sigma_dn)[:, np.newaxis]) for _, weight in FORMS)
    return fit.share(gained)


def _groups(values: Float32) -> tuple[Int64, Float64]:
    """Return each value's group (n,), -1 for NaN, and the groups' median values (g,)."""
    known = np.isfinite(values)
    group = np.full(len(values), -1, dtype=np.int64)
    if not known.any():
        return group, np.empty(0)
    distinct = np.unique(values[known])
    if len(distinct) <= GROUPS:
        group[known] = np.searchsorted(distinct, values[known])
        return group, distinct.astype(np.float64)
    edges = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, GROUPS + 1)))
    group[known] = np.clip(np.searchsorted(edges, values[known], side="right") - 1, 0, len(edges) - 2)
    # Values that many bins share may leave a group empty.
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
    draws = np.random.default_rng(SEED).multinomial(n_frames, np.full(n_frames, 1.0 / n_frames), RESAMPLED)
    drawn = draws @ counts
    # A draw without the frames that see a group says nothing of it.
    means = np.where(drawn > 0.0, draws @ sums / np.maximum(drawn, 1.0), np.nan)
    low, high = np.nanpercentile(means, BAND, axis=0)
    return sums.sum(axis=0) / counts.sum(axis=0), low, high


def _log_ratios(covariates: Covariates, residuals: Float64, group: Int64, n_groups: int) -> Float64:
    """Return the median of ln(recorded / predicted light) in groups (g,), NaN where it is dark."""
    light, noise = covariates.light_dn, covariates.sigma_dn
    # The noise of what a streak hides is infinite, its residual nought.
    recorded = light + np.where(np.isfinite(noise), residuals, 0.0) * np.nan_to_num(noise, posinf=0.0)
    clear = (light > CLEAR * noise) & (recorded > CLEAR * noise)
    log_ratio = np.log(np.where(clear, recorded / np.where(clear, light, 1.0), 1.0))
    medians = np.full(n_groups, np.nan)
    for g in range(n_groups):
        chosen = clear & (group == g)
        if chosen.any():
            medians[g] = np.median(log_ratio[chosen])
    return medians


def image_shares(covariates: Covariates, residuals: Float64, fit: HeldOut) -> dict[str, float]:
    """Return which shares of the excess patterns of the image explain, on frames not used to find them.

    `row`, `column` and `radial` are functions of these; `mirrored` is the light at the place mirrored at the
    image's middle, a ghost; `fixed` a number for each bin, the same in all frames, that adds or multiplies.
    `stripe_band` is the share of the excess that lies in the stripe's band.
    """
    shares = {name: _share_of(fit, of) for name, of in IMAGE_FUNCTIONS}
    ghost = (_mirrored(covariates) / covariates.sigma_dn)[fit.chosen, np.newaxis]
    shares["mirrored"] = fit.share(fit.gain(ghost))
    mean_square = float(np.mean(residuals**2))
    one = 1.0 / covariates.sigma_dn
    fixed = max(_fixed(covariates, residuals, weight) for weight in (one, covariates.light_dn * one))
    shares["fixed"] = share(fixed, mean_square)
    in_band = np.where(covariates.in_stripe, residuals**2 - 1.0, 0.0)
    shares["stripe_band"] = share(float(np.mean(in_band)), mean_square)
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

    Each number is shrunk as if those of all bins were drawn from a normal distribution (James and Stein), its
    variance what the training frames' squares exceed noise by.
    """
    n_bins = covariates.shape[0] * covariates.shape[1]
    place = folds_by_turn(covariates) * n_bins + covariates.bins
    size = FOLDS * n_bins
    A = np.bincount(place, weight.astype(np.float64) ** 2, size).reshape(FOLDS, n_bins)
    b = np.bincount(place, weight * residuals, size).reshape(FOLDS, n_bins)
    gained = 0.0
    for k in range(FOLDS):
        train_A, train_b = A.sum(axis=0) - A[k], b.sum(axis=0) - b[k]
        seen = train_A > 0.0
        if not seen.any():
            continue
        excess = float(np.mean(train_b[seen] ** 2 / train_A[seen])) - 1.0
        variance = max(excess, 0.0) / float(np.mean(train_A[seen]))
        numbers = variance * train_b[seen] / (variance * train_A[seen] + 1.0)
        gained += float(np.sum(2.0 * numbers * b[k, seen] - numbers**2 * A[k, seen]))
    return gained / len(residuals)


def smoothed(covariates: Covariates, residuals: Float64, frames: Bool | None = None) -> Float32:
    """Return the mean residual (h, w) over some frames (n_frames,), smoothed; bins that count are weighed.

    A stripe's bins count as much as the thinned ones about it.
    """
    chosen = np.ones(len(residuals), dtype=bool) if frames is None else frames[covariates.frame]
    weight = np.where(covariates.in_stripe, 1.0 / THIN**2, 1.0)[chosen]
    bins, size = covariates.bins[chosen], covariates.shape[0] * covariates.shape[1]
    total = np.bincount(bins, weight * residuals[chosen], size).reshape(covariates.shape)
    weights = np.bincount(bins, weight, size).reshape(covariates.shape)
    top, bottom = (cv2.GaussianBlur(image, (0, 0), SMOOTHED_BINS) for image in (total, weights))
    return np.asarray(top / np.maximum(bottom, 1e-6), dtype=np.float32)


@dataclass(frozen=True)
class NoiseShares:
    """Which shares of the excess are noise from bin to bin, in the stripe's band and in the rest, and sparks.

    Sparks are differences between neighbours beyond what their spread makes likely.
    """

    rest: float
    stripe_band: float
    sparks: float


def noise_shares(covariates: Covariates, residuals: Float64) -> NoiseShares:
    """Return which shares of the excess neighbours do not have in common.

    Half the mean square of differences between neighbours is noise. Neighbours lie along rows or columns,
    whichever have more in common: off the stripe `THIN` bins apart, else one. 0 where there are too few.
    """
    at_least = LEAST_EXCESS * max(len(residuals), 1)
    excess = max(float(np.sum(residuals**2 - 1.0)), at_least)
    noise, sparks = {False: 0.0, True: 0.0}, 0.0
    for in_stripe, apart in ((False, THIN), (True, 1)):
        differences = [_differences(covariates, residuals, in_stripe, apart, axis) for axis in (0, 1)]
        told = [d for d in differences if len(d) >= LEAST_PAIRS]
        if told:
            count = float(np.sum(covariates.in_stripe == in_stripe))
            d = min(told, key=lambda of_axis: float(np.mean(of_axis**2)))
            usual = SPARK * max(1.0, MAD_SIGMA * float(np.median(np.abs(d))))
            steady = float(np.mean(np.minimum(np.abs(d), usual) ** 2))
            noise[in_stripe] = max(0.0, steady - 1.0) * count / excess
            sparks += (float(np.mean(d**2)) - steady) * count / excess
    return NoiseShares(noise[False], noise[True], sparks)


def _differences(
    covariates: Covariates, residuals: Float64, in_stripe: bool, apart: int, axis: int
) -> Float64:
    """Return differences between neighbours along an axis over sqrt(2), in the stripe's band or the rest."""
    values = np.where(covariates.in_stripe == in_stripe, residuals, np.nan).astype(np.float32)
    found = [np.empty(0, dtype=np.float32)]
    for frame in np.unique(covariates.frame):
        image = covariates.image(int(frame), values)
        ahead = image[apart:] - image[:-apart] if axis == 0 else image[:, apart:] - image[:, :-apart]
        found.append(ahead[np.isfinite(ahead)])
    return np.asarray(np.concatenate(found).astype(np.float64) / np.sqrt(2.0))

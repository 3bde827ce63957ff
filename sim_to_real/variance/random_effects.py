"""What scatters from pixel to pixel and from frame to frame: read noise, fixed pattern, speckle and spatter.

None of them changes what a frame is on average by much. The first three are told by the variances of details
within bins (`details`), the last by lines in single frames (`spatter`). Each is held against its absence: the
evidence for an effect of the catalogue's priors, nats, over that for what the model may be off by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit
from scipy.stats import norm

from noise_model.arrays import Bool, Float64
from noise_model.effects import REGISTRY
from sim_to_real.data.binned import Observed, ObservedFrame
from sim_to_real.fit.gauss_newton import NAMED_FROM, Refit
from sim_to_real.fit.linearized_model import Expected
from sim_to_real.fit.nuisances import WITHIN_SIGMAS
from sim_to_real.variance.haar_details import Details, Sizes, details, pattern, sizes
from sim_to_real.variance.spatter import Spatter, spatter
from sim_to_real.variance.speckle import WHITE_OFF, speckle

VARIANCE_OFF = 0.02
"""1 sigma of what a predicted variance is off, relative: rounding, the response near black."""

LEAST_LIT = 3
"""Frames with a source on that must be there for its random effects to be looked for."""


@dataclass(frozen=True)
class Scatter:
    """The random effects that a recording shows, with their parameters and 1 sigmas.

    `excess` is by how much each adds to the mean of r^2 in all pixels, `sigmas_dn` (n_frames of (n,)) are the
    bins' noise with them; bins hit by a streak have inf.

    Of all random effects that could be looked for, found or not: `evidence` for each over its absence, nats,
    the others being fitted beside it; `confidence` the same as a probability, 1 / (1 + exp(-evidence));
    `closed` the share of the gap that it closes by itself. The gap is here sqrt(mean r^2 - 1) of all pixels
    in the bins that count: what all random effects add and what is left of the bins' means.

    `read_ratio` is the read noise over the stated one as far as its tolerance explains it: 1 if it is named.
    """

    effects: dict[str, dict[str, float]]
    sigmas: dict[str, dict[str, float]]
    excess: dict[str, float]
    sigmas_dn: tuple[Float64, ...]
    evidence: dict[str, float]
    confidence: dict[str, float]
    closed: dict[str, float]
    read_ratio: float = 1.0


@dataclass(frozen=True)
class _Candidate:
    """An effect as it was fitted, with what it adds to the mean of r^2 and to the variance of bins (n,)."""

    id: str
    evidence: float
    values: dict[str, float]
    sigmas: dict[str, float]
    excess: float
    of_bins: Callable[[Details], Float64]


def scatter(expected: Expected, fitted: Refit, without: Sequence[str]) -> Scatter:
    """Return the random effects that a fit's residuals show; `without` takes some out of the catalogue.

    Those that the setup states count as noise, and are not looked for.
    """
    observed = expected.observed
    frames, bin_px = observed.frames, observed.bin_px
    pixels = [details(frame, light, bin_px) for frame, light in zip(frames, fitted.passed, strict=True)]
    streaks = spatter(observed, fitted.passed, sizes(pixels))
    keeps = [frame.keep & ~hit for frame, hit in zip(frames, streaks.hit, strict=True)]
    left = [keep[frame.keep] for frame, keep in zip(frames, keeps, strict=True)]
    quiet = [of.some(use) for of, use in zip(pixels, left, strict=True)]
    fit = sizes(quiet)
    read = _read_ratio(fit, quiet)
    found = [
        _read_noise(*read, fit, quiet, observed),
        *_fixed_pattern(fit, quiet, keeps, observed),
        *_laser_speckle(fit, quiet, observed),
        *_spatter(streaks, observed),
    ]
    stated = set(observed.setup.effects) - {"read_noise"}
    looked = [one for one in found if one.id not in stated and one.id not in without]
    named = [one for one in looked if one.evidence > NAMED_FROM]
    acting = [*named, *(one for one in found if one.id in stated)]
    of_bins = [sum((one.of_bins(of) for one in acting), np.zeros(len(of.stated))) for of in pixels]
    gap = sum(max(one.excess, 0.0) for one in found if one.id not in stated)
    gap += _coherent(observed, fitted, pixels, left, of_bins)
    sigmas_dn = [_with_more(*of) for of in zip(frames, of_bins, strict=True)]
    if any(one.id == "spatter" for one in acting):
        sigmas_dn = [np.where(use, sigma, np.inf) for use, sigma in zip(left, sigmas_dn, strict=True)]
    return Scatter(
        {one.id: one.values for one in named},
        {one.id: one.sigmas for one in named},
        {one.id: one.excess for one in named},
        tuple(sigmas_dn),
        {one.id: one.evidence for one in looked},
        {one.id: float(expit(one.evidence)) for one in looked},
        {one.id: _share(one.excess, gap) for one in looked},
        1.0 if any(one.id == "read_noise" for one in acting) else _within_tolerance(read[0], observed),
    )


def _with_more(frame: ObservedFrame, more_dn2: Float64) -> Float64:
    """Return the noise (n,) of a frame's bins with what scatters, whose variance is `more_dn2` (n,).

    What of it the recording has shown already, and the bins' noise holds, is not added once more.
    """
    return np.hypot(frame.sigma_dn, np.sqrt(np.maximum(more_dn2 - frame.shown_dn2, 0.0)))


def _within_tolerance(ratio: float, observed: Observed) -> float:
    """Return the read noise over the stated one that is seen, as far as its tolerance goes.

    What a predicted variance is off is in what is seen too, and so is right for what is predicted with it.
    """
    reach = WITHIN_SIGMAS * observed.setup.tolerance.read_noise_rel
    return 1.0 + min(max(ratio - 1.0, -reach), reach)


def _share(excess: float, gap: float) -> float:
    """Return which share of sqrt(gap) goes if an excess is taken off it."""
    return 1.0 - math.sqrt(max(1.0 - max(excess, 0.0) / gap, 0.0)) if gap > 0.0 else 0.0


def _coherent(
    observed: Observed,
    fitted: Refit,
    pixels: Sequence[Details],
    left: Sequence[Bool],
    of_bins: Sequence[Float64],
) -> float:
    """Return what is left of the bins' means adds to the mean of r^2 of pixels."""
    parts = []
    for frame, light, of, use, more in zip(
        observed.frames, fitted.passed, pixels, left, of_bins, strict=True
    ):
        noise = of.stated / observed.bin_px**2 + more
        parts.append((((frame.kept_dn - light.mean_dn()) ** 2 - noise) / of.stated)[use])
    return max(float(np.mean(np.concatenate(parts))), 0.0)


def _read_ratio(fit: Sizes, pixels: Sequence[Details]) -> tuple[float, float]:
    """Return the read noise over the stated one as it is seen, and 1 sigma."""
    ratio = math.sqrt(max(1.0 + fit.read, 1e-3))
    # Of its square's sigma half is the ratio's own.
    return ratio, 0.5 / ratio * math.hypot(math.sqrt(fit.covariance[0, 0]), _off(fit, pixels, "read"))


def _read_noise(
    ratio: float, error: float, fit: Sizes, pixels: Sequence[Details], observed: Observed
) -> _Candidate:
    """Return the read noise; it is known within its tolerance, and less than stated is no gap.

    `ratio` is over what the setup states, with an effect that it states already.
    """
    tolerance, more = observed.setup.tolerance.read_noise_rel, ratio - 1.0
    stated = observed.setup.effects.get("read_noise", REGISTRY["read_noise"].neutral)["noise_ratio"]
    return _Candidate(
        "read_noise",
        _over_nought(more, math.hypot(error, tolerance), _prior("read_noise")),
        {"noise_ratio": stated * ratio},
        {"noise_ratio": stated * math.hypot(error, tolerance * ratio)},
        _mean([fit.read * of.read / of.stated for of in pixels]),
        lambda of: max(fit.read, 0.0) * of.read / observed.bin_px**2,
    )


def _fixed_pattern(
    fit: Sizes, pixels: Sequence[Details], keeps: Sequence[Bool], observed: Observed
) -> list[_Candidate]:
    """Return the fixed pattern, if there are frames in which it could come back."""
    if sum(frame.stratum != "dark" for frame in observed.frames) < LEAST_LIT:
        return []
    seen = pattern(pixels, keeps, fit)
    if not math.isfinite(seen.pixels_sigma):
        return []
    of_pixels, of_columns = max(seen.pixels, 0.0), max(seen.columns, 0.0)
    sigma_rel = math.sqrt(of_pixels + of_columns)
    of_square = math.hypot(seen.pixels_sigma, seen.columns_sigma)
    error = 0.5 * of_square / max(sigma_rel, math.sqrt(of_square))
    return [
        _Candidate(
            "fixed_pattern",
            _over_nought(sigma_rel, math.hypot(error, WHITE_OFF), _prior("fixed_pattern")),
            {"sigma_rel": sigma_rel},
            {"sigma_rel": math.hypot(error, VARIANCE_OFF * sigma_rel)},
            _mean([sigma_rel**2 * of.light / of.stated for of in pixels]),
            lambda of: (of_pixels / observed.bin_px**2 + of_columns / observed.bin_px) * of.light,
        )
    ]


def _laser_speckle(fit: Sizes, pixels: Sequence[Details], observed: Observed) -> list[_Candidate]:
    """Return the speckle, if there are frames with the laser on."""
    if sum(bool(frame.in_stripe.any()) for frame in observed.frames) < LEAST_LIT:
        return []
    off = math.hypot(_off(fit, pixels, "laser"), _off_by_pattern(fit, pixels, observed))
    seen = speckle(fit, off, observed.bin_px)
    return [
        _Candidate(
            "laser_speckle",
            seen.evidence,
            {"contrast": seen.contrast, "grain_px": seen.grain_px},
            dict(zip(("contrast", "grain_px"), seen.sigmas, strict=True)),
            _mean([seen.contrast**2 * of.laser / of.stated for of in pixels]),
            lambda of: seen.of_bins * of.laser,
        )
    ]


def _spatter(streaks: Spatter, observed: Observed) -> list[_Candidate]:
    """Return the spatter, if there are frames with the arc on."""
    if observed.lit.sum() < LEAST_LIT:
        return []
    return [
        _Candidate(
            "spatter",
            streaks.evidence,
            streaks.values,
            streaks.sigmas,
            streaks.excess,
            lambda of: np.zeros(len(of.stated)),
        )
    ]


def _off(fit: Sizes, pixels: Sequence[Details], name: str) -> float:
    """Return what a size is off if all variances are off by as much as the fit leaves of them."""
    over = np.concatenate([getattr(of, name) / of.variance(fit, fit.laser_small) for of in pixels])
    return math.hypot(VARIANCE_OFF, fit.off) * float(np.sum(over)) / max(float(np.sum(over**2)), 1e-12)


def _off_by_pattern(fit: Sizes, pixels: Sequence[Details], observed: Observed) -> float:
    """Return what the laser's sizes are off, as all frames have one fixed pattern, and few bins sample it."""
    stripe = np.zeros(observed.frames[0].keep.shape, dtype=bool)
    for frame in observed.frames:
        stripe[frame.keep] |= frame.in_stripe
    variances = [of.variance(fit, fit.laser_small) for of in pixels]
    both, own = (
        sum(
            float(np.sum(getattr(of, name) * of.laser / v**2))
            for of, v in zip(pixels, variances, strict=True)
        )
        for name in ("light", "laser")
    )
    return fit.light * math.sqrt(2.0 / max(int(stripe.sum()), 1)) * both / max(own, 1e-12)


def _over_nought(size: float, error: float, prior_sigma: float) -> float:
    """Return the evidence, nats, for a size that is half-normal before over one of nought.

    int_0^inf N(size; x, error^2) 2 N(x; 0, prior^2) dx = 2 N(size; 0, s^2) Phi(size prior / (error s)), with
    s^2 = error^2 + prior^2, over N(size; 0, error^2).
    """
    s = math.hypot(error, prior_sigma)
    with_it = math.log(2.0) + norm.logpdf(size, 0.0, s) + norm.logcdf(size * prior_sigma / (error * s))
    return float(with_it - norm.logpdf(size, 0.0, error))


def _prior(effect: str) -> float:
    """Return the prior 1 sigma of an effect's first parameter."""
    return REGISTRY[effect].parameters[0].prior_sigma


def _mean(parts: Sequence[Float64]) -> float:
    return float(np.mean(np.concatenate(parts)))

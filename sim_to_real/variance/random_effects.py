"""Random effects, which scatter pixels and frames: read noise, fixed pattern, speckle and spatter.

None of them changes a frame's mean by much. The first three show in the variances of details within bins
(`haar_details`), the last as lines in single frames (`spatter`). The evidence of each is the likelihood of an
effect with the catalogue's priors over that of the model's own error, nats.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import idct
from scipy.special import expit
from scipy.stats import norm

from noise_model.compiled.arrays import Bool, Float64
from noise_model.effects import REGISTRY
from noise_model.effects.compression import BLOCK_PX, compressed_variance, quantisation_steps
from noise_model.stripe import stripe_depth_mm
from noise_model.transforms import transform
from sim_to_real.data.binned import ObservedFrame, ObservedRecording, variances_dn2
from sim_to_real.data.blocks import block_means
from sim_to_real.fit.gauss_newton import Refit
from sim_to_real.fit.linearized_model import LinearizedModel
from sim_to_real.fit.nuisances import WITHIN_SIGMAS
from sim_to_real.variance.compression import Compression, find_compression
from sim_to_real.variance.haar_details import (
    HaarDetails,
    VarianceSizes,
    fit_sizes,
    fixed_pattern,
    haar_details,
)
from sim_to_real.variance.spatter import Spatter, spatter
from sim_to_real.variance.speckle import WHITE_ERROR_REL, fit_speckle

VARIANCE_ERROR_REL = 0.02
"""1 sigma of a predicted variance's relative error: rounding, the response near black."""

MIN_EVIDENCE_NATS = 3.0
"""The evidence over its absence from which on a random effect is named, nats."""

MIN_LIT_FRAMES = 3
"""Least number of frames that show a source for its random effects to be searched."""


@dataclass(frozen=True)
class RandomEffects:
    """The random effects that a recording shows, with their parameters and 1 sigmas.

    `excess` is how much each adds to the mean of r^2 in all pixels, `sigmas_dn` (n_frames of (n,)) are the
    bins' noise with them; bins hit by a streak have inf.

    `evidence`, `confidence` and `closed` are of all random effects that were sought, named or not. The
    evidence of one, nats, is over its absence, with the others fitted too. Its confidence is the
    probability that it is there, 1 / (1 + exp(-evidence)). Several can be there at once. `closed` is the
    share of the gap that it closes by itself: of sqrt(mean r^2 - 1) of all pixels in the bins that count.

    `read_ratio` is the read noise over the stated one, as far as its tolerance allows; 1 if it is named.
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
class _RandomEffect:
    """A fitted random effect, with what it adds to the mean of r^2 and to the variance of bins (n,)."""

    id: str
    evidence: float
    values: dict[str, float]
    sigmas: dict[str, float]
    excess: float
    of_bins: Callable[[HaarDetails], Float64]


def random_effects(model: LinearizedModel, fitted: Refit, without: Sequence[str]) -> RandomEffects:
    """Return the random effects that a fit's residuals show; those in `without` are not sought.

    Those that the setup states count as noise and are not sought either.
    """
    observed = model.observed
    frames, bin_px = observed.frames, observed.bin_px
    pixels = [haar_details(frame, light, bin_px) for frame, light in zip(frames, fitted.lights, strict=True)]
    compression = find_compression([frame.image_dn for frame in frames], observed.setup.sensor)
    is_compressed = compression is not None and compression.evidence > MIN_EVIDENCE_NATS
    bin_dn2 = coded_dn2(compression.quality, bin_px) if compression and is_compressed else 0.0
    streaks = spatter(observed, fitted.lights, fit_sizes(pixels), bin_dn2)
    keeps = [frame.keep & ~hit for frame, hit in zip(frames, streaks.hit, strict=True)]
    masks = [keep[frame.keep] for frame, keep in zip(frames, keeps, strict=True)]
    masked = [details.subset(use) for details, use in zip(pixels, masks, strict=True)]
    fit = fit_sizes(masked)
    read = _read_ratio(fit, masked)
    effects = [
        _read_noise(*read, fit, masked, observed),
        *_fixed_pattern(fit, masked, keeps, observed),
        *_laser_speckle(fit, masked, observed),
        *_spatter(streaks, observed),
        *_image_compression(compression, observed),
    ]
    stated = set(observed.setup.effects) - {"read_noise"}
    candidates = [effect for effect in effects if effect.id not in stated and effect.id not in without]
    named = [effect for effect in candidates if effect.evidence > MIN_EVIDENCE_NATS]
    acting = [*named, *(effect for effect in effects if effect.id in stated)]
    of_bins = [
        sum((effect.of_bins(details) for effect in acting), np.zeros(len(details.stated)))
        for details in pixels
    ]
    gap = sum(max(effect.excess, 0.0) for effect in effects if effect.id not in stated)
    gap += _coherent_excess(observed, fitted, pixels, masks, of_bins)
    sigmas_dn = [_add_variance(frame, more) for frame, more in zip(frames, of_bins, strict=True)]
    if any(effect.id == "spatter" for effect in acting):
        sigmas_dn = [np.where(use, sigma, np.inf) for use, sigma in zip(masks, sigmas_dn, strict=True)]
    return RandomEffects(
        effects={effect.id: effect.values for effect in named},
        sigmas={effect.id: effect.sigmas for effect in named},
        excess={effect.id: effect.excess for effect in named},
        sigmas_dn=tuple(sigmas_dn),
        evidence={effect.id: effect.evidence for effect in candidates},
        confidence={effect.id: float(expit(effect.evidence)) for effect in candidates},
        closed={effect.id: _share(effect.excess, gap) for effect in candidates},
        read_ratio=1.0
        if any(effect.id == "read_noise" for effect in acting)
        else _limit_to_tolerance(read[0], observed),
    )


def _add_variance(frame: ObservedFrame, more_dn2: Float64) -> Float64:
    """Return the noise (n,) of a frame's bins with random effects, whose variance is `more_dn2` (n,).

    The part that is in the bins' noise already is not added again.
    """
    return np.hypot(frame.sigma_dn, np.sqrt(np.maximum(more_dn2 - frame.shown_dn2, 0.0)))


def _limit_to_tolerance(ratio: float, observed: ObservedRecording) -> float:
    """Return the seen read noise over the stated one, limited to its tolerance.

    The seen one includes the error of predicted variances, so predictions with it have the right variance.
    """
    reach = WITHIN_SIGMAS * observed.setup.tolerance.read_noise_rel
    return 1.0 + min(max(ratio - 1.0, -reach), reach)


def _share(excess: float, gap: float) -> float:
    """Return the share of sqrt(gap) that goes if an excess is subtracted from the gap."""
    return 1.0 - math.sqrt(max(1.0 - max(excess, 0.0) / gap, 0.0)) if gap > 0.0 else 0.0


def _coherent_excess(
    observed: ObservedRecording,
    fitted: Refit,
    pixels: Sequence[HaarDetails],
    masks: Sequence[Bool],
    of_bins: Sequence[Float64],
) -> float:
    """Return the contribution of the bins' mean residuals to the pixels' mean of r^2."""
    parts = []
    for frame, light, details, use, more in zip(
        observed.frames, fitted.lights, pixels, masks, of_bins, strict=True
    ):
        noise = details.stated / observed.bin_px**2 + more
        parts.append((((frame.kept_dn - light.mean_dn()) ** 2 - noise) / details.stated)[use])
    return max(float(np.mean(np.concatenate(parts))), 0.0)


def _read_ratio(fit: VarianceSizes, pixels: Sequence[HaarDetails]) -> tuple[float, float]:
    """Return the seen read noise over the stated one, and its 1 sigma."""
    ratio = math.sqrt(max(1.0 + fit.read, 1e-3))
    # The sigma of a square is 2 ratio times the ratio's own.
    error = _size_error(fit, pixels, "read", fit.laser_small)
    return ratio, 0.5 / ratio * math.hypot(math.sqrt(fit.covariance[0, 0]), error)


def _read_noise(
    ratio: float, error: float, fit: VarianceSizes, pixels: Sequence[HaarDetails], observed: ObservedRecording
) -> _RandomEffect:
    """Return the read noise; it is known within its tolerance, and less than stated is no gap.

    `ratio` is over what the setup states, a read_noise effect included.
    """
    tolerance, more = observed.setup.tolerance.read_noise_rel, ratio - 1.0
    stated = observed.setup.effects.get("read_noise", REGISTRY["read_noise"].neutral)["noise_ratio"]
    return _RandomEffect(
        "read_noise",
        evidence_over_zero(more, math.hypot(error, tolerance), _prior("read_noise")),
        {"noise_ratio": stated * ratio},
        {"noise_ratio": stated * math.hypot(error, tolerance * ratio)},
        _mean([fit.read * details.read / details.stated for details in pixels]),
        lambda details: max(fit.read, 0.0) * details.read / observed.bin_px**2,
    )


def _fixed_pattern(
    fit: VarianceSizes, pixels: Sequence[HaarDetails], keeps: Sequence[Bool], observed: ObservedRecording
) -> list[_RandomEffect]:
    """Return the fixed pattern, if there are enough frames in which it could recur."""
    if sum(frame.stratum != "dark" for frame in observed.frames) < MIN_LIT_FRAMES:
        return []
    seen = fixed_pattern(pixels, keeps, fit, _places(observed))
    if not math.isfinite(seen.pixels_sigma):
        return []
    of_pixels, of_columns = max(seen.pixels, 0.0), max(seen.columns, 0.0)
    sigma_rel = math.sqrt(of_pixels + of_columns)
    of_square = math.hypot(seen.pixels_sigma, seen.columns_sigma)
    error = 0.5 * of_square / max(sigma_rel, math.sqrt(of_square))
    return [
        _RandomEffect(
            "fixed_pattern",
            evidence_over_zero(sigma_rel, math.hypot(error, WHITE_ERROR_REL), _prior("fixed_pattern")),
            {"sigma_rel": sigma_rel},
            {"sigma_rel": math.hypot(error, VARIANCE_ERROR_REL * sigma_rel)},
            _mean([sigma_rel**2 * details.light / details.stated for details in pixels]),
            lambda details: (of_pixels / observed.bin_px**2 + of_columns / observed.bin_px) * details.light,
        )
    ]


def _places(observed: ObservedRecording) -> list[int]:
    """Return the numbers (n_frames,) of the places on the part that frames show; equal within a pixel."""
    setup = observed.setup
    first: list[Float64] = []
    pixel_mm = abs(stripe_depth_mm(setup)) / setup.camera.fx
    places: list[int] = []
    for frame in observed.frames:
        corners = transform(frame.T_base_tool_in(setup), np.eye(3) * setup.laser.origin_in_tool_mm[2])
        moved_mm = [float(np.max(np.linalg.norm(corners - other, axis=1))) for other in first]
        near = [n for n, by in enumerate(moved_mm) if by < pixel_mm]
        if not near:
            first.append(corners)
        places.append(near[0] if near else len(first) - 1)
    return places


def _laser_speckle(
    fit: VarianceSizes, pixels: Sequence[HaarDetails], observed: ObservedRecording
) -> list[_RandomEffect]:
    """Return the speckle, if there are enough frames with the laser on."""
    if sum(bool(frame.in_stripe.any()) for frame in observed.frames) < MIN_LIT_FRAMES:
        return []
    of_pattern = _pattern_error(fit, pixels, observed)
    with_it, without = (
        math.hypot(_size_error(fit, pixels, "laser", size), of_pattern) for size in (fit.laser_small, 0.0)
    )
    seen = fit_speckle(fit, with_it, without, observed.bin_px)
    return [
        _RandomEffect(
            "laser_speckle",
            seen.evidence,
            {"contrast": seen.contrast, "grain_px": seen.grain_px},
            dict(zip(("contrast", "grain_px"), seen.sigmas, strict=True)),
            _mean([seen.contrast**2 * details.laser / details.stated for details in pixels]),
            lambda details: seen.bin_variance_rel * details.laser,
        )
    ]


def _spatter(streaks: Spatter, observed: ObservedRecording) -> list[_RandomEffect]:
    """Return the spatter, if there are enough frames with the arc on."""
    if observed.lit.sum() < MIN_LIT_FRAMES:
        return []
    return [
        _RandomEffect(
            "spatter",
            streaks.evidence,
            streaks.values,
            streaks.sigmas,
            streaks.excess,
            lambda details: np.zeros(len(details.stated)),
        )
    ]


def _image_compression(seen: Compression | None, observed: ObservedRecording) -> list[_RandomEffect]:
    """Return the compression that the frames' codes show, if they show enough."""
    if seen is None:
        return []
    # Where codes show none, none scatters.
    is_seen = seen.evidence > MIN_EVIDENCE_NATS
    excess = 0.0
    if is_seen:
        excess = _mean([_compressed_excess(frame, observed, seen.quality) for frame in observed.frames])
    bin_dn2 = coded_dn2(seen.quality, observed.bin_px)
    return [
        _RandomEffect(
            "image_compression",
            seen.evidence,
            {"quality": seen.quality},
            {"quality": seen.sigma},
            excess,
            lambda details: np.full(len(details.stated), bin_dn2),
        )
    ]


def coded_dn2(quality: float, bin_px: int) -> float:
    """Return the variance, DN^2, that compression adds to the mean of a bin.

    Rounding leaves step^2 / 12 of each wave of a block, of which a bin's mean keeps a share.
    """
    pixels = np.arange(math.lcm(BLOCK_PX, bin_px))
    waves = idct(np.eye(BLOCK_PX), norm="ortho", axis=1)[:, pixels % BLOCK_PX]
    means = np.zeros((len(pixels) // bin_px, len(pixels) // BLOCK_PX, BLOCK_PX))
    np.add.at(means, (pixels // bin_px, pixels // BLOCK_PX), waves.T / bin_px)
    kept = np.sum(means**2, axis=1).mean(axis=0)
    return float(kept @ quantisation_steps(quality) ** 2 @ kept) / 12.0


def _compressed_excess(frame: ObservedFrame, observed: ObservedRecording, quality: float) -> Float64:
    """Return the contribution (n,) of compression to r^2 of the pixels in a frame's bins that count."""
    image_dn, sensor = frame.image_dn.astype(np.float64), observed.setup.sensor
    stated_dn2, _ = variances_dn2(image_dn, observed.setup)
    compressed_dn2 = compressed_variance(image_dn, stated_dn2, sensor, quality)
    return block_means(compressed_dn2 / stated_dn2 - 1.0, observed.bin_px)[frame.keep]


def _size_error(fit: VarianceSizes, pixels: Sequence[HaarDetails], name: str, of_laser: float) -> float:
    """Return a size's error if all variances have the relative error that the fit leaves.

    `of_laser` is the size that goes with the laser's light: without speckle none of its variance is there.
    """
    ratios = [getattr(details, name) / details.variance(fit, of_laser) for details in pixels]
    over = np.concatenate(ratios)
    error_rel = math.hypot(VARIANCE_ERROR_REL, fit.error_rel)
    return error_rel * float(np.sum(over)) / max(float(np.sum(over**2)), 1e-12)


def _pattern_error(fit: VarianceSizes, pixels: Sequence[HaarDetails], observed: ObservedRecording) -> float:
    """Return the error of the laser's sizes by the fixed pattern, which few bins sample."""
    stripe = np.zeros(observed.frames[0].keep.shape, dtype=bool)
    for frame in observed.frames:
        stripe[frame.keep] |= frame.in_stripe
    variances = [details.variance(fit, fit.laser_small) for details in pixels]
    both, own = (
        sum(
            float(np.sum(getattr(details, name) * details.laser / v**2))
            for details, v in zip(pixels, variances, strict=True)
        )
        for name in ("light", "laser")
    )
    return fit.light * math.sqrt(2.0 / max(int(stripe.sum()), 1)) * both / max(own, 1e-12)


def evidence_over_zero(size: float, error: float, prior_sigma: float) -> float:
    """Return the evidence, nats, of a size with a half-normal prior over a size of 0.

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

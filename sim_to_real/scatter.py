"""What scatters from pixel to pixel: noise, fixed pattern, speckle and spatter, by variances and outliers.

Two statistics of a frame are blind to what the model says of its mean, as long as that is smooth. Within a
bin, the diagonal detail of 2 x 2 pixels, d = (a - b - c + d) / 2, has the variance of a pixel. Between three
neighbouring bins of the stripe's band the second difference of what is left of their means, over sqrt(6), has
that of a bin's mean. Both are the predicted variance plus a sum of the effects' own,

    v + (rho^2 - 1) s_read^2 + s_rel^2 light^2 + C^2 h light_laser^2,

fitted with non-negative sizes. A fixed pattern is told from fresh noise by what comes back at the same pixel
in other frames. h is what speckle of a grain leaves of its variance in either statistic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.optimize import nnls

from noise_model.frames import Float64
from noise_model.sensor import respond_moments
from sim_to_real.expected import CHARGE_STEP_E, Expected, Passed
from sim_to_real.observed import Bool, Float32, ObservedFrame
from sim_to_real.refit import Refit

CAP = 5.0
"""Details beyond so many sigmas are cut: a streak is not noise."""

READ_WITHIN = 5.0
"""Of its tolerance the read noise may be off so many times without being an effect."""

LEAST_EXCESS = 0.1
"""An effect is there if it adds this share of the predicted variance where it acts."""

LEAST_SPECKLE = 8e-4
"""And the square of what it adds to a bin, over the laser's light: below lies what the model may be off."""

SMOOTH_FROM = 2.0
"""If bins twice as far apart differ by so many times the variance, what is left is smooth."""

LARGEST_GRAIN, LIGHTS_OWN = 0.1, 0.01
"""Relative variances of the laser's light: beyond which differences are cut, and which all bins have."""

SPECKLE_SIGMAS = 0.05, 0.2
"""1 sigma of speckle's contrast and grain, relative: its two statistics are no sharper than its form."""

LEAST_VARIANCE = 0.25
"""A bin's noise is not taken for less than this share of what was predicted."""

LEAST_FIXED = 0.5
"""Of the variance that goes with the light this share must come back at its pixels to be a pattern."""

GRAINS_PX = np.geomspace(0.3, 6.0, 40)
"""Speckle grains that are tried."""

OUTLYING, UNUSUAL = 8.0, 2.5
"""A bin is a streak's if it stands out by so many spreads in its frame, and elsewhere by less than these."""

LEAST_STREAKS = 3
"""From so many streaks on there is spatter."""


@dataclass(frozen=True)
class Scatter:
    """The random effects that a recording shows, with their parameters and 1 sigmas.

    `excess` is by how much each adds to the mean of r^2 in all pixels, `sigmas_dn` (n_frames of (n,)) are the
    bins' noise with them; bins hit by a streak have inf.
    """

    effects: dict[str, dict[str, float]]
    sigmas: dict[str, dict[str, float]]
    excess: dict[str, float]
    sigmas_dn: tuple[Float64, ...]


@dataclass(frozen=True)
class _Frame:
    """A frame's bins (n,), DN^2: measured and predicted variance of a pixel, and what effects would add."""

    measured: Float64
    predicted: Float64
    read: Float64
    light: Float64
    laser: Float64
    details: Float64
    light_dn: Float64


def scatter(expected: Expected, fitted: Refit, without: Sequence[str]) -> Scatter:
    """Return the random effects that a fit's residuals show; `without` takes some out of the catalogue."""
    frames, bin_px = expected.observed.frames, expected.observed.bin_px
    seen = [_frame(*of, bin_px) for of in zip(frames, fitted.passed, strict=True)]
    read, light, laser, error = _sizes(seen)
    found = [
        _read_noise(read, error[0], seen, expected.observed.setup.tolerance.read_noise_rel),
        _fixed_pattern(light, error[1], seen, _comes_back(seen, frames)),
        _laser_speckle(laser, _laser_between_bins(expected, fitted, seen, read, light), seen, frames, bin_px),
    ]
    kept = [one for one in found if one is not None and one.id not in without]
    sigmas_dn = []
    for n, frame in enumerate(frames):
        variance = frame.sigma_dn**2 + sum(one.of_bins(seen[n], bin_px) for one in kept)
        sigmas_dn.append(np.sqrt(np.maximum(variance, LEAST_VARIANCE * frame.sigma_dn**2)))
    streaks = None if "spatter" in without else _streaks(expected, fitted)
    if streaks is not None:
        kept.append(streaks.found)
        sigmas_dn = [np.where(hit, np.inf, s) for s, hit in zip(sigmas_dn, streaks.hit, strict=True)]
    return Scatter(
        {one.id: one.values for one in kept},
        {one.id: one.sigmas for one in kept},
        {one.id: one.excess for one in kept},
        tuple(sigmas_dn),
    )


@dataclass(frozen=True)
class _Found:
    """An effect with its parameters, what it adds to the mean of r^2, and to the variance of bins."""

    id: str
    values: dict[str, float]
    sigmas: dict[str, float]
    excess: float
    of_bins: Callable[[_Frame, int], Float64]


def _read_noise(size: float, error: float, seen: Sequence[_Frame], tolerance: float) -> _Found | None:
    # Less noise than stated is no gap: where a response is flat, there is less.
    ratio = math.sqrt(1.0 + max(size, 0.0))
    excess = _mean([size * of.read / of.predicted for of in seen])
    if ratio - 1.0 < READ_WITHIN * tolerance or excess < LEAST_EXCESS:
        return None
    sigma = 0.5 * error / ratio
    return _Found(
        "read_noise",
        {"noise_ratio": ratio},
        {"noise_ratio": sigma},
        excess,
        lambda of, bin_px: size * of.read / bin_px**2,
    )


def _fixed_pattern(size: float, error: float, seen: Sequence[_Frame], comes_back: float) -> _Found | None:
    excess = _mean([size * of.light / of.predicted for of in seen])
    if excess < LEAST_EXCESS or comes_back < LEAST_FIXED * size:
        return None
    sigma_rel = math.sqrt(size)
    return _Found(
        "fixed_pattern",
        {"sigma_rel": sigma_rel},
        {"sigma_rel": 0.5 * error / sigma_rel},
        excess,
        lambda of, bin_px: size * of.light / bin_px**2,
    )


def _laser_speckle(
    within: float, between: float, seen: Sequence[_Frame], frames: Sequence[ObservedFrame], bin_px: int
) -> _Found | None:
    if not any(frame.in_stripe.any() for frame in frames) or between < LEAST_SPECKLE:
        return None
    in_stripe = [
        of.laser[f.in_stripe] / of.predicted[f.in_stripe] for of, f in zip(seen, frames, strict=True)
    ]
    if _mean([between * bin_px**2 * of for of in in_stripe]) < LEAST_EXCESS:
        return None
    contrast, grain_px = _speckle(within, between, bin_px)
    return _Found(
        "laser_speckle",
        {"contrast": contrast, "grain_px": grain_px},
        {"contrast": SPECKLE_SIGMAS[0] * contrast, "grain_px": SPECKLE_SIGMAS[1] * grain_px},
        _mean([contrast**2 * of.laser / of.predicted for of in seen]),
        lambda of, bin_px: between * of.laser,
    )


def _mean(parts: Sequence[Float64]) -> float:
    return float(np.mean(np.concatenate(parts)))


def _frame(frame: ObservedFrame, light: Passed, bin_px: int) -> _Frame:
    """Return the variances of a frame's bins that count."""
    mean_e = (light.arc_e + light.laser_e + light.other_e).astype(np.float64)
    noise_e2 = np.maximum(mean_e, 0.0) + light.sensor.read_noise_e**2
    at_dn, predicted = respond_moments(mean_e, noise_e2, light.sensor)
    above, _ = respond_moments(mean_e + CHARGE_STEP_E, noise_e2, light.sensor)
    dn_per_e = (above - at_dn) / CHARGE_STEP_E
    details = _details(frame.image_dn, bin_px)[frame.keep]
    capped = np.clip(
        details, -CAP * np.sqrt(predicted)[:, np.newaxis], CAP * np.sqrt(predicted)[:, np.newaxis]
    )
    return _Frame(
        np.mean(capped**2, axis=1),
        predicted,
        (dn_per_e * light.sensor.read_noise_e) ** 2,
        (dn_per_e * mean_e) ** 2,
        (dn_per_e * light.laser_e) ** 2,
        capped.astype(np.float64),
        np.asarray(dn_per_e * mean_e),
    )


def _details(image_dn: np.ndarray, bin_px: int) -> Float32:
    """Return the diagonal details (h, w, m) of the 2 x 2 pixels within each bin."""
    image = image_dn.astype(np.float32)
    height, width = image.shape[0] // bin_px, image.shape[1] // bin_px
    pairs = bin_px // 2
    cut = image[: height * bin_px, : width * bin_px].reshape(height, bin_px, width, bin_px)
    cut = cut[:, : 2 * pairs, :, : 2 * pairs].reshape(height, pairs, 2, width, pairs, 2)
    detail = 0.5 * (
        cut[:, :, 0, :, :, 0] - cut[:, :, 0, :, :, 1] - cut[:, :, 1, :, :, 0] + cut[:, :, 1, :, :, 1]
    )
    return np.ascontiguousarray(detail.transpose(0, 2, 1, 3)).reshape(height, width, pairs * pairs)


def _sizes(seen: Sequence[_Frame]) -> tuple[float, float, float, Float64]:
    """Return rho^2 - 1, s_rel^2 and C^2 h within bins, and the 1 sigmas (3,)."""
    predicted = np.concatenate([f.predicted for f in seen])
    weight = 1.0 / predicted
    columns = np.column_stack(
        [np.concatenate([getattr(f, name) for f in seen]) * weight for name in ("read", "light", "laser")]
    )
    excess = np.concatenate([f.measured for f in seen]) * weight - 1.0
    scale = np.maximum(np.sqrt(np.sum(columns**2, axis=0)), 1e-12)
    # The read noise may be less than stated, down to none: its size counts from there.
    sizes, _ = nnls(columns / scale, excess + columns[:, 0])
    n_details = seen[0].details.shape[1] if len(seen) else 1
    spread = math.sqrt(2.0 / n_details)
    sigma = spread * np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns)))
    read, light, laser = sizes / scale
    return float(read - 1.0), float(light), float(laser), sigma


def _comes_back(seen: Sequence[_Frame], frames: Sequence[ObservedFrame]) -> float:
    """Return the relative variance of gains that stay with their pixels."""
    shape = frames[0].keep.shape
    n_details = seen[0].details.shape[1]
    first, squares = np.zeros((*shape, n_details)), np.zeros((*shape, n_details))
    light, light_squares = np.zeros(shape), np.zeros(shape)
    for frame, of in zip(frames, seen, strict=True):
        weighted = of.details * (of.light_dn / of.predicted)[:, np.newaxis]
        first[frame.keep] += weighted
        squares[frame.keep] += weighted**2
        light[frame.keep] += of.light_dn**2 / of.predicted
        light_squares[frame.keep] += (of.light_dn**2 / of.predicted) ** 2
    # Products of different frames only: their noise does not come back.
    over = float(np.sum(first**2 - squares))
    under = n_details * float(np.sum(light**2 - light_squares))
    return max(over / under, 0.0) if under > 0.0 else 0.0


def _laser_between_bins(
    expected: Expected, fitted: Refit, seen: Sequence[_Frame], read: float, gain: float
) -> float:
    """Return what the laser's square adds to the variance of a bin's mean; 0 if what is left is no grain.

    `read` and `gain` are the sizes of what scatters besides. Of grains, bins twice as far apart differ as
    much; of what a wrong mean leaves they differ more.
    """
    n_pixels = expected.observed.bin_px**2
    over, under = np.zeros(2), np.zeros(2)
    for frame, light, of in zip(expected.observed.frames, fitted.passed, seen, strict=True):
        if frame.condition.laser_level == 0.0 or not frame.in_stripe.any():
            continue
        left_dn = np.full(frame.keep.shape, np.nan)
        left_dn[frame.keep] = np.where(frame.in_stripe, frame.kept_dn - light.mean_dn(), np.nan)
        variance, laser = np.zeros(frame.keep.shape), np.zeros(frame.keep.shape)
        of_pixel = of.predicted + max(read, 0.0) * of.read + gain * of.light
        variance[frame.keep], laser[frame.keep] = of_pixel / n_pixels, of.laser
        for n, apart in enumerate((1, 2)):
            middle = slice(apart, -apart)
            change = left_dn[:, : -2 * apart] - 2.0 * left_dn[:, middle] + left_dn[:, 2 * apart :]
            good = np.isfinite(change)
            v, template = variance[:, middle][good], laser[:, middle][good]
            most = CAP * np.sqrt(v + LARGEST_GRAIN * template)
            square = np.clip(change[good] / math.sqrt(6.0), -most, most) ** 2
            # Bins in full light do not count more than they know.
            weight = template / (v + LIGHTS_OWN * template) ** 2
            over[n] += float(np.sum(weight * (square - v)))
            under[n] += float(np.sum(weight * template))
    if not (under > 0.0).all() or over[0] <= 0.0:
        return 0.0
    near, far = over / under
    return float(near) if far < SMOOTH_FROM * near else 0.0


def left_of_grain(grain_px: float, bin_px: int) -> tuple[float, float]:
    """Return what speckle of a grain leaves of its variance in a pixel's detail and between bins.

    White noise behind a Gaussian of 1 sigma g is correlated as exp(-x^2 / 4 g^2).
    """

    def correlation(apart_px: Float64) -> Float64:
        return np.asarray(np.exp(-(apart_px**2) / (4.0 * grain_px**2)))

    detail = (1.0 - float(correlation(np.array(1.0)))) ** 2
    at = np.arange(bin_px, dtype=np.float64)
    between = [float(correlation(at[:, None] - at[None, :] + n * bin_px).mean()) for n in range(3)]
    return detail, between[0] * (6.0 * between[0] - 8.0 * between[1] + 2.0 * between[2]) / 6.0


def _speckle(within: float, between: float, bin_px: int) -> tuple[float, float]:
    """Return contrast and grain, px, whose variance within and between bins comes nearest."""
    left = np.array([left_of_grain(grain, bin_px) for grain in GRAINS_PX])
    ratio = np.log(np.maximum(left[:, 0], 1e-6) / left[:, 1])
    best = int(np.argmin(np.abs(ratio - math.log(max(within, 1e-6) / between))))
    return math.sqrt(between / float(left[best, 1])), float(GRAINS_PX[best])


@dataclass(frozen=True)
class _Streaks:
    found: _Found
    hit: tuple[Bool, ...]


def _streaks(expected: Expected, fitted: Refit) -> _Streaks | None:
    """Return the streaks that stand out of single frames; None if there are hardly any."""
    frames = expected.observed.frames
    shape = frames[0].keep.shape
    ends = np.cumsum(fitted.quadratic.counts)
    images = np.full((len(frames), *shape), np.nan)
    for n, (frame, end) in enumerate(zip(frames, ends, strict=True)):
        images[n][frame.keep] = fitted.residuals[end - len(frame.sigma_dn) : end]
    spread = np.array([max(1.0, 1.4826 * float(np.nanmedian(np.abs(image)))) for image in images])
    images /= spread[:, np.newaxis, np.newaxis]
    lit = np.array([frame.condition.arc_level > 0.0 for frame in frames])
    if lit.sum() < 3:
        return None
    outlying = images > OUTLYING
    usual = np.sum(np.abs(images) > UNUSUAL, axis=0) <= np.maximum(
        1, 0.2 * np.sum(np.isfinite(images), axis=0)
    )
    streak = outlying & usual & lit[:, np.newaxis, np.newaxis]
    around = np.ones((3, 3), dtype=int)
    # Kept bins lie apart from each other off the stripe: neighbours of the lattice belong together.
    counts = [int(label(_grown(image), around)[1]) for image in streak]
    total = sum(counts)
    others = int((outlying & ~streak).sum()) + int(((images < -OUTLYING) & usual).sum())
    if total < LEAST_STREAKS or others > streak.sum():
        return None
    bin_px, gain = expected.observed.bin_px, expected.observed.setup.sensor.gain_e_per_dn
    sizes = [_extent(_grown(image)) for image in streak if image.any()]
    peak_dn = np.concatenate(
        [
            (frame.kept_dn - light.mean_dn())[image[frame.keep]]
            for frame, light, image in zip(frames, fitted.passed, streak, strict=True)
        ]
    )
    hit = tuple(_grown(image)[frame.keep] for frame, image in zip(frames, streak, strict=True))
    residual = [r[h] for r, h in zip(np.split(fitted.residuals, ends[:-1]), hit, strict=True)]
    values = {
        "rate_per_frame": total / int(lit.sum()),
        "peak_e": float(np.mean(peak_dn)) * gain,
        "length_px": float(np.median(np.concatenate(sizes))) * bin_px,
    }
    found = _Found(
        "spatter",
        values,
        {name: value / math.sqrt(total) for name, value in values.items()},
        sum(float(np.sum(r**2)) for r in residual) / len(fitted.residuals),
        lambda of, bin_px: np.zeros(len(of.predicted)),
    )
    return _Streaks(found, hit)


def _grown(image: Bool) -> Bool:
    """Return bins (h, w) within a lattice's step of those given."""
    return np.asarray(binary_dilation(image, np.ones((5, 5), dtype=bool)))


def _extent(image: Bool) -> Float64:
    """Return the lengths (n,), bins, of an image's patches."""
    patches, count = label(image)
    lengths = []
    for n in range(1, count + 1):
        rows, columns = np.nonzero(patches == n)
        lengths.append(max(math.hypot(np.ptp(rows), np.ptp(columns)) - 3.0, 1.0))
    return np.array(lengths)

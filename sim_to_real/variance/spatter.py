"""Spatter's parameters from the streaks that were found: how often, how bright, how long, how wide.

A streak's moments give its length and width: along it the variance is l^2 / 12 + w^2, across it w^2, and the
point-spread function adds to both. Its integral is l w sqrt(2 pi) times its peak. Streaks fainter than a
limit are not found. Peaks are taken to be exponential: those found exceed their limits by `peak_e` on
average, which gives the share that is missed. A streak that is cut, by the rim or by bins that are not
searched, counts by the share of its length that is seen.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import gammaln, xlogy

from noise_model.compiled.arrays import Bool, Float32, Float64
from noise_model.effects import REGISTRY
from noise_model.instrument.sensor import Sensor, electrons_per_dn, linearise, saturation_dn
from noise_model.robust import sigma_of, spread
from sim_to_real.data.binned import ObservedRecording
from sim_to_real.data.blocks import dilate, in_blocks
from sim_to_real.fit.frame_light import FrameLight
from sim_to_real.variance.haar_details import VarianceSizes
from sim_to_real.variance.streaks import LineSearch, StreakLine, search_lines, transient_lines

CLUTTER_FRAMES = 30.0
"""Prior of lines that are no streaks: fewer than one in this number of frames."""

PARAMETERS = {parameter.name: parameter for parameter in REGISTRY["spatter"].parameters}
"""The catalogue's parameters of spatter."""

DILATION_BINS = 3
"""The side of the square by which a line's bins are dilated."""


@dataclass(frozen=True, eq=False)
class Spatter:
    """Streaks in single frames, and the parameters of spatter.

    `evidence` is that for spatter, nats. `values` and `sigmas` are of its parameters, empty if there is no
    streak. `hit` (h, w) are the bins of each frame that streaks reach. `excess` is what streaks add to the
    mean of r^2.
    """

    evidence: float
    values: dict[str, float]
    sigmas: dict[str, float]
    hit: tuple[Bool, ...]
    excess: float


@dataclass(frozen=True)
class Streak:
    """A line measured in its pixels.

    `seen_px2` is the variance across it, `charge_e` its integral, e- of the nominal exposure; `room_e` is the
    charge that saturates a pixel there. It `is_whole` if neither the rim nor the model's own lines cut it,
    and `is_full` if it saturates.
    """

    line: StreakLine
    length_px: float
    seen_px2: float
    charge_e: float
    room_e: float
    is_whole: bool
    is_full: bool


def spatter(
    observed: ObservedRecording, lights: Sequence[FrameLight], sizes: VarianceSizes, more_dn2: float = 0.0
) -> Spatter:
    """Return the spatter that frames show, in addition to other random effects, see `search_lines`."""
    searched, sensor = search_lines(observed, lights, sizes, more_dn2), lights[0].sensor
    bright, dark = transient_lines(observed, searched)
    lit = observed.lit
    bright_when_lit = [line for line in bright if lit[line.position]]
    measured = [_measure(observed, sensor, searched[line.position], line) for line in bright_when_lit]
    streaks = [streak for streak in measured if streak is not None]
    hit = _bins_reached(observed, bright_when_lit)
    n_others = len(dark) + len(bright) - len(bright_when_lit)
    evidence = streak_evidence(len(streaks), int(lit.sum()), n_others, len(lit))
    if not streaks:
        return Spatter(evidence, {}, {}, hit, 0.0)
    values, sigmas = _estimate(observed, searched, bright_when_lit, streaks)
    excess = _excess(observed, sensor, searched, _bins_reached(observed, [streak.line for streak in streaks]))
    return Spatter(evidence - _unlikely(values), values, sigmas, hit, excess)


def _excess(
    observed: ObservedRecording, sensor: Sensor, searched: Sequence[LineSearch], hit: Sequence[Bool]
) -> float:
    """Return the contribution of streaks to all pixels' mean of r^2, by the light and noise next to them."""
    bin_px = observed.bin_px
    added = 0.0
    for frame, frame_search, bins in zip(observed.frames, searched, hit, strict=True):
        if not bins.any():
            continue
        surroundings = [
            _surroundings(image, bins) for image in (frame_search.light_dn, frame_search.noise_dn**2)
        ]
        image_dn = in_blocks(frame.image_dn, bin_px).transpose(0, 2, 1, 3)
        seen_dn = surroundings[0] + np.float32(sensor.black_level_dn)
        added_dn = image_dn[bins] - seen_dn[:, np.newaxis, np.newaxis]
        added += float(np.sum(np.mean(added_dn**2, axis=(1, 2)) / (bin_px**2 * surroundings[1]) - 1.0))
    return float(added / np.size(hit))


def _surroundings(image: Float32, bins: Bool) -> Float32:
    """Return the mean of an image (h, w) next to each of some bins (n,)."""
    others = np.float32(1.0) - bins.astype(np.float32)
    light, weight = (cv2.GaussianBlur(part, (0, 0), 3.0) for part in (image * others, others))
    return np.asarray(light[bins] / np.maximum(weight[bins], 1e-6), dtype=np.float32)


def _bins_reached(observed: ObservedRecording, streak_lines: Sequence[StreakLine]) -> tuple[Bool, ...]:
    """Return the bins (h, w) of each frame that lines reach."""
    images = np.zeros((len(observed.frames), *observed.frames[0].keep.shape), dtype=np.bool_)
    for line in streak_lines:
        images[(line.position, *line.bins.T)] = True
    return tuple(dilate(image, DILATION_BINS) for image in images)


def _measure(
    observed: ObservedRecording, sensor: Sensor, frame_search: LineSearch, line: StreakLine
) -> Streak | None:
    """Measure a line in the pixels about it; None if it is no streak on a smooth background."""
    frame, setup, bin_px = observed.frames[line.position], observed.setup, observed.bin_px
    shape = np.array(frame_search.limit_dn.shape)
    # The background is taken from three bins about a streak.
    rim = 3
    low = np.maximum(line.bins.min(axis=0) - rim - 1, 0)
    high = np.minimum(line.bins.max(axis=0) + rim + 2, shape)
    window = slice(low[0], high[0]), slice(low[1], high[1])
    mask = np.zeros(high - low, dtype=np.bool_)
    mask[tuple((line.bins - low).T)] = True
    support = dilate(mask, DILATION_BINS)
    guard = dilate(support, DILATION_BINS)
    crop = frame.image_dn[low[0] * bin_px : high[0] * bin_px, low[1] * bin_px : high[1] * bin_px]
    smooth = ~guard & ~frame_search.stripe[window]
    inside, around = (np.kron(bins, np.ones((bin_px, bin_px))) > 0 for bins in (support, smooth))
    full = crop >= saturation_dn(sensor)
    electrons = linearise(crop, sensor)
    e_per_dn = float(np.median(electrons_per_dn(electrons, sensor)))
    noise_e = float(np.median(frame_search.noise_dn[window])) * bin_px * e_per_dn
    around &= ~full
    background_e = _background(electrons, around, noise_e)
    if background_e is None:
        return None
    moments = _moments(np.argwhere(inside).T.astype(np.float64), (electrons - background_e)[inside])
    if moments is None:
        return None
    charge_e, along, across = moments
    own = frame_search.own_dn[window] > frame_search.limit_dn[window] - frame_search.own_dn[window]
    is_cut = (low == 0).any() or (high == shape).any() or bool((own & guard).any())
    exposed = frame.condition.exposure_s / setup.camera.exposure_s
    length_px = math.sqrt(12.0 * (along - across))
    room_e = float(linearise(saturation_dn(sensor), sensor)) - float(np.median(background_e[inside]))
    is_full = bool((full & inside).any())
    return Streak(line, length_px, across, charge_e / exposed, room_e / exposed, not is_cut, is_full)


def _moments(place: Float64, charge: Float64) -> tuple[float, float, float] | None:
    """Return integral, variance along and across, px^2, of charge (n,) at places (2, n); None if no streak's.

    Across the streak charge is weighted by a Gaussian window of variance s^2, against noise. It turns a
    Gaussian's variance v into v s^2 / (v + s^2) and keeps s / sqrt(v + s^2) of the integral.
    """
    total = float(charge.sum())
    if total <= 0.0:
        return None
    place = place - (place @ charge / total)[:, np.newaxis]
    lateral, along = np.linalg.eigh((place * charge) @ place.T)[1].T @ place
    # The window's 1 sigma across the streak; a streak fills 90 % of it at most.
    sigma_px = 4.0
    across, window = 0.0, sigma_px**2
    for _ in range(4):
        seen = charge * np.exp(-0.5 * lateral**2 / window)
        total = float(seen.sum())
        if total <= 0.0:
            return None
        lateral = lateral - float(lateral @ seen) / total
        kept = min(float(lateral**2 @ seen) / total / window, 0.9)
        if kept <= 0.0:
            return None
        across, integral_kept = window * kept / (1.0 - kept), math.sqrt(1.0 - kept)
        window = max(sigma_px**2, 2.0 * across)
    middle = float(along @ seen) / total
    lengthwise = float((along - middle) ** 2 @ seen) / total
    # A streak's variance along it is at least 4 times that across it.
    return (total / integral_kept, lengthwise, across) if lengthwise > 4.0 * across else None


def _background(electrons: Float64, around: Bool, noise_e: float) -> Float64 | None:
    """Return the cubic through pixels next to a streak; None if they are not smooth."""
    row, column = ((places - places.mean()) / max(electrons.shape) for places in np.indices(electrons.shape))
    basis = np.stack([row**n * column**m for n in range(4) for m in range(4 - n)], axis=-1)
    use = around
    for _ in range(2):
        if use.sum() < 40:
            return None
        fitted = basis @ np.linalg.lstsq(basis[use], electrons[use], rcond=None)[0]
        remainder = electrons - fitted
        spread_e = sigma_of(remainder[use])
        # Distance from the background, in sigmas, of pixels that do not belong to it.
        use = around & (np.abs(remainder) < 4.0 * max(noise_e, spread_e))
    # A smooth background scatters by little more than noise in most of its pixels.
    is_smooth = float(np.std(remainder[use])) < 1.5 * noise_e and use.sum() > 0.7 * around.sum()
    return np.asarray(fitted) if is_smooth else None


def _estimate(
    observed: ObservedRecording,
    searched: Sequence[LineSearch],
    streak_lines: Sequence[StreakLine],
    streaks: Sequence[Streak],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the parameters of spatter and their 1 sigmas."""
    whole = [s for s in streaks if s.is_whole] or list(streaks)
    # Moments of faint streaks are noisy, those of saturated ones biased.
    clear = [s for s in whole if s.line.response_dn > 4.0 * s.line.limit_dn and not s.is_full]
    plain = clear or [s for s in whole if not s.is_full] or whole
    length = np.array([s.length_px for s in plain])
    across = np.array([s.seen_px2 for s in plain]) - observed.setup.camera.psf_sigma_px**2
    # No streak is narrower than half a pixel.
    width_px = math.sqrt(max(float(np.median(across)), 0.25))
    charge_e = np.array([s.charge_e / s.length_px for s in streaks])
    peak = charge_e / (width_px * math.sqrt(2.0 * math.pi))
    # A saturated streak's peak is at least what saturates.
    widened = math.hypot(width_px, observed.setup.camera.psf_sigma_px) / width_px
    full = np.array([widened * s.room_e if s.is_full else math.inf for s in streaks])
    peak = np.minimum(peak, full)
    limit = peak * np.array([s.line.limit_dn / s.line.response_dn for s in streaks])
    # The mean of an exponential distribution that is censored at both ends.
    n_seen = max(sum(not s.is_full for s in streaks), 1)
    peak_e = float(np.sum(peak - limit)) / n_seen
    searched_frames = max(_searched_frames(observed, searched, streak_lines, (streaks, peak), peak_e), 0.01)
    # Cut streaks count by their seen length; an edge that one crosses may have lengthened it.
    extent = np.array([line.extent for line in streak_lines]) / float(
        np.median([s.line.extent for s in whole])
    )
    n = float(np.sum(np.minimum(extent, 1.0)))
    values = {
        "rate_per_frame": n / searched_frames,
        "peak_e": peak_e,
        "length_px": float(np.median(length)),
        "width_px": width_px,
    }
    sigmas = {
        "rate_per_frame": math.sqrt(n) / searched_frames,
        "peak_e": peak_e / math.sqrt(n_seen),
        "length_px": _median_sigma(length),
        "width_px": _median_sigma(across) / (2.0 * width_px),
    }
    bounds = {name: (PARAMETERS[name].lower, PARAMETERS[name].upper) for name in values}
    return {name: float(np.clip(value, *bounds[name])) for name, value in values.items()}, sigmas


def _searched_frames(
    observed: ObservedRecording,
    searched: Sequence[LineSearch],
    streak_lines: Sequence[StreakLine],
    peaks: tuple[Sequence[Streak], Float64],
    peak_e: float,
) -> float:
    """Return the number of lit frames that were searched: areas weighted by the share of peaks found there.

    A streak whose middle lies on another one cannot be separated from it, so bins on streaks do not count.
    """
    frames, hit = observed.frames, _bins_reached(observed, streak_lines)
    exposed = [frame.condition.exposure_s / observed.setup.camera.exposure_s for frame in frames]
    response_dn = np.array([s.line.response_dn / exposed[s.line.position] for s in peaks[0]])
    dn_per_e = float(np.median(response_dn / peaks[1]))
    return sum(
        float(np.mean(np.where(covered, 0.0, np.exp(-frame_search.limit_dn / (dn_per_e * by * peak_e)))))
        for frame_search, covered, by, frame in zip(searched, hit, exposed, frames, strict=True)
        if frame.condition.arc_level > 0.0
    )


def _unlikely(values: Mapping[str, float]) -> float:
    """Return the log prior ratio, nats, of the likeliest length and width to these."""
    usual = [PARAMETERS[name] for name in ("length_px", "width_px")]
    return 0.5 * float(sum(((values[p.name] - p.start) / p.prior_sigma) ** 2 for p in usual))


def _median_sigma(values: Float64) -> float:
    """Return 1 sigma of the median of values (n,), at least the error of moments."""
    # Moments have an error of 0.3 px.
    return math.sqrt(0.5 * math.pi * spread(values) ** 2 / len(values) + 0.09)


def streak_evidence(n: int, n_lit: int, n_others: int, n_frames: int) -> float:
    """Return the evidence of n streaks in lit frames for spatter over other causes of lines, nats.

    The rate of other lines is known from `n_others`, dark ones and those in frames without arc: it has a
    Gamma distribution, whose predictive one is negative binomial. The prior of spatter's rate is exponential.
    """
    shape, frames = 0.5 + n_others, CLUTTER_FRAMES + n_frames
    clutter = gammaln(shape + n) - gammaln(shape) - gammaln(n + 1.0)
    clutter += xlogy(shape, frames / (frames + n_lit)) + xlogy(n, n_lit / (frames + n_lit))
    expected = n_lit * PARAMETERS["rate_per_frame"].prior_sigma
    streaks = xlogy(n, expected / (1.0 + expected)) - math.log(1.0 + expected)
    return float(streaks - clutter)

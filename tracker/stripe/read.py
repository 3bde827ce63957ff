"""Reading the stripe: the band around its expected place, the background beside it, path and fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from noise_model.arc.map import CELL, ArcKernel, ArcMap
from noise_model.arrays import Bool, Float32, Float64, Int64
from noise_model.median import known_median, median
from tracker.arc.level import MAP_SIGMA, ArcLevel
from tracker.arc.transmission import Transmission
from tracker.geometry import SensorGeometry
from tracker.state import Frame, Stripe
from tracker.stripe.band import gather, median_background, place, weigh
from tracker.stripe.edge import StripeLight
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit import N_FITTED, fit_lines
from tracker.stripe.ghost import second_light, second_place
from tracker.stripe.misfit import misfit_sigma_px, odd_residuals
from tracker.stripe.scatter import FrameScatter, Scatter, frame_scatter, own_sigma, speckle_squared
from tracker.stripe.smooth import smooth_stripe
from tracker.stripe.viterbi import OFFSET_STEP, best_path, matched_filter, peaks

FIT_SIGMAS = 5.0
"""How many stripe sigmas of background the band holds beyond the reach of the search: the fit reads four, and
a second stripe beside them has to be seen."""

MAP_TOLERANCE, MAP_FLOOR_E = 0.01, 20.0
"""How far the map may be off where it is read off its tables: relative, and in electrons."""

MEDIAN_HALF_PX = 30
MEDIAN_SIGMA = 1.0
"""Without an arc map: half the running median's length, and its background's relative 1 sigma (anything)."""

REACH_SIGMAS = 3.0
"""A search reaches so many sigmas of the seam's place."""

REFLECTED_SHARE, REFLECTED_SIGMA_LN = 0.4, 0.7
"""A reflection has about so much of its stripe's light, within a factor of two; it is seldom the brighter."""

MAX_ROUNDS = 3
"""So many times at most the stripe is read again without a second one's light."""


@dataclass
class Work:
    """Preallocated scratch (n_scan, n_pos) whose contents never matter."""

    charge: Float32
    background: Float32
    residual: Float32
    variance: Float32
    censored: Bool

    @classmethod
    def of(cls, geometry: SensorGeometry) -> Work:
        """Make room for the widest band of a sensor."""
        charge, background, residual, variance = np.empty((4, geometry.n_scan, geometry.n_pos), np.float32)
        return cls(charge, background, residual, variance, np.empty(charge.shape, np.bool_))

    def band(self, depth: int) -> Work:
        """Return contiguous views (n_scan, depth) of the scratch."""
        n_scan = len(self.charge)
        n = n_scan * depth
        return Work(
            self.charge.reshape(-1)[:n].reshape(n_scan, depth),
            self.background.reshape(-1)[:n].reshape(n_scan, depth),
            self.residual.reshape(-1)[:n].reshape(n_scan, depth),
            self.variance.reshape(-1)[:n].reshape(n_scan, depth),
            self.censored.reshape(-1)[:n].reshape(n_scan, depth),
        )


@dataclass(frozen=True, eq=False)
class StripeReading:
    """A stripe, and what it was read from: explaining a frame asks for that.

    `band` holds views of the scratch, which are good until the next frame; `lows` says where it begins for
    each CELL scan lines. `score` (n_scan, n_offsets) is the matched filter's, in sigmas, at `offsets_px` from
    the rounded expected place; `start_px` (n_scan,) is where the likeliest path runs, NaN for no stripe;
    `fits` (n_scan, 7) are `fit_line`'s. The variance of a pixel is `shot` times its mean plus
    `dark_variance_e2`; `map_sigma` is the background's relative 1 sigma, `base_sigma_e` that of the black
    level and of the hall's light.
    `second_share` is how bright a second stripe is over the first, 0 for none; the background has its light.
    `told_nats` is the evidence that the other one is the reflection, infinite where none is searched.
    `scatter` is what the frames up to this one show of it, `learned` what this one was read with.
    `misfit_px` (n_scan,) is by how much each centre may be off, alike with its neighbours', for light beneath
    it that is not as expected.
    """

    stripe: Stripe
    band: Work
    lows: Int64
    offsets_px: Int64
    score: Float32
    start_px: Float64
    fits: Float64
    shot: float
    dark_variance_e2: float
    map_sigma: float
    base_sigma_e: float
    second_share: float
    told_nats: float
    scatter: Scatter
    learned: Scatter
    misfit_px: Float64

    def light(self, psf_sigma_px: float, sheet_lines: float) -> StripeLight:
        """Return what shows where the stripe ends, as good as the band."""
        band, width_px = self.band, self.fits[:, 3]
        sigma_px = self.stripe.sigma_px[np.isfinite(self.stripe.sigma_px)]
        return StripeLight(
            band.charge,
            band.background,
            band.variance,
            band.censored,
            self.lows,
            CELL,
            self.stripe.position_px,
            width_px,
            self.shot,
            self.scatter.brightness_contrast,
            self.scatter.brightness_alike,
            psf_sigma_px,
            sheet_lines,
            median(sigma_px) if len(sigma_px) else math.nan,
        )


def arc_map_of(geometry: SensorGeometry, kernel: ArcKernel) -> ArcMap:
    """Return the arc map that a frame is read with."""
    return ArcMap.of(kernel, geometry.xy, geometry.cos4, geometry.n_scan, MAP_TOLERANCE, MAP_FLOOR_E)


def read_stripe(
    geometry: SensorGeometry,
    arc_map: ArcMap,
    transmission: Transmission | None,
    arc: ArcLevel,
    frame: Frame,
    expected: ExpectedStripe,
    reach_px: float,
    work: Work,
    use_arc_map: bool,
    scatter: Scatter,
    is_searching: bool,
) -> StripeReading:
    """Find the stripe within `reach_px` of its expected place and fit its centre in every scan line.

    `scatter` is what earlier frames show of it; this frame's is added before it is used. `is_searching` says
    whether the joint may lie far off its expected place.
    """
    half = math.ceil(reach_px + FIT_SIGMAS * float(expected.sigma_px.max()))
    lows, depth = place(expected.position_px, geometry.n_pos, half)
    band = work.band(depth)
    gather(
        frame.image_dn,
        geometry.along_rows,
        lows,
        geometry.charge_e,
        geometry.saturation_dn,
        band.charge,
        band.censored,
    )
    shot, dark_variance = 1.0, geometry.dark_variance_at(band.charge)
    level_known = math.isfinite(arc.level)
    level = arc.level if level_known else 1.0
    level_sigma = 0.0 if level_known else geometry.setup.tolerance.arc_level_rel
    map_sigma = math.hypot(MAP_SIGMA * max(1.0, arc.misfit if level_known else 1.0), level_sigma)
    if use_arc_map:
        _predict_background(geometry, arc_map, transmission, level, arc.black_e, lows, band)
    else:
        median_background(band.charge, MEDIAN_HALF_PX, band.background)
        spread = 1.4826 * float(np.median(np.abs(band.charge - band.background)))
        shot, map_sigma, dark_variance = 0.0, MEDIAN_SIGMA, max(spread**2, dark_variance)
    black_sigma = geometry.setup.tolerance.black_level_dn * geometry.setup.sensor.gain_e_per_dn
    base_sigma = math.hypot(black_sigma, arc.ambient_e)
    offsets = np.arange(-math.floor(reach_px), math.floor(reach_px) + 1, OFFSET_STEP)
    noise = shot, dark_variance, map_sigma, base_sigma
    fit = partial(_fit_band, band, expected, lows, noise=noise, is_searching=is_searching)
    score, start, fits, saturated, seen = fit(offsets=offsets, learned=scatter)
    learned = scatter
    if not scatter.frames:
        # Of the first frame what it shows itself is all that is known.
        learned = scatter.with_frame(seen)
        score, start, fits, saturated, seen = fit(offsets=offsets, learned=learned)
    plain, second_share, apart_px = band.background, 0.0, 0.0
    for _ in range(MAX_ROUNDS):
        share, apart_px = second_place(band.charge, plain, band.censored, fits, lows)
        if share == second_share == 0.0:
            break
        if plain is band.background:
            plain = plain.copy()
        band.background[:] = plain
        if share > 0.0:
            light = np.empty_like(plain)
            second_light(band.charge, plain, band.censored, fits, lows, share, apart_px, light)
            band.background += light
        second_share = share
        score, start, fits, saturated, seen = fit(offsets=offsets, learned=learned)
    told_nats, near = math.inf, None
    if is_searching and second_share > 0.0:
        off_px = fits[:, 0] - expected.position_px
        told_nats, near = _told_of_two(off_px, apart_px, second_share, offsets, reach_px)
    if near is not None:
        band.background[:], offsets = plain, near
        score, start, fits, saturated, seen = fit(offsets=offsets, learned=learned)
    scatter = scatter.with_frame(seen)
    sheet_px = _sheet_px(fits, geometry.setup.camera.psf_sigma_px)
    sigma, together = scatter.widened(own_sigma(fits, expected.sigma_px), sheet_px)
    smooth, smooth_sigma = smooth_stripe(fits[:, 0], sigma, together)
    odd = odd_residuals(band.charge, band.background, band.censored, fits, lows, CELL)
    alike = known_median((together / sigma) ** 2) if np.isfinite(sigma).any() else 1.0
    stripe = Stripe(
        fits[:, 0], sigma, smooth, smooth_sigma, fits[:, 2], saturated, geometry.along_rows, together
    )
    return StripeReading(
        stripe,
        band,
        lows,
        offsets,
        score,
        start,
        fits,
        shot,
        dark_variance,
        map_sigma,
        base_sigma,
        second_share,
        told_nats,
        scatter,
        learned,
        misfit_sigma_px(odd, fits, alike),
    )


def _sheet_px(fits: Float64, psf_sigma_px: float) -> float:
    """Return the sheet's 1 sigma in the image, px, of the fits (n_scan, 7) of lines; 0 of none."""
    widths_px = fits[np.isfinite(fits[:, 3]), 3]
    if not len(widths_px):
        return 0.0
    return math.sqrt(max(median(widths_px) ** 2 - psf_sigma_px**2, 0.0))


def _told_of_two(
    off_px: Float64, apart_px: float, share: float, offsets_px: Int64, reach_px: float
) -> tuple[float, Int64 | None]:
    """Return by how many nats the laser's of two stripes is told, and the offsets about it if it is dimmer.

    The brighter one lies `off_px` (n_scan,) off its expected place, the weaker one, of a `share` of its
    light, `apart_px` from it. Either reflection's ln(strength) is normal about ln(REFLECTED_SHARE), and the
    stripe's place is normal about the expected one. With r = ln(share), m and s the reflection's mean and
    sigma, the log odds that the brighter one is the laser's are

        L = 2 m r / s^2 + (weaker^2 - brighter^2) / (2 sigma^2).
    """
    if np.isnan(off_px).all():
        return math.inf, None
    brighter_px, sigma_px = known_median(off_px), reach_px / REACH_SIGMAS
    weaker_px = brighter_px + apart_px
    by_light = 2.0 * math.log(REFLECTED_SHARE) * math.log(share) / REFLECTED_SIGMA_LN**2
    odds = by_light + (weaker_px**2 - brighter_px**2) / (2.0 * sigma_px**2)
    near = offsets_px[np.abs(offsets_px - weaker_px) < 0.5 * abs(apart_px)]
    return abs(odds), near if odds < 0.0 and len(near) else None


def _fit_band(
    band: Work,
    expected: ExpectedStripe,
    lows: Int64,
    offsets: Int64,
    noise: tuple[float, float, float, float],
    learned: Scatter,
    is_searching: bool,
) -> tuple[Float32, Float64, Float64, Bool, FrameScatter]:
    """Return a band's score (n_scan, n_offsets), path's start (n_scan,), fits (n_scan, 7), saturated lines.

    And what they show of the scatter. `noise` are `fit_lines`' shot, dark variance, and 1 sigma of map and
    base; `learned` is the scatter that is known.
    """
    width_px = expected.sigma_px * learned.width_factor
    shot, dark_variance, map_sigma, base_sigma = noise
    weigh(band.charge, band.background, shot, dark_variance, band.residual, band.variance)
    n_scan = len(band.charge)
    score = np.empty((n_scan, len(offsets)), dtype=np.float32)
    matched_filter(
        band.residual,
        band.variance,
        expected.position_px,
        width_px,
        lows,
        CELL,
        offsets,
        score,
    )
    # Where no light can be none is looked for.
    score[~expected.is_sought] = 0.0
    choice = np.empty(n_scan, dtype=np.int64)
    best_path(score, choice)
    start = np.empty(n_scan)
    peaks(score, choice, expected.position_px, offsets, start)
    start[~expected.is_sought] = np.nan
    fits = np.empty((n_scan, N_FITTED))
    saturated = np.empty(n_scan, dtype=np.bool_)
    fit_lines(
        band.charge,
        band.background,
        band.censored,
        start,
        width_px,
        lows,
        CELL,
        shot,
        dark_variance,
        learned.weighing_contrast,
        map_sigma,
        base_sigma,
        fits,
        saturated,
    )
    speckle = speckle_squared(
        band.charge, band.background, band.censored, fits, lows, CELL, shot, dark_variance
    )
    own = own_sigma(fits, width_px)
    seen = frame_scatter(fits, expected.position_px, expected.sigma_px, own, speckle, is_searching)
    # The limit is that of what is known: a frame without a stripe would widen it for itself.
    odd = np.abs(np.log(fits[:, 3] / width_px)) > learned.width_limit_ln
    fits[odd], saturated[odd] = np.nan, False
    return score, start, fits, saturated, seen


def _predict_background(
    geometry: SensorGeometry,
    arc_map: ArcMap,
    transmission: Transmission | None,
    level: float,
    black_e: float,
    lows: Int64,
    band: Work,
) -> None:
    """Write the arc's light at the frame's own level, other light and the black level into the band."""
    if level == 0.0 and transmission is None:
        band.background[:] = black_e
        return
    arc_map.fill(lows, band.background)
    if transmission is None:
        band.background *= np.float32(level)
    else:
        n_scan, depth = band.background.shape
        first = np.arange(n_scan) * geometry.n_pos + lows[np.arange(n_scan) // CELL]
        pixels = (first[:, None] + np.arange(depth)).ravel()
        arc_e, other_e = transmission.through(pixels, band.background.ravel())
        band.background[:] = (np.float32(level) * arc_e + other_e).reshape(n_scan, depth)
    band.background += np.float32(black_e)

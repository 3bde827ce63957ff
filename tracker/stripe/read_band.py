"""Reading a band: path, fits, a second stripe's light, scatter and neighbours, in one compiled call."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Float32, Float64, Int64
from noise_model.kernel import kernel
from noise_model.median import exact_median, finite_median
from tracker.state import Stripe
from tracker.stripe.band import Band, LightLevel, at_level
from tracker.stripe.detection import Evidence, evidence_of
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import MOST_SCORE_LOST, Noise, ReadRoom, Sought, fit_band, fit_path, score_lost
from tracker.stripe.frame_scatter import ScatterRoom, own_sigma
from tracker.stripe.ghost import second_light, second_place
from tracker.stripe.misfit import count_alike, misfit_sigma_px
from tracker.stripe.scatter import (
    FrameScatter,
    add_frame,
    brightness_alike,
    brightness_plateau,
    empty_scatter,
    line_variance_px2,
    widen,
    width_factor,
)

REACH_SIGMAS = 3.0
"""A search reaches so many sigmas of the seam's place."""

REFLECTED_SHARE, REFLECTED_SIGMA_LN = 0.4, 0.7
"""A reflection has about so much of its stripe's light, within a factor of two; it is seldom the brighter."""

MAX_ROUNDS = 3
"""So many times at most the stripe is read again without a second one's light."""


class UsualLine(NamedTuple):
    """The `contrast` and likeness of the lines' brightness, and the median 1 sigma of their centres, px."""

    contrast: float
    alike: float
    centre_sigma_px: float


class Told(NamedTuple):
    """A second stripe: its `share` of the brighter one's light, 0 for none, and by how many nats it is told.

    The brighter one is read at all offsets; where it `is_reflection`, the other at `n_offsets` of them, from
    number `first` on.
    """

    share: float
    nats: float
    is_reflection: bool
    first: int
    n_offsets: int


@kernel
def told_of_two(
    fits: Float64,
    expected_px: Float64,
    apart_px: float,
    share: float,
    offsets_px: Int64,
    reach_px: float,
    room: ScatterRoom,
) -> Told:
    """Return by how many nats the laser's of two stripes is told, and the offsets about it if it is dimmer.

    The brighter one's fits (n_scan, 7) lie off their expected places (n_scan,), the weaker one, of a `share`
    of its light, `apart_px` from it. Either reflection's ln(strength) is normal about ln(REFLECTED_SHARE),
    and the stripe's place is normal about the expected one. With r = ln(share), m and s the reflection's mean
    and sigma, the log odds that the brighter one is the laser's are

        L = 2 m r / s^2 + (weaker^2 - brighter^2) / (2 sigma^2).
    """
    everything = Told(share, math.inf, False, 0, len(offsets_px))
    for s in range(fits.shape[0]):
        room.off[s] = fits[s, 0] - expected_px[s]
    brighter_px, sigma_px = finite_median(room.off, room.values), reach_px / REACH_SIGMAS
    if math.isnan(brighter_px):
        return everything
    weaker_px = brighter_px + apart_px
    by_light = 2.0 * math.log(REFLECTED_SHARE) * math.log(share) / REFLECTED_SIGMA_LN**2
    odds = by_light + (weaker_px**2 - brighter_px**2) / (2.0 * sigma_px**2)
    first, n = 0, 0
    for i in range(len(offsets_px)):
        if abs(offsets_px[i] - weaker_px) < 0.5 * abs(apart_px):
            first = first if n > 0 else i
            n += 1
    if odds >= 0.0 or n == 0:
        return Told(share, abs(odds), False, 0, len(offsets_px))
    return Told(share, abs(odds), True, first, n)


@kernel
def _copy(pixels: Float32, into: Float32) -> None:
    """Copy a band's pixels (n_scan, depth): a slice that is assigned to takes 2 s to compile."""
    for s in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            into[s, j] = pixels[s, j]


@kernel(allocates=True)
def _read_without_a_second(
    band: Band,
    expected: ExpectedStripe,
    sought: Sought,
    noise: Noise,
    learned: FrameScatter,
    room: ReadRoom,
) -> Told:
    """Take a second stripe's light for background, and read the band anew until that changes nothing."""
    offsets_px, reach_px = sought.offsets_px, sought.reach_px
    share, apart_px, is_plain = 0.0, 0.0, True
    for _ in range(MAX_ROUNDS):
        plain = band.background if is_plain else band.plain
        now, apart_px = second_place(band.charge, plain, band.censored, room.lines.fits, band.lows)
        if now == 0.0 and share == 0.0:
            break
        if is_plain:
            _copy(band.background, band.plain)
            is_plain = False
        light = band.light
        light[:] = 0.0
        if now > 0.0:
            second_light(
                band.charge, band.plain, band.censored, room.lines.fits, band.lows, now, apart_px, light
            )
        for s in range(light.shape[0]):
            for j in range(light.shape[1]):
                band.background[s, j] = band.plain[s, j] + light[s, j]
        share = now
        fit_band(band, expected, sought, noise, learned, room)
    told = Told(share, math.inf, False, 0, len(offsets_px))
    if not sought.is_searching or share == 0.0:
        return told
    told = told_of_two(
        room.lines.fits, expected.position_px, apart_px, share, offsets_px, reach_px, room.scatter
    )
    if told.is_reflection:
        _copy(band.plain, band.background)
        near = offsets_px[told.first : told.first + told.n_offsets]
        nearby = Sought(near, sought.bin_px, reach_px, sought.is_searching, sought.reads_pairs)
        fit_band(band, expected, nearby, noise, learned, room)
    return told


@kernel
def _sheet_px(fits: Float64, psf_sigma_px: float, room: ScatterRoom) -> float:
    """Return the sheet's 1 sigma in the image, px, of the fits (n_scan, 7) of lines; 0 of none."""
    for s in range(fits.shape[0]):
        room.off[s] = fits[s, 3]
    width_px = finite_median(room.off, room.values)
    return math.sqrt(max(width_px**2 - psf_sigma_px**2, 0.0)) if width_px > 0.0 else 0.0


class BandReading(NamedTuple):
    """What is read of a band: its stripe, a second stripe, what tells of a stripe, and what is `usual`.

    `read_with` is the scatter that it was read with, `after` that of all frames with this one. `width_px`
    (n_scan,) is the lines' fitted 1 sigma across the stripe. `score` (n_scan, n) is the matched filter's at
    those offsets (n,) from `ReadRoom.around_px` at which the stripe was sought last.
    """

    stripe: Stripe
    told: Told
    evidence: Evidence
    read_with: FrameScatter
    after: FrameScatter
    usual: UsualLine
    width_px: Float64
    offsets_px: Int64
    score: Float32


@kernel(allocates=True)
def _empty_stripe(n_scan: int, along_rows: bool) -> Stripe:
    """Make room for the stripe of a frame."""
    return Stripe(
        np.empty(n_scan),
        np.empty(n_scan),
        np.empty(n_scan),
        np.empty(n_scan, np.bool_),
        along_rows,
        np.empty(n_scan),
    )


@kernel
def _finish(
    expected: ExpectedStripe, learned: FrameScatter, psf_sigma_px: float, room: ReadRoom, out: Stripe
) -> None:
    """Write what the fits say of each line, with the scatter that is known and with its neighbours."""
    n_scan, fits = room.start_px.shape[0], room.lines.fits
    own_sigma(fits, expected.sigma_px, room.n_lines, room.scatter.values, room.own_px)
    sheet_px = _sheet_px(fits, psf_sigma_px, room.scatter)
    widen(learned, room.own_px, room.n_lines, sheet_px, out.sigma_px, out.beside_px)
    for s in range(n_scan):
        out.position_px[s], out.amplitude_e[s] = fits[s, 0], fits[s, 2]
        out.saturated[s] = room.lines.saturated[s]
        # Two lines that were read as one tell their misfit once.
        if room.n_lines[s] > 1 and s % 2 == 1:
            room.lines.odd[s] = math.nan
    count_alike(out.sigma_px, out.beside_px, room.n_lines, room.scatter.values, room.scatter.off)
    misfit_sigma_px(room.lines.odd, fits, room.scatter.off, room.misfit, room.misfit_px)


@kernel(allocates=True)
def usual_line(average: FrameScatter, own_px: Float64) -> UsualLine:
    """Return what scatter and lines' own 1 sigma (n,) say of a usual line read alone."""
    own_sigma_px = exact_median(own_px[np.isfinite(own_px)])
    centre_sigma_px = math.hypot(own_sigma_px, math.sqrt(line_variance_px2(average)))
    return UsualLine(math.sqrt(brightness_plateau(average)), brightness_alike(average), centre_sigma_px)


@kernel(allocates=True)
def read_band(
    band: Band,
    light: LightLevel,
    expected: ExpectedStripe,
    sought: Sought,
    noise: Noise,
    before: FrameScatter,
    frames: int,
    psf_sigma_px: float,
    n_pos: int,
    along_rows: bool,
    room: ReadRoom,
) -> BandReading:
    """Read the stripe in a band.

    The band's background is brought to the level of its `light` first. `before` is the scatter of so many
    earlier `frames`. With it a frame is read; the first one with what it shows itself. Scan lines are `n_pos`
    long, and the image's columns where the stripe runs `along_rows`. What is read beside the lines stays in
    `room`.
    """
    at_level(band.background, light)
    read_with, after = before, empty_scatter()
    fit_band(band, expected, sought, noise, before, room)
    if frames == 0:
        read_with = empty_scatter()
        add_frame(before, 0, room.seen, read_with)
        # A stripe of another width is sought anew. Of a search no more is asked than where the joint is.
        if score_lost(width_factor(before) / width_factor(read_with)) > MOST_SCORE_LOST:
            fit_band(band, expected, sought, noise, read_with, room)
        elif not sought.is_searching:
            fit_path(band, expected, sought, noise, read_with, room)
    told = _read_without_a_second(band, expected, sought, noise, read_with, room)
    add_frame(before, frames, room.seen, after)
    stripe = _empty_stripe(band.charge.shape[0], along_rows)
    _finish(expected, after, psf_sigma_px, room, stripe)
    n_scan, n = room.start_px.shape[0], told.n_offsets
    sought_px = sought.offsets_px[told.first : told.first + n]
    score = room.score[: n_scan * n].reshape((n_scan, n))
    evidence = evidence_of(
        stripe.position_px,
        stripe.saturated,
        expected.position_px,
        expected.sigma_px,
        expected.shown,
        n_pos,
        score,
        room.around_px,
        sought_px,
        sought.bin_px,
        read_with,
        room.scatter.values,
    )
    usual, width_px = usual_line(after, room.own_px), room.lines.fits[:, 3].copy()
    return BandReading(stripe, told, evidence, read_with, after, usual, width_px, sought_px, score)

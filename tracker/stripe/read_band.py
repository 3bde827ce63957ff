"""A second stripe's light beneath the first, and what the fits of a band say of each line."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arrays import Bool, Float64, Int64
from noise_model.kernel import kernel
from noise_model.median import exact_median, finite_median
from tracker.state import (
    AMPLITUDE_E,
    BESIDE_PX,
    BIAS_PX,
    CENTRE_PX,
    MISFIT_PX,
    N_LINES,
    OWN_PX,
    SCAN,
    SIGMA_PX,
    WIDTH_PX,
)
from tracker.stripe.band import Band
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import Noise, ReadRoom, Sought, fit_band
from tracker.stripe.frame_scatter import ScatterRoom, own_sigma
from tracker.stripe.ghost import second_light, second_place
from tracker.stripe.misfit import count_alike, misfit_sigma_px
from tracker.stripe.scatter import (
    FrameScatter,
    brightness_alike,
    brightness_plateau,
    line_variance_px2,
    widen,
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


def read_without_second(
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
            band.plain[:] = band.background
            is_plain = False
        band.light[:] = 0.0
        if now > 0.0:
            second_light(
                band.charge, band.plain, band.censored, room.lines.fits, band.lows, now, apart_px, band.light
            )
        np.add(band.plain, band.light, out=band.background)
        share = now
        fit_band(band, expected, sought, noise, learned, room)
    told = Told(share, math.inf, False, 0, len(offsets_px))
    if not sought.is_searching or share == 0.0:
        return told
    told = told_of_two(
        room.lines.fits, expected.position_px, apart_px, share, offsets_px, reach_px, room.scatter
    )
    if told.is_reflection:
        band.background[:] = band.plain
        near = offsets_px[told.first : told.first + told.n_offsets]
        fit_band(band, expected, sought._replace(offsets_px=near), noise, learned, room)
    return told


@kernel
def _sheet_px(fits: Float64, psf_sigma_px: float, room: ScatterRoom) -> float:
    """Return the sheet's 1 sigma in the image, px, of the fits (n_scan, 7) of lines; 0 of none."""
    for s in range(fits.shape[0]):
        room.off[s] = fits[s, 3]
    width_px = finite_median(room.off, room.values)
    return math.sqrt(max(width_px**2 - psf_sigma_px**2, 0.0)) if width_px > 0.0 else 0.0


@kernel
def write_lines(
    expected: ExpectedStripe,
    learned: FrameScatter,
    psf_sigma_px: float,
    room: ReadRoom,
    lines: Float64,
    saturated: Bool,
) -> None:
    """Write what the fits say of each line (N_ROWS, n_scan), with the scatter and with its neighbours."""
    fits, sigma_px, beside_px, own_px = room.lines.fits, lines[SIGMA_PX], lines[BESIDE_PX], lines[OWN_PX]
    own_sigma(fits, expected.sigma_px, room.n_lines, room.scatter.values, own_px)
    sheet_px = _sheet_px(fits, psf_sigma_px, room.scatter)
    widen(learned, own_px, room.n_lines, sheet_px, sigma_px, beside_px)
    for s in range(lines.shape[1]):
        lines[CENTRE_PX, s], lines[AMPLITUDE_E, s], lines[WIDTH_PX, s] = fits[s, 0], fits[s, 2], fits[s, 3]
        lines[SCAN, s], lines[BIAS_PX, s], lines[N_LINES, s] = s, expected.bias_px[s], room.n_lines[s]
        saturated[s] = room.lines.saturated[s]
        # Two lines that were read as one tell their misfit once.
        if room.n_lines[s] > 1 and s % 2 == 1:
            room.lines.odd[s] = math.nan
    count_alike(sigma_px, beside_px, room.n_lines, room.scatter.values, room.scatter.off)
    misfit_sigma_px(room.lines.odd, fits, room.scatter.off, room.misfit, lines[MISFIT_PX])


@kernel(allocates=True)
def usual_line(average: FrameScatter, own_px: Float64) -> UsualLine:
    """Return what scatter and lines' own 1 sigma (n,) say of a usual line read alone."""
    own_sigma_px = exact_median(own_px[np.isfinite(own_px)])
    centre_sigma_px = math.hypot(own_sigma_px, math.sqrt(line_variance_px2(average)))
    return UsualLine(math.sqrt(brightness_plateau(average)), brightness_alike(average), centre_sigma_px)

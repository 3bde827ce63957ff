"""A second stripe next to the first, its reflection in a window or in the sheet, and what its light is.

It runs next to the first one at the same distance everywhere. So what the first one's fit leaves over is laid
on top of itself from many scan lines, each over its stripe's amplitude and from its stripe's centre on, and
the distance is sought at which a bell of the stripe's width, over any level, explains most of it.

Between two stripes, and next to them, the matched filter sees it darker than next to one, and each stands in
the other's fit. With the second one's light in the background path, fit and evidence are the first one's own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import REDUCTION, kernel
from noise_model.compiled.median import exact_median, finite_median
from tracker.stripe.band import Band
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.fit_band import ReadRoom, SearchRange, fit_band
from tracker.stripe.line_fit.first_guess import PixelVariance
from tracker.stripe.viterbi import TEMPLATE_SIGMAS, Pair, bell

REACH_SIGMAS = 3.0
"""A search reaches so many sigmas of the seam's place."""

REFLECTED_SHARE, REFLECTED_SIGMA_LN = 0.4, 0.7
"""A reflection has about so much of its stripe's light, within a factor of two; it is seldom the brighter."""

MAX_ROUNDS = 3
"""Largest number of times that the stripe is read again without a second one's light."""

MIN_GHOST_SHARE, MIN_GHOST_LINES = 0.2, 0.6
"""A second stripe has this share of the first one's light or more, in this share of its scan lines."""

EVERY = 8
"""Every so many scan lines are asked for it."""


@kernel(fastmath=REDUCTION)
def _bell_over(values: Float32, middle: float, width: float) -> float:
    """Return the least-squares amplitude of a bell over any level, NaN if values (n,) lack its flanks."""
    half = math.ceil(TEMPLATE_SIGMAS * width)
    low, high = max(round(middle) - half, 0), min(round(middle) + half + 1, values.shape[0])
    before, behind = round(middle - width), round(middle + width)
    if before < low or behind >= high or math.isnan(values[before]) or math.isnan(values[behind]):
        return math.nan
    zero, unity = np.float32(0.0), np.float32(1.0)
    inverse, first = np.float32(1.0 / width), np.float32(low - middle)
    n, g_sum, gg, v_sum, gv = zero, zero, zero, zero, zero
    for i in range(high - low):
        is_seen = not math.isnan(values[low + i])
        g = bell((np.float32(i) + first) * inverse) * (unity if is_seen else zero)
        value = values[low + i] if is_seen else zero
        n += unity if is_seen else zero
        g_sum += g
        gg += g * g
        v_sum += value
        gv += g * value
    spread = n * gg - g_sum * g_sum
    return float((n * gv - g_sum * v_sum) / spread) if spread > zero else math.nan


@kernel(fastmath={"contract"})
def _left_over(
    charge: Float32, background: Float32, censored: Bool, center: float, fit: Float64, remainder: Float32
) -> None:
    """Write the charge (depth,) less a line's stripe about a centre, NaN for censored pixels."""
    amplitude, inverse, middle = np.float32(fit[2]), np.float32(1.0 / fit[3]), np.float32(center)
    for r in range(charge.shape[0]):
        own = amplitude * bell((np.float32(r) - middle) * inverse)
        remainder[r] = np.float32(math.nan) if censored[r] else charge[r] - background[r] - own


@kernel(fastmath={"contract"})
def _lay(remainder: Float32, share: float, laid: Float32, laid_on: Float32) -> None:
    """Add what a line leaves (n,), times `share`, to the sums and to the numbers of what was added."""
    # No line's pixel counts for more than so many amplitudes of its stripe.
    zero, unity, max_e, per_e = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(share)
    for r in range(remainder.shape[0]):
        is_seen = not math.isnan(remainder[r])
        laid[r] += min(max(remainder[r] * per_e, -max_e), max_e) if is_seen else zero
        laid_on[r] += unity if is_seen else zero


@kernel
def _lay_lines(
    charge: Float32,
    background: Float32,
    censored: Bool,
    fits: Float64,
    lows: Int64,
    remainder: Float32,
    widths: Float64,
    laid: Float32,
    laid_on: Float32,
) -> int:
    """Lay what fits leave over, about their centres, one on the other; return how many lines have fits.

    `widths` (n_scan,) gets these' widths, `laid` and `laid_on` (2 depth + 1,) the sum and how many lines are
    in it; the `remainder` (depth,) is scratch.
    """
    depth, n = charge.shape[1], 0
    for s in range(0, charge.shape[0], EVERY):
        if math.isnan(fits[s, 0]):
            continue
        widths[n] = fits[s, 3]
        n += 1
        center = fits[s, 0] - lows[s // CELL]
        _left_over(charge[s], background[s], censored[s], center, fits[s], remainder)
        shift = depth - round(center)
        _lay(remainder, 1.0 / fits[s, 2], laid[shift : shift + depth], laid_on[shift : shift + depth])
    return n


@kernel
def _ask_lines(
    charge: Float32,
    background: Float32,
    censored: Bool,
    fits: Float64,
    lows: Int64,
    remainder: Float32,
    apart: float,
    min_share: float,
) -> tuple[int, int, int, float, float]:
    """Return the number of lines that could show a stripe `apart` px away, and that do behind and before.

    Returned too are the sums, behind and before, of its light over that of the stripe that is fitted. A
    share of less than `min_share` shows none.
    """
    asked, behind, ahead, by_behind, by_ahead = 0, 0, 0, 0.0, 0.0
    for s in range(0, charge.shape[0], EVERY):
        if not math.isnan(fits[s, 0]):
            center = fits[s, 0] - lows[s // CELL]
            _left_over(charge[s], background[s], censored[s], center, fits[s], remainder)
            after, before = _either_side(remainder, center, abs(apart), fits[s])
            if max(after, before) > min_share:
                if after > before:
                    behind, by_behind = behind + 1, by_behind + after
                else:
                    ahead, by_ahead = ahead + 1, by_ahead + before
            asked += max(after, before) > min_share or (after if apart > 0.0 else before) > -math.inf
    return asked, behind, ahead, by_behind, by_ahead


@kernel(allocates=True)
def second_place(charge: Float32, background: Float32, censored: Bool, fits: Float64, lows: Int64) -> Pair:
    """Return the weaker stripe's share of the brighter one's light and its distance, px; 0, 0 for none.

    What it is asked of is as `lines.fit_lines` has it. The fits (n_scan, 7) may be those of either, and
    of one here and the other there.
    """
    n_scan, depth = charge.shape
    room = np.zeros((2, 2 * depth + 1), dtype=np.float32)
    laid, laid_on = room[0], room[1]
    remainder, widths = np.empty(depth, dtype=np.float32), np.empty(n_scan)
    n = _lay_lines(
        charge=charge,
        background=background,
        censored=censored,
        fits=fits,
        lows=lows,
        remainder=remainder,
        widths=widths,
        laid=laid,
        laid_on=laid_on,
    )
    if n == 0:
        return 0.0, 0.0
    width = exact_median(widths[:n])
    for i in range(2 * depth + 1):
        laid[i] = laid[i] / laid_on[i] if laid_on[i] > MIN_GHOST_LINES * n else np.float32(math.nan)
    share, apart = 0.0, 0.0
    for i in range(2 * depth + 1):
        # Distance from the first, in its sigmas, within which light is of its own shape.
        if abs(i - depth) >= 3.0 * width and not math.isnan(laid[i]):
            here = _bell_over(laid, float(i), width)
            if here > share:
                share, apart = here, float(i - depth)
    if share < MIN_GHOST_SHARE:
        return 0.0, 0.0
    # Between pixels along the parabola through the highest three.
    before, after = _bell_over(laid, depth + apart - 1.0, width), _bell_over(laid, depth + apart + 1.0, width)
    curve = 2.0 * share - before - after
    if curve > 0.0:
        apart += 0.5 * (after - before) / curve
    asked, behind, ahead, by_behind, by_ahead = _ask_lines(
        charge=charge,
        background=background,
        censored=censored,
        fits=fits,
        lows=lows,
        remainder=remainder,
        apart=apart,
        min_share=0.5 * min(share, 1.0 / share),
    )
    if behind + ahead <= MIN_GHOST_LINES * asked:
        return 0.0, 0.0
    more = by_behind / behind if behind >= ahead else by_ahead / ahead
    is_brighter = more > 1.0
    distance = abs(apart) if (behind >= ahead) != is_brighter else -abs(apart)
    return (1.0 / more if is_brighter else more), distance


@kernel
def _either_side(remainder: Float32, center: float, apart_px: float, fit: Float64) -> Pair:
    """Return the brightness of another stripe behind and ahead, over a line's own, -inf out of sight."""
    behind, ahead = (
        _bell_over(remainder, center + apart_px, fit[3]),
        _bell_over(remainder, center - apart_px, fit[3]),
    )
    behind, ahead = -math.inf if math.isnan(behind) else behind, -math.inf if math.isnan(ahead) else ahead
    return behind / fit[2], ahead / fit[2]


@kernel(allocates=True)
def second_light(
    charge: Float32,
    background: Float32,
    censored: Bool,
    fits: Float64,
    lows: Int64,
    share: float,
    apart_px: float,
    light: Float32,
) -> None:
    """Write the light (n_scan, depth), e-, of the weaker of two stripes, `apart_px` from the brighter one.

    Where the fit is the weaker one's, that is what is fitted; elsewhere its amplitude is the line's own, or
    `share` of the brighter one's where it is out of sight.
    """
    n_scan, depth = charge.shape
    remainder = np.empty(depth, dtype=np.float32)
    for s in range(n_scan):
        light[s] = 0.0
        if math.isnan(fits[s, 0]):
            continue
        middle, amplitude, width = fits[s, 0] - lows[s // CELL], fits[s, 2], fits[s, 3]
        _left_over(charge[s], background[s], censored[s], middle, fits[s], remainder)
        weaker, brighter = _either_side(remainder, middle, apart_px, fits[s])
        if brighter <= max(weaker, 0.5 * share):
            middle += apart_px
            own = _bell_over(remainder, middle, width)
            amplitude = share * amplitude if math.isnan(own) else max(own, 0.0)
        for r in range(depth):
            t = (r - middle) / width
            light[s, r] = amplitude * math.exp(-0.5 * t * t)


class SecondStripe(NamedTuple):
    """A second stripe: its `share` of the brighter one's light, 0 for none, and its evidence.

    The brighter one is read at all offsets; where it `is_reflection`, the other at `n_offsets` of them, from
    number `first` on.
    """

    share: float
    nats: float
    is_reflection: bool
    first: int
    n_offsets: int


@kernel(allocates=True)
def choose_of_two(
    fits: Float64,
    expected_px: Float64,
    apart_px: float,
    share: float,
    offsets_px: Int64,
    reach_px: float,
    values: Float32,
) -> SecondStripe:
    """Return the evidence for the laser's of two stripes, nats, and the offsets about it if it is dimmer.

    The brighter one's fits (n_scan, 7) lie off their expected places (n_scan,), the weaker one, of a `share`
    of its light, `apart_px` from it. Either reflection's ln(strength) is normal about ln(REFLECTED_SHARE),
    and the stripe's place is normal about the expected one. With r = ln(share), m and s the reflection's mean
    and sigma, the log odds that the brighter one is the laser's are

        L = 2 m r / s^2 + (weaker^2 - brighter^2) / (2 sigma^2).
    """
    everything = SecondStripe(share, math.inf, False, 0, len(offsets_px))
    off_px = np.empty(fits.shape[0])
    for s in range(fits.shape[0]):
        off_px[s] = fits[s, 0] - expected_px[s]
    brighter_px, sigma_px = finite_median(off_px, values), reach_px / REACH_SIGMAS
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
        return SecondStripe(share, abs(odds), False, 0, len(offsets_px))
    return SecondStripe(share, abs(odds), True, first, n)


def read_without_second(
    band: Band,
    expected: ExpectedStripe,
    search: SearchRange,
    noise: PixelVariance,
    learned: Float64,
    room: ReadRoom,
) -> SecondStripe:
    """Take a second stripe's light for background, and read the band anew until that changes nothing."""
    offsets_px, reach_px = search.offsets_px, search.reach_px
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
                charge=band.charge,
                background=band.plain,
                censored=band.censored,
                fits=room.lines.fits,
                lows=band.lows,
                share=now,
                apart_px=apart_px,
                light=band.light,
            )
        np.add(band.plain, band.light, out=band.background)
        share = now
        fit_band(band, expected, search, noise, learned, room)
    second = SecondStripe(share, math.inf, False, 0, len(offsets_px))
    if not search.is_searching or share == 0.0:
        return second
    second = choose_of_two(
        room.lines.fits, expected.position_px, apart_px, share, offsets_px, reach_px, room.values
    )
    if second.is_reflection:
        band.background[:] = band.plain
        near = offsets_px[second.first : second.first + second.n_offsets]
        fit_band(band, expected, search._replace(offsets_px=near), noise, learned, room)
    return second

"""End of a stripe at an upright edge, to a part of a scan line.

The optics spread an edge over a few lines, each of which holds a share of the stripe on either side. With
u(r) and v(r) the mean stripes of the lines beyond, moved to where they would run, the charge of a line s
between them is

    d(r) = a_s u(r) + b_s v(r) + c_s + noise.

Seen through a Gaussian of sigma_p, an edge at e leaves a_s = A Phi((e - s) / sigma_p), A near 1, and so of
the other side. Where the edge crosses the stripe skewed, the sheet's 1 sigma spreads it over lines of its
own: a bell cut off at t of its sigmas has the least-squares share Phi(sqrt(2) t), so half of that square
counts. A stripe's brightness scatters by a contrast C, neighbouring lines in common: two lines k apart by
rho^k. So a whole line may be dimmer than one that holds half, and so may its neighbours: an end is the mean
of its posterior. The likelihood is a Kalman filter's along the lines (Kalman 1960, J. Basic Eng. 82, 35).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel
from tracker.stripe.light import (
    BEYOND,
    MIN_BEYOND,
    NEXT_TO_NOTHING,
    WINDOW_SIGMAS,
    StripeLight,
    along_edge,
    apart_px,
    line_room,
    line_shares,
    lines_aside,
    run_of,
)

CLEAR_SIGMAS = 3.0
"""Distance, in sigmas of the optics, at which a line is clear of an edge; one more may seem whole."""

MIN_STRIPE_SHARE = 0.02
"""Shares are not trusted better: what else lights the lines about an edge."""

MIN_CONTRAST = 0.03
"""Change of a stripe's brightness from line to line without speckle."""

LINE_SIGMA = 12.0**-0.5
"""A line of an image without any blur still is one wide."""

MIN_SIGMA = 0.1
"""No end is known better, in lines: an edge is rounded and has burrs."""

SEARCH_STEP, STEP, HALF_STEPS = 0.5, 0.1, 60
"""An end is searched in steps of so many lines; its posterior is summed in finer ones about the best."""

MAX_EXCESS = 60.0
"""Excess of -2 ln of a likelihood beyond which a place counts for nothing: a weight of e^-30."""

MIN_LINES, MAX_VARIANCE_SHARE = 3, 0.1
"""Fewer lines tell no end, nor do lines that leave more of the variance that it had before they were read."""

SPREAD = 0.1
"""Light of a grain of speckle in the last lines beyond them, over the contrast: it is no bell."""

TINY_PX = 1e-6
"""Stripes that lie so near to each other are one."""

SIDE_SHARE, SEEN_SIDE_SHARE, SIDE_CORRELATION = 0.1, 0.2, 0.9
"""1 sigma of the share that the upright side between two stripes shines of them, and its correlation.

Seen from beside, a side that the laser or light between the faces reaches has 0.05 to 0.2. In lines that it
covers itself a smooth one shows up to a third of a stripe that it mirrors: 0.2 is the rms of what may be.
"""

CENTRE_STEPS = 4
"""A stripe runs by at most a few tenths of a px a line, and so does an edge: each step leaves a tenth."""


class StripeEnd(NamedTuple):
    """An end of a stripe, in scan lines, and its 1 sigma; NaN where it is not determined."""

    line: float
    sigma: float


NO_END = StripeEnd(math.nan, math.nan)


@kernel(allocates=True)
def stripe_ends(light: StripeLight, last: int, first: int, seen_lines: float) -> tuple[StripeEnd, StripeEnd]:
    """Return the end of the stripe that is whole in line `last`, and the start of that of line `first`.

    Over `seen_lines` lines between them the camera sees the upright side.
    """
    away, image, begin = 1 if first > last else -1, light, first
    aside = lines_aside(light.edge, light.position_px[first] - light.position_px[last])
    apart = max(apart_px(light, last, first), light.centre_sigma_px, TINY_PX)
    light = along_edge(light, last, first, _reach(light))
    first -= round(aside)
    clear = clear_of_an_edge(light)
    n = away * (first - last) + 2 * clear - 1
    # No edge is looked for between lines that lie farther apart.
    if not 0 < n <= 128:
        return NO_END, NO_END
    shares, variances, room = np.empty((2, n)), np.empty((2, n)), line_room(light.charge_e.shape[1])
    is_seen = line_shares(
        light=light,
        last=last - away * clear,
        first=first + away * clear,
        away=away,
        max_lines=BEYOND,
        reach=clear,
        shares=shares,
        variances=variances,
        room=room,
    )
    if not is_seen:
        return NO_END, NO_END
    # Of a stripe that is off by its scatter the other one seems to have a share.
    more, n_seen = (light.centre_sigma_px / apart) ** 2, 0
    # The other stripe is seen from its own side.
    of_other, other_variances = np.empty(n), np.empty(n)
    for i in range(n):
        variances[0, i] += more
        of_other[n - 1 - i], other_variances[n - 1 - i] = shares[1, i], variances[1, i] + more
        n_seen += not math.isnan(shares[1, i])
    if n_seen == 0:
        return NO_END, NO_END
    # A line's centre says which stripe is the brighter there, so the end is a line off it at most.
    earliest, latest = clear - 2.0, n - clear + 1.0
    ends = _fitted(light, shares[0], variances[0], seen_lines, earliest, latest)
    begins = _fitted(light, of_other, other_variances, seen_lines, earliest, latest)
    next_one = last - away * (clear - 1)
    ends_at, begins_at = next_one + away * ends.line, next_one + away * (n - 1 - begins.line)
    return (
        StripeEnd(_at_centre(image, ends_at, last, last - away * clear, -away), ends.sigma),
        StripeEnd(_at_centre(image, begins_at, last, begin + away * clear, away), begins.sigma),
    )


@kernel(allocates=True)
def stripe_end(light: StripeLight, last: int, away: int, gap_lines: int, unread: int = 0) -> StripeEnd:
    """Return the end of the stripe that is whole in line `last`, before a gap of some lines.

    What is seen deep in the gap, clear of either end or else amid it, is the other stripe; where nothing is,
    there is none. So many lines after `last` are `unread`, and may hold all of it too.
    """
    image, light = light, along_edge(light, last, last + away * gap_lines, _reach(light))
    clear = clear_of_an_edge(light)
    # No more than half of the gap: behind it the stripe begins again.
    n = clear + min(clear + min(unread, clear), (gap_lines + 1) // 2)
    shares, variances, room = np.empty((2, n)), np.empty((2, n)), line_room(light.charge_e.shape[1])
    deep = max(gap_lines - 2 * clear, min(MIN_BEYOND, gap_lines))
    first = last + away * (1 + (gap_lines - deep) // 2)
    is_seen = line_shares(
        light=light,
        last=last - away * clear,
        first=first,
        away=away,
        max_lines=deep,
        reach=clear,
        shares=shares,
        variances=variances,
        room=room,
    )
    if not is_seen:
        return NO_END
    # Beside a gap a line that holds little of the stripe shows its centre too.
    ends = _fitted(light, shares[0], variances[0], 0.0, 0.0, n - 1.0)
    ends_at = last - away * (clear - 1) + away * ends.line
    return StripeEnd(_at_centre(image, ends_at, last, last - away * clear, -away), ends.sigma)


@kernel
def _at_centre(light: StripeLight, line: float, along: int, of_run: int, away: int) -> float:
    """Return the line of the image in which an edge crosses a stripe's centre.

    `line` is where the edge crosses the position of the stripe of line `along`. The stripe runs through those
    of lines from `of_run` on, in steps of `away`.
    """
    if light.edge.stated < NEXT_TO_NOTHING:
        return line
    begin_px, slope = run_of(light.position_px, of_run, away, BEYOND)
    crossing = line
    for _ in range(CENTRE_STEPS):
        centre_px = begin_px + slope * (crossing - of_run)
        crossing = line + lines_aside(light.edge, centre_px - light.position_px[along])
    return crossing


@kernel
def clear_of_an_edge(light: StripeLight) -> int:
    """Return the number of lines from an edge to one that is clear of it."""
    return clear_lines(light.psf_sigma_px, light.edge.stated)


@kernel
def _reach(light: StripeLight) -> int:
    """Return the number of lines that are read beyond those next to an edge."""
    return clear_of_an_edge(light) + BEYOND + math.ceil(WINDOW_SIGMAS * light.edge.stated)


@kernel
def clear_lines(psf_sigma_px: float, sheet_lines: float) -> int:
    """Return `clear_of_an_edge` for an edge that crosses the sheet's sigma over so many lines."""
    return math.ceil(CLEAR_SIGMAS * math.hypot(psf_sigma_px, sheet_lines)) + 1


@kernel(allocates=True)
def _fitted(
    light: StripeLight,
    shares: Float64,
    variances: Float64,
    seen_lines: float,
    earliest: float,
    latest: float,
) -> StripeEnd:
    """Return the end of shares (n,) of a light's stripe, in lines from the first.

    It lies between `earliest` and `latest`, or beyond them by the blur's sigma.
    """
    contrast = max(light.contrast, MIN_CONTRAST)
    sigma = max(math.hypot(light.psf_sigma_px, light.edge.stated / math.sqrt(2.0)), LINE_SIGMA)
    first, last = max(earliest - sigma, 0.0), latest + sigma
    read = LineShares(shares, variances, contrast, light.correlation, seen_lines, sigma)
    line, line_sigma = fit_end(read, first, last)
    return StripeEnd(line, line_sigma)


class LineShares(NamedTuple):
    """Shares (n,) of a stripe that lines hold about its end, and their variances (n,).

    The stripe's brightness scatters by a relative `contrast`, with a `correlation` from line to line. Over
    `seen_lines` the camera sees the upright side; the end is blurred by `sigma` lines.
    """

    share: Float64
    variance: Float64
    contrast: float
    correlation: float
    seen_lines: float
    sigma: float


class EndMisfit(NamedTuple):
    """-2 ln of the likelihood of an end at a place, but for a constant, and its chi^2 over so many lines."""

    misfit: float
    chi2: float
    lines: int


@kernel
def end_misfit(read: LineShares, end: float) -> EndMisfit:
    """Return how unlike the shares are those of a stripe that ends at a place.

    With the shares' means m a line holds m (1 + a + n) + h g and its own error, of variance V. All lines
    share a: whole lines are known as well as the mean of BEYOND of them is. n scatters by the contrast, with
    a `correlation` from line to line. g, of variance 1, is what the upright side shines, h its 1 sigma:
    SIDE_SHARE of 1 - m and, where the side covers the line, SEEN_SIDE_SHARE of that. V goes with the place,
    so ln V counts.
    """
    share, correlation, seen_lines, sigma = read.share, read.correlation, read.seen_lines, read.sigma
    scatter = read.contrast * read.contrast
    of_mean = scatter * min((1.0 + correlation) / (1.0 - correlation) / BEYOND, 1.0)
    spread_2 = MIN_STRIPE_SHARE**2 + SPREAD**2 * scatter
    whole, line, side = 0.0, 0.0, 0.0
    P_ww, P_wl, P_ws, P_ll, P_ls, P_ss = of_mean, 0.0, 0.0, scatter, 0.0, 1.0
    chi2, determinant, lines = 0.0, 0.0, 0
    for i in range(share.shape[0]):
        if i > 0:
            line, side = correlation * line, SIDE_CORRELATION * side
            P_wl, P_ws, P_ls = (
                correlation * P_wl,
                SIDE_CORRELATION * P_ws,
                correlation * SIDE_CORRELATION * P_ls,
            )
            P_ll = correlation * correlation * P_ll + (1.0 - correlation * correlation) * scatter
            P_ss = SIDE_CORRELATION * SIDE_CORRELATION * (P_ss - 1.0) + 1.0
        if math.isnan(share[i]):
            continue
        mean = 0.5 * math.erfc((i - end) / (sigma * math.sqrt(2.0)))
        shine = SIDE_SHARE * (1.0 - mean)
        if seen_lines > 0.0:
            covered = 0.5 * math.erfc((i - end - seen_lines) / (sigma * math.sqrt(2.0))) - mean
            shine = math.hypot(shine, SEEN_SIDE_SHARE * covered)
        of_whole = mean * (P_ww + P_wl) + shine * P_ws
        of_line = mean * (P_wl + P_ll) + shine * P_ls
        of_side = mean * (P_ws + P_ls) + shine * P_ss
        total = mean * (of_whole + of_line) + shine * of_side + read.variance[i] + spread_2
        off = share[i] - mean * (1.0 + whole + line) - shine * side
        chi2 += off * off / total
        determinant += math.log(total)
        lines += 1
        whole += of_whole * off / total
        line += of_line * off / total
        side += of_side * off / total
        P_ww -= of_whole * of_whole / total
        P_wl -= of_whole * of_line / total
        P_ws -= of_whole * of_side / total
        P_ll -= of_line * of_line / total
        P_ls -= of_line * of_side / total
        P_ss -= of_side * of_side / total
    return EndMisfit(chi2 + determinant, chi2, lines)


@kernel(allocates=True)
def fit_end(read: LineShares, earliest: float, latest: float) -> tuple[float, float]:
    """Return the place at which shares fall from 1 to 0, lines from the first, and its 1 sigma.

    It is the mean and the deviation of the posterior, each place between `earliest` and `latest` as likely
    before. NaN where fewer than MIN_LINES tell it, where they tell little beyond these bounds, and where they
    tell a place outside. There is none between bounds that are crossed: an edge askew puts one plate before
    the other's end.
    """
    if not earliest < latest:
        return math.nan, math.nan
    best, min_misfit = math.nan, math.inf
    n_places = int((latest - earliest) / SEARCH_STEP) + 3
    misfits = np.empty(n_places)
    for k in range(n_places):
        place = earliest + (k - 1) * SEARCH_STEP
        fit = end_misfit(read, place)
        misfits[k] = fit.misfit
        if fit.lines >= MIN_LINES and fit.misfit < min_misfit:
            best, min_misfit = place, fit.misfit
    # Another light that ends elsewhere is not this one; one that is likeliest at a bound ends beyond it.
    if not earliest + SEARCH_STEP <= best <= latest - SEARCH_STEP:
        return math.nan, math.nan
    total, first, second = 0.0, 0.0, 0.0
    for k in range(-HALF_STEPS, HALF_STEPS + 1):
        off = k * STEP
        if earliest <= best + off <= latest:
            before = min(int((best + off - earliest) / SEARCH_STEP) + 1, n_places - 2)
            if min(misfits[before], misfits[before + 1]) > min_misfit + MAX_EXCESS:
                continue
            fit = end_misfit(read, best + off)
            weight = math.exp(-0.5 * (fit.misfit - min_misfit))
            total += weight
            first += weight * off
            second += weight * off * off
    mean = first / total
    posterior = max(second / total - mean * mean, 0.0)
    if posterior > MAX_VARIANCE_SHARE * (latest - earliest) ** 2 / 12.0:
        return math.nan, math.nan
    fit = end_misfit(read, best + mean)
    freedom = fit.lines - 2.0
    # Only what chi2 shows beyond its own scatter widens the sigma.
    excess = max(fit.chi2 / freedom - math.sqrt(2.0 / freedom), 1.0)
    return best + mean, math.sqrt(excess * posterior + MIN_SIGMA**2)

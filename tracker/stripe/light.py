"""Evidence of a stripe in the light of single scan lines, and of another one next to it.

Beside an edge the arc's light changes abruptly too, and where it does is known to a line at best: what is
taken for background may be the next line's. So a share's variance is that of its pixels' noise, times the
chi^2 that they leave, and the square of what half the neighbours' difference in background adds to it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median

BEYOND = 6
"""Number of lines on either side that determine the stripe's look there, and their least number."""

MIN_BEYOND = 3

WINDOW_SIGMAS = 3.0
"""A line is read so many stripe sigmas beyond where either stripe runs."""

MIN_PIXELS = 8

OUTSHINES = 2.0
"""A saturated pixel so many times as bright as the stripes there is another light's: its halo is no level.

Chosen: a grain of speckle seldom is. From 1.5 to 4 the frames with glints and streaks that were looked at say
the same.
"""

NEXT_TO_NOTHING = 0.1
"""Share of a sigma below which an error adds half a percent to it."""


class EdgeLines(NamedTuple):
    """Crossing of an edge along the expected seam with the stripe, in scan lines.

    At p px across the stripe it is `skew` p + `bend` p^2 lines away. Over the sheet's sigma it moves by
    `stated` lines, which are known to a 1 sigma of `turned`.
    """

    skew: float
    bend: float
    stated: float
    turned: float


class StripeLight(NamedTuple):
    """Light that a stripe was read from, (n_scan, n_pos) of a band that begins at `lows` for each CELL lines.

    A pixel's variance is `shot` times its light, `background_e` and the stripe's, plus `dark_variance_e2`.
    `position_px`, `width_px` (n_scan,) are the stripe's. `contrast` is by how much its
    brightness scatters from line to line, relative, `correlation` that of two neighbouring lines in
    that, `psf_sigma_px` the optics' sigma, `centre_sigma_px` the 1 sigma of centres.
    `edge` is how an edge along the seam crosses it.
    """

    charge_e: Float32
    background_e: Float32
    censored: Bool
    lows: Int64
    position_px: Float64
    width_px: Float64
    shot: float
    dark_variance_e2: float
    contrast: float
    correlation: float
    psf_sigma_px: float
    edge: EdgeLines
    centre_sigma_px: float


NO_LIGHT = StripeLight(
    charge_e=np.empty((0, 0), np.float32),
    background_e=np.empty((0, 0), np.float32),
    censored=np.empty((0, 0), np.bool_),
    lows=np.empty(0, np.int64),
    position_px=np.empty(0),
    width_px=np.empty(0),
    shot=0.0,
    dark_variance_e2=0.0,
    contrast=0.0,
    correlation=0.0,
    psf_sigma_px=0.0,
    edge=EdgeLines(0.0, 0.0, 0.0, 0.0),
    centre_sigma_px=0.0,
)
"""A stripe whose light is not at hand."""


@kernel
def apart_px(light: StripeLight, last: int, first: int) -> float:
    """Return the distance of two lines' stripes, px."""
    return float(abs(light.position_px[first] - light.position_px[last]))


@kernel
def lines_aside(edge: EdgeLines, across_px: float) -> float:
    """Return by how many lines an edge is away so far across the stripe."""
    return edge.skew * across_px + edge.bend * across_px * across_px


@kernel(allocates=True)
def along_edge(light: StripeLight, last: int, first: int, reach: int) -> StripeLight:
    """Return the light between two lines, and in some beside them, in lines that run along an edge.

    Line s of it holds, so far across the stripe of line `last`, what the image has in the line that
    `lines_aside` away, interpolated between two. So an edge along the seam cuts the stripe, and the arc's
    light beside it, at one line.
    """
    if light.edge.stated < NEXT_TO_NOTHING:
        return light
    n_scan, depth = light.charge_e.shape
    middle_px = light.position_px[last]
    charge_e, background_e = np.empty((n_scan, depth), np.float32), np.empty((n_scan, depth), np.float32)
    censored, position_px = np.ones((n_scan, depth), np.bool_), np.full(n_scan, math.nan)
    begin, end = max(min(last, first) - reach, 0), min(max(last, first) + reach + 1, n_scan)
    for s in range(begin, end):
        low = light.lows[s // CELL]
        if not math.isnan(light.position_px[s]):
            own = s - round(lines_aside(light.edge, light.position_px[s] - middle_px))
            if 0 <= own < n_scan:
                position_px[own] = light.position_px[s]
        for j in range(depth):
            line = s + lines_aside(light.edge, low + j - middle_px)
            k = math.floor(line)
            charge_e[s, j], background_e[s, j] = 0.0, 0.0
            if not 0 <= k < n_scan - 1:
                continue
            i, i_next = low + j - light.lows[k // CELL], low + j - light.lows[(k + 1) // CELL]
            if not (0 <= i < depth and 0 <= i_next < depth):
                continue
            part = line - k
            censored[s, j] = light.censored[k, i] or light.censored[k + 1, i_next]
            charge_e[s, j] = (1.0 - part) * light.charge_e[k, i] + part * light.charge_e[k + 1, i_next]
            here, next_one = light.background_e[k, i], light.background_e[k + 1, i_next]
            background_e[s, j] = (1.0 - part) * here + part * next_one
    return StripeLight(
        charge_e=charge_e,
        background_e=background_e,
        censored=censored,
        lows=light.lows,
        position_px=position_px,
        width_px=light.width_px,
        shot=light.shot,
        dark_variance_e2=light.dark_variance_e2,
        contrast=light.contrast,
        correlation=light.correlation,
        psf_sigma_px=light.psf_sigma_px,
        edge=EdgeLines(0.0, 0.0, light.edge.turned, light.edge.turned),
        centre_sigma_px=light.centre_sigma_px,
    )


@kernel
def run_of(position_px: Float64, begins: int, away: int, max_lines: int) -> tuple[float, float]:
    """Return the straight line, its value at line `begins` and slope by lines, that some positions run on.

    They are BEYOND, or `max_lines` if that is less, from `begins` on in steps of `away`; NaN where fewer than
    MIN_BEYOND of them hold a stripe.
    """
    n, sum_x, sum_y, sum_xx, sum_xy = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(min(BEYOND, max_lines)):
        s = begins + away * k
        if not 0 <= s < position_px.shape[0] or math.isnan(position_px[s]):
            continue
        x, y = float(away * k), position_px[s]
        n += 1
        sum_x += x
        sum_y += y
        sum_xx += x * x
        sum_xy += x * y
    if n < MIN_BEYOND:
        return math.nan, math.nan
    slope = (n * sum_xy - sum_x * sum_y) / (n * sum_xx - sum_x * sum_x)
    return (sum_y - slope * sum_x) / n, slope


@kernel
def write_change(background_e: Float32, lows: Int64, s: int, begin: int, end: int, change_e: Float64) -> None:
    """Write the change of the light off the stripe (n_scan, n_pos) within line s, e-.

    It is half of what its neighbours differ by, at pixels from `begin` to `end`, and 0 at the band's rim.
    """
    n_scan, depth = background_e.shape
    change_e[begin:end] = 0.0
    if not 0 < s < n_scan - 1:
        return
    to_before, to_behind = lows[s // CELL] - lows[(s - 1) // CELL], lows[s // CELL] - lows[(s + 1) // CELL]
    first = max(begin, -to_before, -to_behind)
    for j in range(first, min(end, depth - max(0, to_before, to_behind))):
        change_e[j] = 0.5 * (background_e[s + 1, j + to_behind] - background_e[s - 1, j + to_before])


@kernel(allocates=True)
def background_off_px(light: StripeLight, scan: Float64, sigma_px: Float64) -> Float64:
    """Return the shift of the centres of lines (n,), px, if the light off the stripe lies a line off.

    It is 0 where it would be next to nothing against the centre's own 1 sigma (n,), and without a stripe.
    With a bell u(r) of the stripe's sigma w and brightness A, a change d of the background moves the
    least-squares centre by

        sum d t / (A sum t^2),   t = r / w^2 u,   sum t^2 = sqrt(pi) / (2 w).

    All lines have the median A: where the rest of the light is wrong a line's own is wrong too.
    """
    n = scan.shape[0]
    moved, brightness, change_e = np.zeros(n), np.zeros(n), np.empty(light.charge_e.shape[1])
    if light.position_px.shape[0] > 0:
        _write_brightness(light, scan, brightness)
        usual_e = exact_median(brightness)
        if usual_e > 0.0:
            _write_moved(light, scan, sigma_px, usual_e, change_e, moved)
    return moved


@kernel
def _write_brightness(light: StripeLight, scan: Float64, brightness: Float64) -> None:
    """Write the stripe's brightness in lines (n,), e-, by the pixel next to its centre; 0 without one."""
    for i in range(scan.shape[0]):
        s = int(scan[i])
        low, centre, width = light.lows[s // CELL], light.position_px[s], light.width_px[s]
        j = -1 if math.isnan(centre) else round(centre) - low
        brightness[i] = 0.0
        if 0 <= j < light.charge_e.shape[1] and width > 0.0:
            r = (j + low - centre) / width
            brightness[i] = max(light.charge_e[s, j] - light.background_e[s, j], 0.0) * math.exp(0.5 * r * r)


@kernel
def _write_moved(
    light: StripeLight, scan: Float64, sigma_px: Float64, usual_e: float, change_e: Float64, moved: Float64
) -> None:
    """Write the shift of `background_off_px`, of stripes of a brightness."""
    for i in range(scan.shape[0]):
        s = int(scan[i])
        low, centre, width = light.lows[s // CELL], light.position_px[s], light.width_px[s]
        if math.isnan(centre) or not width > 0.0:
            continue
        begin = max(math.floor(centre - WINDOW_SIGMAS * width) - low, 0)
        end = min(math.ceil(centre + WINDOW_SIGMAS * width) - low + 1, light.charge_e.shape[1])
        write_change(light.background_e, light.lows, s, begin, end, change_e)
        lowest, highest = math.inf, -math.inf
        for j in range(begin, end):
            lowest, highest = min(lowest, change_e[j]), max(highest, change_e[j])
        # sum |t| is 2: it cannot be more than this range, which is twice as much as d is off its middle.
        per_e = 2.0 * width / (usual_e * math.sqrt(math.pi))
        if (highest - lowest) * per_e < NEXT_TO_NOTHING * sigma_px[i]:
            continue
        total = 0.0
        for j in range(begin, end):
            r = (j + low - centre) / width
            total += (change_e[j] - 0.5 * (lowest + highest)) * r / width * math.exp(-0.5 * r * r)
        moved[i] = abs(total) * per_e


class LineRoom(NamedTuple):
    """Room for what is known of a line's pixels (n_pos,).

    That is both mean stripes, e-, how many lines tell either, and by how much the background changes, e-.
    """

    u_e: Float64
    v_e: Float64
    n_lines: Float64
    change_e: Float64


@kernel(allocates=True)
def line_room(n_pos: int) -> LineRoom:
    """Make room for a line of a band."""
    return LineRoom(np.empty(n_pos), np.empty(n_pos), np.empty(n_pos), np.empty(n_pos))


@kernel
def write_mean_stripe(
    light: StripeLight,
    run: tuple[int, int, int],
    pixels: tuple[int, int],
    off_px: float,
    mean_e: Float64,
    n_lines: Float64,
) -> None:
    """Write the mean light, e-, of a run of lines to pixels from the first to before the last; NaN for none.

    The `run` is `run_of`'s beginning, step and number of lines. Pixel 0 lies so far off their centres.
    """
    (begins, away, max_lines), (begin, end) = run, pixels
    for j in range(begin, end):
        mean_e[j], n_lines[j] = 0.0, 0.0
    for k in range(min(BEYOND, max_lines)):
        s = begins + away * k
        if not 0 <= s < light.position_px.shape[0] or math.isnan(light.position_px[s]):
            continue
        r = light.position_px[s] - light.lows[s // CELL] + off_px
        shift = math.floor(r)
        part = r - shift
        for j in range(max(begin, -shift), min(end, light.charge_e.shape[1] - 1 - shift)):
            i = j + shift
            if light.censored[s, i] or light.censored[s, i + 1]:
                continue
            here = light.charge_e[s, i] - light.background_e[s, i]
            next_one = light.charge_e[s, i + 1] - light.background_e[s, i + 1]
            mean_e[j] += (1.0 - part) * here + part * next_one
            n_lines[j] += 1.0
    for j in range(begin, end):
        mean_e[j] = mean_e[j] / n_lines[j] if n_lines[j] >= MIN_BEYOND else math.nan


@kernel(allocates=True)
def line_shares(
    light: StripeLight,
    last: int,
    first: int,
    away: int,
    max_lines: int,
    reach: int,
    shares: Float64,
    variances: Float64,
    room: LineRoom,
) -> bool:
    """Write the shares (2, n) of both stripes, and their variances, of the n lines from `last` on.

    `away` is the step, 1 or -1, from `last`, where the first stripe is clear, to `first`, where the other is;
    that is read from `max_lines` lines at most. False if the first is not seen. A line that cannot be read
    has a NaN, so have those within `reach` of one that another light outshines, and so has the other stripe
    everywhere if it is not seen.
    """
    at_last, slope_last = run_of(light.position_px, last, -away, BEYOND)
    at_first, slope_first = run_of(light.position_px, first, away, max_lines)
    alone = math.isnan(at_first)
    width = 0.0
    for s in (last, first):
        if 0 <= s < light.width_px.shape[0] and not math.isnan(light.width_px[s]):
            width = max(width, light.width_px[s])
    if math.isnan(at_last) or width == 0.0:
        return False
    outshone = np.zeros(shares.shape[1], np.bool_)
    for i in range(shares.shape[1]):
        s = last + away * (i + 1)
        shares[:, i], variances[:, i] = math.nan, math.nan
        if not 0 <= s < light.charge_e.shape[0]:
            continue
        low = light.lows[s // CELL]
        upper = at_last + slope_last * (s - last)
        lower = upper if alone else at_first + slope_first * (s - first)
        begin = max(math.floor(min(upper, lower) - WINDOW_SIGMAS * width) - low, 0)
        end = min(math.ceil(max(upper, lower) + WINDOW_SIGMAS * width) - low + 1, light.charge_e.shape[1])
        write_change(light.background_e, light.lows, s, begin, end, room.change_e)
        pixels = begin, end
        write_mean_stripe(light, (last, -away, BEYOND), pixels, low - upper, room.u_e, room.n_lines)
        if alone:
            room.v_e[begin:end] = 0.0
        else:
            write_mean_stripe(light, (first, away, max_lines), pixels, low - lower, room.v_e, room.n_lines)
        n, w_, w_u, w_v, w_c = 0, 0.0, 0.0, 0.0, 0.0
        w_uu, w_uv, w_vv, w_uc, w_vc, w_cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        w_d, w_ud, w_vd = 0.0, 0.0, 0.0
        for j in range(begin, end):
            u, v, d = room.u_e[j], room.v_e[j], room.change_e[j]
            if math.isnan(u) or math.isnan(v):
                continue
            c = light.charge_e[s, j] - light.background_e[s, j]
            if light.censored[s, j]:
                outshone[i] = outshone[i] or c > OUTSHINES * max(u, v, 0.0)
                continue
            lit = max(light.background_e[s, j], 0.0) + max(u, v, 0.0)
            weight = 1.0 / (light.shot * lit + light.dark_variance_e2)
            n += 1
            w_ += weight
            w_u += weight * u
            w_v += weight * v
            w_c += weight * c
            w_uu += weight * u * u
            w_uv += weight * u * v
            w_vv += weight * v * v
            w_uc += weight * u * c
            w_vc += weight * v * c
            w_cc += weight * c * c
            w_d += weight * d
            w_ud += weight * u * d
            w_vd += weight * v * d
        if n < MIN_PIXELS:
            continue
        # The offset c_s is solved for first, the two shares with what it leaves.
        H_uu, H_uv, H_vv = w_uu - w_u * w_u / w_, w_uv - w_u * w_v / w_, w_vv - w_v * w_v / w_
        g_u, g_v = w_uc - w_u * w_c / w_, w_vc - w_v * w_c / w_
        area = H_uu * H_vv - H_uv * H_uv
        if alone:
            if H_uu > 0.0:
                shares[0, i] = g_u / H_uu
                chi2 = max((w_cc - w_c * w_c / w_ - g_u * shares[0, i]) / (n - 2.0), 1.0)
                variances[0, i] = chi2 / H_uu + ((w_ud - w_u * w_d / w_) / H_uu) ** 2
        elif area > 1e-6 * H_uu * H_vv:
            shares[0, i], shares[1, i] = (g_u * H_vv - g_v * H_uv) / area, (g_v * H_uu - g_u * H_uv) / area
            unexplained = w_cc - w_c * w_c / w_ - g_u * shares[0, i] - g_v * shares[1, i]
            chi2 = max(unexplained / (n - 3.0), 1.0)
            d_u, d_v = w_ud - w_u * w_d / w_, w_vd - w_v * w_d / w_
            variances[0, i] = chi2 * H_vv / area + ((d_u * H_vv - d_v * H_uv) / area) ** 2
            variances[1, i] = chi2 * H_uu / area + ((d_v * H_uu - d_u * H_uv) / area) ** 2
    for i in range(shares.shape[1]):
        if outshone[i]:
            shares[:, max(i - reach, 0) : i + reach + 1] = math.nan
    return True

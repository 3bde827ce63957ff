"""Score of the stripe's place along each scan line, by a matched filter, and the likeliest path."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from noise_model.arc.map import CELL
from noise_model.compiled.arrays import Float32, Float64, Int64
from noise_model.compiled.kernel import REDUCTION, kernel
from tracker.stripe.band import weigh

Pair = tuple[float, float]
Room = tuple[Float32, Float32, Float32, Float32, Float32]
"""Scratch, by turns: a template's values and their squares, a line's residuals and variances; and sums."""

TEMPLATE_SIGMAS = 2.5
"""Half-width of the matched filter's template."""

OFFSET_STEP = 2
"""The path is sought on every second pixel, or bin of pixels; the fit starts from there."""

MANY_OFFSETS = 32
"""Least number of offsets that are scored together: fewer take less time one by one."""

TAPS, WHOLE = 8, 32
"""Number of a template's values that are used at a time, and of sums that one loop makes at once."""

GAIN_CAP = 60.0
"""The most that one scan line's evidence counts in the path: a spatter streak cannot buy a detour."""

JUMP_COST, JUMP_COST_CAP, MISSING_COST = 1.0, 12.0, 6.0
"""Path costs in log-likelihood: per 2 px of change against the expected shape, at most, and for no stripe."""


@kernel
def middles(center_px: Float64, lows: Int64, bin_px: int, around_px: Float64) -> None:
    """Write the middles (n_scan,), px, of the bins next to places (n_scan,); the band begins at `lows`."""
    for s in range(center_px.shape[0]):
        first = lows[s // CELL] + 0.5 * (bin_px - 1)
        around_px[s] = first + bin_px * round((center_px[s] - first) / bin_px)


@kernel(inline=True)
def bell(t: np.floating[Any]) -> np.floating[Any]:
    """Return exp(-t^2 / 2), float32, in what LLVM can do for many pixels at once.

    The 16th power of a Taylor sum at a 16th of the exponent: 1e-6 of the bell's height off at most.
    """
    v = max(np.float32(-0.03125) * t * t, np.float32(-1.0))
    b = np.float32(1.0 / 24.0) + v * (np.float32(1.0 / 120.0) + v * np.float32(1.0 / 720.0))
    unity = np.float32(1.0)
    b = unity + v * (unity + v * (np.float32(0.5) + v * (np.float32(1.0 / 6.0) + v * b)))
    b *= b
    b *= b
    b *= b
    return b * b


@kernel(fastmath=REDUCTION)
def write_template(width: float, half: int, template: Float32) -> None:
    """Write a stripe's shape over 2 half + 1 pixels (n,), its mean taken out."""
    inverse, middle, mean = np.float32(1.0 / width), np.float32(half), np.float32(0.0)
    for j in range(template.shape[0]):
        template[j] = bell((np.float32(j) - middle) * inverse)
        mean += template[j]
    mean /= np.float32(template.shape[0])
    for j in range(template.shape[0]):
        template[j] -= mean


@kernel(fastmath=REDUCTION)
def _correlate(template: Float32, residual_e: Float32, variance_e2: Float32) -> Pair:
    """Return a template's (n,) sum over residuals (n,) and that sum's variance; NaN if one of them is."""
    total, noise = np.float32(0.0), np.float32(0.0)
    for j in range(template.shape[0]):
        total += template[j] * residual_e[j]
        noise += template[j] * template[j] * variance_e2[j]
    return float(total), float(noise)


@kernel
def _score_seen(template: Float32, residual_e: Float32, variance_e2: Float32) -> float:
    """Return a template's (n,) sum over residuals that are not NaN, in its sigmas; 0 if there are none."""
    total, noise = 0.0, 0.0
    for j in range(template.shape[0]):
        if not math.isnan(residual_e[j]):
            total += template[j] * residual_e[j]
            noise += template[j] * template[j] * variance_e2[j]
    return total / math.sqrt(noise) if noise > 0.0 else 0.0


@kernel
def _score_each(
    template: Float32, residual_e: Float32, variance_e2: Float32, begin: int, score: Float32
) -> None:
    """Write a line's scores (n,) at offsets of which the first puts the template's first pixel at `begin`."""
    for i in range(score.shape[0]):
        low = begin + OFFSET_STEP * i
        high = low + template.shape[0]
        if low < 0 or high > residual_e.shape[0]:
            score[i] = 0.0
            continue
        residual, variance = residual_e[low:high], variance_e2[low:high]
        total, noise = _correlate(template, residual, variance)
        if math.isnan(total):
            score[i] = _score_seen(template, residual, variance)
        else:
            score[i] = total / math.sqrt(noise) if noise > 0.0 else 0.0


@kernel
def _split(line: Float32, start: int, even: Float32, odd: Float32) -> None:
    """Write a line's pixels from `start` on, by turns, into two arrays (n,), zeros beyond its end."""
    n, m = even.shape[0], min(even.shape[0], (line.shape[0] - start) // 2)
    for i in range(m):
        even[i], odd[i] = line[start + 2 * i], line[start + 2 * i + 1]
    for i in range(m, n):
        pixel = start + 2 * i
        even[i], odd[i] = line[pixel] if pixel < line.shape[0] else np.float32(0.0), np.float32(0.0)


@kernel(fastmath=REDUCTION)
def _add_taps(taps: Float32, line: Float32, sums: Float32) -> None:
    """Add to sums (n,) TAPS neighbours of a line each, times so many taps."""
    a, b, c, d, e, f, g, h = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5], taps[6], taps[7]
    for i in range(sums.shape[0]):
        sums[i] += (
            a * line[i]
            + b * line[i + 1]
            + c * line[i + 2]
            + d * line[i + 3]
            + e * line[i + 4]
            + f * line[i + 5]
            + g * line[i + 6]
            + h * line[i + 7]
        )


@kernel(fastmath={"contract"})
def _in_sigmas(total: Float32, noise: Float32, score: Float32) -> None:
    """Write sums (n,) over their own sigma, 0 where that is none."""
    for i in range(total.shape[0]):
        score[i] = total[i] / np.sqrt(noise[i]) if noise[i] > np.float32(0.0) else np.float32(0.0)


@kernel
def _score_together(
    template: Float32, residual_e: Float32, variance_e2: Float32, begin: int, room: Room, score: Float32
) -> None:
    """Write the same scores (n,), by turns of the template's values: neighbouring offsets read neighbours."""
    taps, squares, residuals, variances, sums = room
    length, n_offsets = template.shape[0], score.shape[0]
    taps[:] = 0.0
    squares[:] = 0.0
    for j in range(length):
        taps[j % 2, j // 2], squares[j % 2, j // 2] = template[j], template[j] * template[j]
    # Which offsets keep the template within the line.
    first = max((1 - begin) // OFFSET_STEP, 0)
    last = min((residual_e.shape[0] - length - begin) // OFFSET_STEP + 1, n_offsets)
    n = max(last - first, 0)
    score[:] = 0.0
    if n == 0:
        return
    start = begin + OFFSET_STEP * first
    _split(residual_e, start, residuals[0], residuals[1])
    _split(variance_e2, start, variances[0], variances[1])
    # What lies behind the n sums counts for nothing, and whole loops take less time.
    n_whole = WHOLE * ((n + WHOLE - 1) // WHOLE)
    totals, noises = sums[0][:n_whole], sums[1][:n_whole]
    totals[:] = 0.0
    noises[:] = 0.0
    for turn in range(2):
        for j in range(0, (length + 1 - turn) // 2, TAPS):
            _add_taps(taps[turn][j : j + TAPS], residuals[turn][j:], totals)
            _add_taps(squares[turn][j : j + TAPS], variances[turn][j:], noises)
    _in_sigmas(totals[:n], noises[:n], score[first:last])
    for i in range(n):
        if math.isnan(totals[i]):
            low = start + OFFSET_STEP * i
            high = low + length
            score[first + i] = _score_seen(template, residual_e[low:high], variance_e2[low:high])


@kernel
def _halve(pixels: Float32, n: int, sums: Float32) -> None:
    """Write the sums of every two of the first n pixels, the last one alone left out."""
    for i in range(n // 2):
        sums[i] = pixels[2 * i] + pixels[2 * i + 1]


@kernel(allocates=True)
def matched_filter(
    charge_e: Float32,
    background_e: Float32,
    shot: float,
    dark_variance_e2: float,
    around_px: Float64,
    width_px: Float64,
    lows: Int64,
    offsets_px: Int64,
    bin_px: int,
    score: Float32,
) -> None:
    """Score a stripe of the expected width at offsets from its expected place, in sigmas of its amplitude.

    `charge_e`, `background_e` (n_scan, depth) hold the pixels and what lights them apart from the laser; see
    `band.weigh` for their variance. They are summed by `bin_px`, a power of two. `around_px` (n_scan,) are
    the bins' `middles` next to the expected places, `width_px` (n_scan,) expected sigmas; `score` (n_scan,
    n_offsets). The template's mean is taken out, so a wrong level of the map scores nothing. `offsets_px` are
    whole bins, OFFSET_STEP bins apart.
    """
    n_offsets = score.shape[1]
    widest = 0.0
    for s in range(width_px.shape[0]):
        widest = max(widest, width_px[s])
    max_offset = math.ceil(TEMPLATE_SIGMAS * widest / bin_px)
    values = np.empty(2 * max_offset + 1, dtype=np.float32)
    n_taps, n_sums = TAPS * (max_offset // TAPS + 1), WHOLE * (n_offsets // WHOLE + 1)
    room = (
        np.empty((2, n_taps), dtype=np.float32),
        np.empty((2, n_taps), dtype=np.float32),
        np.zeros((2, n_sums + n_taps), dtype=np.float32),
        np.zeros((2, n_sums + n_taps), dtype=np.float32),
        np.empty((2, n_sums), dtype=np.float32),
    )
    line = np.empty((4, charge_e.shape[1]), np.float32)
    noise = shot, dark_variance_e2
    _score_lines(
        charge_e=charge_e,
        background_e=background_e,
        noise=noise,
        around_px=around_px,
        width_px=width_px,
        lows=lows,
        offsets_px=offsets_px,
        bin_px=bin_px,
        values=values,
        line=line,
        room=room,
        score=score,
    )


@kernel
def _score_lines(
    charge_e: Float32,
    background_e: Float32,
    noise: tuple[float, float],
    around_px: Float64,
    width_px: Float64,
    lows: Int64,
    offsets_px: Int64,
    bin_px: int,
    values: Float32,
    line: Float32,
    room: Room,
    score: Float32,
) -> None:
    """Score all lines, see `matched_filter`: no array is made here, so that none is counted line by line.

    `noise` are the shot noise's share and the dark's variance; `values` take a template, `line` (4, depth) a
    line's residual and its variance, and by turns their sums.
    """
    n_scan, n_offsets = score.shape
    for s in range(n_scan):
        residual_e, variance_e2, other_e, other_e2 = line[0], line[1], line[2], line[3]
        weigh(charge_e[s], background_e[s], *noise, residual_e, variance_e2)
        n, bins = charge_e.shape[1], 1
        while bins < bin_px:
            _halve(residual_e, n, other_e)
            _halve(variance_e2, n, other_e2)
            residual_e, other_e, variance_e2, other_e2 = other_e, residual_e, other_e2, variance_e2
            n, bins = n // 2, 2 * bins
        width = width_px[s] / bin_px
        half = math.ceil(TEMPLATE_SIGMAS * width)
        template = values[: 2 * half + 1]
        write_template(width, half, template)
        place = (around_px[s] - lows[s // CELL] - 0.5 * (bin_px - 1)) / bin_px
        begin = round(place) + offsets_px[0] // bin_px - half
        if n_offsets < MANY_OFFSETS:
            _score_each(template, residual_e[:n], variance_e2[:n], begin, score[s])
        else:
            _score_together(template, residual_e[:n], variance_e2[:n], begin, room, score[s])


@kernel(allocates=True)
def best_path(score: Float32, jump_cost: float, choice: Int64) -> None:
    """Find the likeliest path of offsets through the scores (n_scan, n); write its indices, -1 for no stripe.

    Viterbi: the gain is score^2 / 2 (capped), a change to the next offset has a `jump_cost`, a larger one its
    multiple up to a cap, so a step of a lap may be taken, and 'no stripe' is a state of its own.
    """
    n_scan, n = score.shape
    cost = np.zeros(n + 1)
    back = np.empty((n_scan, n + 1), dtype=np.int32)
    reach = np.empty(n)
    source = np.empty(n, dtype=np.int32)
    for s in range(n_scan):
        # Lower envelope of cost[j] + jump_cost |i - j|, in two passes.
        cheapest, cheapest_at = cost[0], 0
        for i in range(n + 1):
            if cost[i] < cheapest:
                cheapest, cheapest_at = cost[i], i
        for i in range(n):
            reach[i], source[i] = cost[i], i
            if i > 0 and reach[i - 1] + jump_cost < reach[i]:
                reach[i], source[i] = reach[i - 1] + jump_cost, source[i - 1]
        for i in range(n - 2, -1, -1):
            if reach[i + 1] + jump_cost < reach[i]:
                reach[i], source[i] = reach[i + 1] + jump_cost, source[i + 1]
        lost = cost[n]
        for i in range(n):
            if cheapest + JUMP_COST_CAP < reach[i]:
                reach[i], source[i] = cheapest + JUMP_COST_CAP, cheapest_at
            gain = 0.0
            if score[s, i] > 0.0:
                gain = min(0.5 * score[s, i] * score[s, i], GAIN_CAP)
            cost[i] = reach[i] - gain
            back[s, i] = source[i]
        if cheapest + JUMP_COST_CAP < lost:
            lost = cheapest + JUMP_COST_CAP
            back[s, n] = cheapest_at
        else:
            back[s, n] = n
        cost[n] = lost - MISSING_COST
    chosen = 0
    for i in range(n + 1):
        if cost[i] < cost[chosen]:
            chosen = i
    for s in range(n_scan - 1, -1, -1):
        choice[s] = chosen if chosen < n else -1
        chosen = back[s, chosen]


@kernel
def peaks(score: Float32, choice: Int64, around_px: Float64, offsets_px: Int64, start_px: Float64) -> None:
    """Write the start of each scan line's fit (n_scan,), px: the peak of the score that the path is on.

    The score's `offsets_px` (n,) are from `around_px` (n_scan,). The path is as content anywhere on a strong
    stripe's score. From there the way leads uphill, and between offsets along the parabola through the
    highest three. NaN for no stripe.
    """
    n_scan, n = score.shape
    for s in range(n_scan):
        peak = choice[s]
        if peak < 0:
            start_px[s] = math.nan
            continue
        up = 1 if peak + 1 < n and score[s, peak + 1] > score[s, peak] else -1
        while 0 <= peak + up < n and score[s, peak + up] > score[s, peak]:
            peak += up
        between = 0.0
        if 0 < peak < n - 1:
            before, here, after = score[s, peak - 1], score[s, peak], score[s, peak + 1]
            curve = 2.0 * here - before - after
            between = 0.5 * (after - before) / curve * (offsets_px[1] - offsets_px[0]) if curve > 0.0 else 0.0
        start_px[s] = around_px[s] + offsets_px[peak] + between

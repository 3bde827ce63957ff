"""Is it a stripe, and is all of it in the image? Asked of the matched filter's scores.

A laser only adds light; what the arc's map misses has either sign. So what mimics a stripe is as often dark
as bright, and a scan line's darkest place is the control that says how much such evidence is worth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from noise_model.compiled.arrays import Bool, Float32, Float64, Int64
from noise_model.compiled.kernel import kernel
from noise_model.compiled.median import exact_median, finite_median
from tracker.stripe.expected import ExpectedStripe
from tracker.stripe.scatter import width_factor
from tracker.stripe.viterbi import GAIN_CAP, OFFSET_STEP, TEMPLATE_SIGMAS, write_template

LOBE, LOBE_MARGIN = 0.7, 1.5
"""A place that is dark by a smaller share of the stripe's score is no dark stripe.

Beside the stripe lie its own lobes in the matched filter: there the share is so many times that of the lobes,
if that is more. A stripe that is hardly wider than a pixel has lobes as strong as its score.
"""

PHASES, SMOOTH_PX = 4, 4.0
"""Places within a pixel at which a stripe's lobes are looked at; one is enough for wider stripes."""

CHANCE_SIGMAS = 4.0
"""A place that is no darker than this may be noise."""

MIN_RATIO = 3.0
"""Factor of the evidence for a bright stripe over that for a dark one."""

MIN_SEEN, CLEAR_SIGMAS = 0.5, 10.0
"""In so large a share of the scan lines that would show it by so many sigmas a stripe must be found."""

WEAK = 0.25
"""There it may have this share of the light that it has in the lines that hold it, in the median."""

ABSENT_COST = 3.0
"""Weight, in lines that show the stripe, of one that would and does not, where a fan's ends are sought.

So at least three in four of these lines hold it between the ends.
"""

MIN_FAN_SHARE = 1.0 / 3.0
"""A fan that lights a smaller share of the joint's scan lines must be stated: a scratch may light as many."""


@kernel(allocates=True)
def path_of(offsets_px: Int64, bin_px: int, around_px: Float64, position_px: Float64) -> Int64:
    """Return the offsets' indices (n_scan,) of stripe centres (n_scan,), -1 for none and beyond the offsets.

    Those are from `around_px` (n_scan,), OFFSET_STEP bins apart. A centre may lie off the offsets where a
    fit has moved it: the score at the last one is its flank's.
    """
    n = position_px.shape[0]
    path = np.empty(n, dtype=np.int64)
    for s in range(n):
        path[s] = -1
        if math.isfinite(position_px[s]):
            i = round((position_px[s] - around_px[s] - offsets_px[0]) / (OFFSET_STEP * bin_px))
            if 0 <= i < offsets_px.shape[0]:
                path[s] = i
    return path


@kernel(allocates=True)
def own_lobes(width: float) -> tuple[float, int]:
    """Return a stripe's darkest lobe in its own matched filter over its score, and how far lobes reach, bins.

    The `width` counts bins too. Scores are OFFSET_STEP apart: the stripe's may be seen half a step off its
    peak, its lobe at their worst.
    """
    half = math.ceil(TEMPLATE_SIGMAS * width)
    template = np.empty(2 * half + 1, dtype=np.float32)
    write_template(width, half, template)
    reach = 2 * half + 1
    min_total, worst = math.inf, 0.0
    # It looks the same to either side, and a wide stripe's lobes are as smooth.
    phases = PHASES if width < SMOOTH_PX else 1
    for k in range(phases * reach + 1):
        off, total = k / phases, 0.0
        for j in range(-half, half + 1):
            total += template[j + half] * math.exp(-0.5 * ((j - off) / width) ** 2)
        worst = max(worst, -total)
        if abs(off) <= 0.5 * OFFSET_STEP:
            min_total = min(min_total, total)
    return worst / min_total, reach


@kernel(allocates=True)
def evidence_ratio(score: Float32, path: Int64, shown: Bool, width: float) -> float:
    """Return the evidence for a stripe over that for a dark one, which no laser makes; inf if that is none.

    `score` (n_scan, n_offsets) is the matched filter's, in sigmas, `path` (n_scan,) where along it a stripe
    was found, -1 for none, `shown` (n_scan,) which lines may hold one, `width` the stripe's sigma, bins.
    Evidence is the path's gain, score^2 / 2 with its cap: for a stripe where one was found, for a dark one at
    each scan line's darkest place, unless that may be a lobe of the stripe, or of its like just out of sight
    where none was found.
    """
    worst, reach = own_lobes(width)
    lobe = max(LOBE, LOBE_MARGIN * worst)
    bright, dark, total, held = 0.0, 0.0, 0.0, 0
    for s in range(score.shape[0]):
        if path[s] >= 0:
            seen = max(float(score[s, path[s]]), 0.0)
            bright += min(0.5 * seen * seen, GAIN_CAP)
            total += seen
            held += 1
    typical = total / max(held, 1)
    for s in range(score.shape[0]):
        if path[s] < 0 and not shown[s]:
            continue
        evidence, depth = float(score[s, path[s]]) if path[s] >= 0 else typical, 0.0
        for i in range(score.shape[1]):
            is_near = path[s] < 0 or abs(i - path[s]) * OFFSET_STEP <= reach
            if -score[s, i] > (lobe if is_near else LOBE) * evidence:
                depth = max(depth, -float(score[s, i]))
        if depth > CHANCE_SIGMAS:
            dark += min(0.5 * depth * depth, GAIN_CAP)
    return bright / dark if dark > 0.0 else math.inf


@kernel(allocates=True)
def seen_share(
    expected: ExpectedStripe,
    position_px: Float64,
    amplitude_e: Float64,
    background_e: Float32,
    shot: float,
    dark_variance_e2: float,
    censored: Bool,
    seeks_ends: bool,
) -> float:
    """Return in which share of the scan lines that would show it clearly a stripe was found; NaN for none.

    `position_px`, `amplitude_e` (n_scan,) are those of the lines that hold it, NaN in the others;
    `background_e` and `censored` (n_scan, depth) are the light and the saturation of the pixels among which
    it was sought, see `band.weigh` for their variance. Of a bell of sigma w the matched filter, whose
    template's mean is taken out, sees A sqrt(0.52 w / V) sigmas. What saturates may hide anything. If it is
    not known where the laser's fan ends (`seeks_ends`), nothing is missed beyond the ends that it shows, and
    what was found there is astray.
    """
    n = position_px.shape[0]
    holds, absent, held_e = np.empty(n, np.bool_), np.empty(n, np.bool_), np.empty(n)
    n_found, n_absent, n_shown = 0, 0, 0
    for s in range(n):
        holds[s] = math.isfinite(position_px[s])
        if holds[s]:
            held_e[n_found] = amplitude_e[s]
            n_found += 1
    if n_found == 0:
        return math.nan
    weak_e = WEAK * exact_median(held_e[:n_found])
    for s in range(n):
        max_e = 0.0
        for j in range(background_e.shape[1]):
            max_e = max(max_e, math.inf if censored[s, j] else np.float64(background_e[s, j]))
        worst_e2 = math.inf if max_e == math.inf else shot * max_e + dark_variance_e2
        is_clear = weak_e * math.sqrt(0.52 * expected.sigma_px[s] / worst_e2) > CLEAR_SIGMAS
        absent[s] = expected.shown[s] and is_clear and not holds[s]
        n_absent += absent[s]
        n_shown += expected.shown[s]
    first, end = fan_ends(holds, absent)
    n_lit, n_dark = 0, 0
    for s in range(first, end):
        n_lit += holds[s]
        n_dark += absent[s]
    if seeks_ends and n_lit >= MIN_FAN_SHARE * n_shown:
        n_found, n_absent = n_lit, n_dark + n_found - n_lit
    return n_found / (n_found + n_absent)


@kernel
def fan_ends(holds: Bool, absent: Bool) -> tuple[int, int]:
    """Return the scan lines (n_scan,) that a fan lights, the first and the one behind the last.

    They are the interval with the largest sum over the lines that hold a stripe, less ABSENT_COST for each
    line that would show it and does not (Kadane; Bentley 1984, Communications of the ACM 27, 865).
    """
    total, lowest, lowest_at, max_rise, first, end = 0.0, 0.0, 0, 0.0, 0, 0
    for s in range(holds.shape[0]):
        total += holds[s] - ABSENT_COST * absent[s]
        if total < lowest:
            lowest, lowest_at = total, s + 1
        if total - lowest > max_rise:
            max_rise, first, end = total - lowest, lowest_at, s + 1
    return first, end


@kernel
def leaves_image(
    position_px: Float64, expected_px: Float64, sigma_px: Float64, shown: Bool, n_pos: int
) -> bool:
    """Return True if the stripe runs off the image: where it was found, or is expected where it was not.

    That is, whether one of the `shown` places (n_scan,) lies within its sigma of the image's ends.
    """
    for s in range(position_px.shape[0]):
        place = position_px[s] if math.isfinite(position_px[s]) else expected_px[s]
        if shown[s] and (place < sigma_px[s] or place > n_pos - 1 - sigma_px[s]):
            return True
    return False


class Evidence(NamedTuple):
    """Evidence that a stripe was read, and all of it.

    `n_saturated` scan lines are saturated, `leaves` says whether it runs off the image, `share` is that of
    the lines which should show it and hold it, `ratio` the evidence over that for a dark one.
    """

    n_saturated: int
    leaves: bool
    share: float
    ratio: float


@kernel(allocates=True)
def evidence_of(
    position_px: Float64,
    saturated: Bool,
    expected_px: Float64,
    sigma_px: Float64,
    shown: Bool,
    n_pos: int,
    score: Float32,
    around_px: Float64,
    offsets_px: Int64,
    bin_px: int,
    learned: Float64,
    room: Float32,
) -> Evidence:
    """Return the evidence of stripe centres (n_scan,), read at offsets of the `score` (n_scan, n_offsets).

    These are from `around_px` (n_scan,), in bins of `bin_px`. What is expected is `ExpectedStripe`'s; `room`
    (`numbers_for(n_scan)`,) is written over.
    """
    n_saturated, n_held, n_shown = 0, 0, 0
    for s in range(position_px.shape[0]):
        n_saturated += saturated[s]
        n_held += math.isfinite(position_px[s])
        n_shown += shown[s]
    leaves = leaves_image(position_px, expected_px, sigma_px, shown, n_pos)
    width = finite_median(sigma_px, room) * width_factor(learned) / bin_px
    ratio = evidence_ratio(score, path_of(offsets_px, bin_px, around_px, position_px), shown, width)
    return Evidence(n_saturated, leaves, n_held / max(n_shown, 1), ratio)

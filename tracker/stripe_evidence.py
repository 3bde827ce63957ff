"""Is it a stripe, is it the only one, and is all of it in the image? Asked of the matched filter's scores.

A laser only adds light; what the arc's map misses has either sign. So what mimics a stripe is as often dark
as bright, and a scan line's darkest place is the control that says how much such evidence is worth.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from noise_model.frames import Float64
from noise_model.kernel import kernel
from tracker.expected import ExpectedStripe
from tracker.stripe_path import GAIN_CAP, OFFSET_STEP, Float32, Int64

LOBE = 0.7
"""A stripe's own dark lobes in the matched filter, beside it, stay below this share of its score (0.46)."""

CHANCE_SIGMAS = 4.0
"""A place that is no darker than this may be noise."""

LEAST_RATIO = 3.0
"""So many times the evidence for a dark stripe must be there for a bright one."""

GHOST_SIGMAS, GHOST_SCORE, GHOST_SHARE = 4.0, 0.5, 0.6
"""A second stripe stands at least so many widths off the first and reaches this share of its score, in this
share of the scan lines that hold the first."""

GHOST_LINES = 8
"""Every so many scan lines are asked for it."""


@kernel(allocates=True)
def path_of(offsets_px: Int64, expected_px: Float64, position_px: Float64) -> Int64:
    """Return the offsets' indices (n_scan,) of stripe centres (n_scan,), -1 where there is none."""
    n = position_px.shape[0]
    at, last = np.empty(n, dtype=np.int64), offsets_px.shape[0] - 1
    for s in range(n):
        at[s] = -1
        if math.isfinite(position_px[s]):
            off = position_px[s] - round(expected_px[s]) - offsets_px[0]
            at[s] = min(max(round(off / OFFSET_STEP), 0), last)
    return at


@kernel
def evidence_ratio(score: Float32, at: Int64, shown: npt.NDArray[np.bool_]) -> float:
    """Return the evidence for a stripe over that for a dark one, which no laser makes; inf if that is none.

    `score` (n_scan, n_offsets) is the matched filter's, in sigmas, `at` (n_scan,) where along it a stripe was
    found, -1 for none, `shown` (n_scan,) which lines may hold one. Evidence is the path's gain, score^2 / 2
    with its cap: for a stripe where one was found, for a dark one at each scan line's darkest place, unless
    that may be a lobe of the stripe, or of its like just out of sight where none was found.
    """
    bright, dark, total, held = 0.0, 0.0, 0.0, 0
    for s in range(score.shape[0]):
        if at[s] >= 0:
            found = max(float(score[s, at[s]]), 0.0)
            bright += min(0.5 * found * found, GAIN_CAP)
            total += found
            held += 1
    typical = total / max(held, 1)
    for s in range(score.shape[0]):
        if at[s] < 0 and not shown[s]:
            continue
        darkest = score[s, 0]
        for i in range(score.shape[1]):
            darkest = min(darkest, score[s, i])
        depth, beside = -float(darkest), float(score[s, at[s]]) if at[s] >= 0 else typical
        if depth > max(LOBE * beside, CHANCE_SIGMAS):
            dark += min(0.5 * depth * depth, GAIN_CAP)
    return bright / dark if dark > 0.0 else math.inf


@kernel(allocates=True)
def has_ghost(score: Float32, at: Int64, sigma_px: Float64) -> bool:
    """Say whether a second stripe runs beside the first, alike and parallel: a reflection, a bounce.

    `score` and `at` are those of `evidence_ratio`, `sigma_px` (n_scan,) the stripe's widths. Some of the scan
    lines are asked, and each counts at every shift where it sees the second.
    """
    n_scan, n = score.shape
    there = np.zeros(2 * n - 1, dtype=np.int64)
    held = 0
    for s in range(0, n_scan, GHOST_LINES):
        if at[s] < 0:
            continue
        held += 1
        least = GHOST_SCORE * score[s, at[s]]
        apart = math.ceil(GHOST_SIGMAS * sigma_px[s] / OFFSET_STEP)
        for i in range(n):
            if score[s, i] > least and abs(i - at[s]) >= apart:
                there[i - at[s] + n - 1] += 1
    return bool(held > 0 and there.max() > GHOST_SHARE * held)


def leaves_image(expected: ExpectedStripe, position_px: npt.NDArray[np.float64], n_pos: int) -> bool:
    """Say whether the stripe runs off the image: where it was found, or is expected where it was not."""
    return _leaves(position_px, expected.position_px, expected.sigma_px, expected.shown, n_pos)


@kernel
def _leaves(
    position_px: Float64, expected_px: Float64, sigma_px: Float64, shown: npt.NDArray[np.bool_], n_pos: int
) -> bool:
    """Say whether one of the shown places (n_scan,) lies within its sigma of the image's ends."""
    for s in range(position_px.shape[0]):
        at = position_px[s] if math.isfinite(position_px[s]) else expected_px[s]
        if shown[s] and (at < sigma_px[s] or at > n_pos - 1 - sigma_px[s]):
            return True
    return False

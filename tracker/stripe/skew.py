"""How far a step of brightness that crosses the stripe skewed may draw its centres aside.

At a groove's foot, where one face shines and the next one hardly does, the stripe's brightness steps within a
few lines, along the seam. Where the seam runs skewed through the image, a line beside the step holds more of
the bright side's light on one flank than on the other. A bell of 1 sigma w times exp(b t), t the place across
it, is the same bell b w^2 farther. With A(s) the brightness of the lines s and a step that moves by `lines`
over the bell's sigma, b = lines / w d(ln A)/ds, so a centre is off by

    w lines d(ln A)/ds.

`lines` is known as well as the seam's direction is, so this is an uncertainty and no correction. Speckle
makes lines unlike too, but does not run along the seam: what it explains counts for nothing.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel

STEP_LINES, MIN_HELD = 4, 2
"""The means of so many lines on either side tell a step; of so many at least that hold a stripe."""

STEP_SIGMAS = 3.0
"""By so many sigmas of their scatter both means must differ: one line in 400 does so by chance."""

MIN_CONTRAST = 0.02
"""So much a stripe's brightness changes from line to line without speckle."""


@kernel
def _beside(ln_amplitude: Float64, s: int, away: int) -> tuple[float, float, int]:
    """Return the mean of lines (n,) beside line s, the nearest one's value, and how many hold a stripe."""
    total, nearest, count = 0.0, math.nan, 0
    for k in range(1, STEP_LINES + 1):
        line = s + away * k
        if 0 <= line < ln_amplitude.shape[0] and not math.isnan(ln_amplitude[line]):
            total += ln_amplitude[line]
            if count == 0:
                nearest = ln_amplitude[line]
            count += 1
    return (total / count if count > 0 else math.nan), nearest, count


@kernel(allocates=True)
def skewed_sigma_px(amplitude_e: Float64, width_px: Float64, contrast: float, lines: float) -> Float64:
    """Return by how much a step that crosses the stripe may move each line's centre (n,), px.

    Parameters
    ----------
    amplitude_e, width_px : array (n,)
        The lines' amplitudes, e-, and 1 sigma widths, px; NaN for lines without a stripe.
    contrast : float
        By how much the brightness scatters from line to line, relative.
    lines : float
        By how many lines an edge along the seam may move over the stripe's sigma.
    """
    n, least = amplitude_e.shape[0], max(contrast, MIN_CONTRAST)
    ln_amplitude, sigma_px = np.empty(n), np.zeros(n)
    for s in range(n):
        ln_amplitude[s] = math.log(amplitude_e[s]) if amplitude_e[s] > 0.0 else math.nan
    for s in range(n):
        before, last, n_before = _beside(ln_amplitude, s, -1)
        behind, first, n_behind = _beside(ln_amplitude, s, 1)
        if min(n_before, n_behind) < MIN_HELD or math.isnan(width_px[s]):
            continue
        variance = least * least * (1.0 / n_before + 1.0 / n_behind)
        if (behind - before) ** 2 > STEP_SIGMAS**2 * variance:
            sigma_px[s] = width_px[s] * lines * 0.5 * abs(first - last)
    return sigma_px

"""The Gaussian that fits a stripe best whose light varies much across it, as in a curved, shiny sheet.

Where a metal mirrors the laser for a part of the stripe only, its light across the stripe is no longer an
exponential, and may have two peaks. What a scan line's fit will make of it is then found by such a fit: the
light on some planes beside the sheet's middle, seen where each of them is seen, and the Gaussian

    A exp(-1/2 ((r - r_0) / w)^2),    sum of (light - Gaussian)^2 / V least,    V = Gaussian + peak,

V the noise of a stripe that stands in as much arc light, over the length of line from plane to plane.
"""

from __future__ import annotations

import math

import numpy as np

from noise_model.arrays import Float64
from noise_model.kernel import kernel

PLANES = np.linspace(-3.0, 3.0, 13)
"""Where across the sheet its light is looked at, in its sigmas."""

MAX_STEPS, BELL_SETTLED = 30, 1e-4
"""Gauss-Newton steps at most; one shorter than this, in the stripe's sigmas, is the last."""

MAX_LN = 0.5
"""No width is further off that of the sheet alone."""


@kernel
def fit_bell(place: Float64, light: Float64, width: float, out: Float64) -> bool:
    """Write centre and 1 sigma (2,), px, of the Gaussian that fits light (n,) seen at places (n,), px.

    `width` is the sheet's own 1 sigma, px. False if there is no light, or the Gaussian runs off the places; a
    plane with no light is not looked at.
    """
    n = place.shape[0]
    peak, total, centre = 0.0, 0.0, 0.0
    for k in range(n):
        peak = max(peak, light[k])
        total += light[k]
        centre += light[k] * place[k]
    if not peak > 0.0:
        return False
    r_0, ln_w, A = centre / total, 0.0, peak
    for _ in range(MAX_STEPS):
        w = width * math.exp(ln_w)
        aa, ar, aw, rr, rw, ww = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        g_a, g_r, g_w = 0.0, 0.0, 0.0
        for k in range(n):
            if not light[k] > 0.0:
                continue
            length = 0.5 * abs(place[min(k + 1, n - 1)] - place[max(k - 1, 0)])
            t = (place[k] - r_0) / w
            bell = math.exp(-0.5 * t * t)
            weight = length / (A * bell + peak)
            residual = light[k] - A * bell
            by_r, by_w = A * bell * t, A * bell * t * t
            aa += weight * bell * bell
            ar += weight * bell * by_r
            aw += weight * bell * by_w
            rr += weight * by_r * by_r
            rw += weight * by_r * by_w
            ww += weight * by_w * by_w
            g_a += weight * bell * residual
            g_r += weight * by_r * residual
            g_w += weight * by_w * residual
        # The amplitude is eliminated.
        rr, rw, ww = rr - ar * ar / aa, rw - ar * aw / aa, ww - aw * aw / aa
        g_r, g_w = g_r - ar / aa * g_a, g_w - aw / aa * g_a
        determinant = rr * ww - rw * rw
        if not determinant > 0.0:
            return False
        step_r = (ww * g_r - rw * g_w) / determinant
        step_w = (rr * g_w - rw * g_r) / determinant
        step_r, step_w = min(max(step_r, -0.5), 0.5), min(max(step_w, -0.2), 0.2)
        A = max(A + (g_a - ar * step_r - aw * step_w) / aa, 0.1 * peak)
        r_0 += step_r * w
        ln_w = min(max(ln_w + step_w, -MAX_LN), MAX_LN)
        if abs(step_r) < BELL_SETTLED and abs(step_w) < BELL_SETTLED:
            break
    out[0], out[1] = r_0, width * math.exp(ln_w)
    return bool(min(place[0], place[n - 1]) <= r_0 <= max(place[0], place[n - 1]))

"""Best exposure for a stripe's centre: expected sigma over exposure, and the choice on a ladder.

Per scan line the stripe gives A e-/s at its peak, the background B e-/s. With an exposure t a pixel holds

    mean = t (A g(x) + B),   V = mean + read^2 + quantisation + (m t B)^2,

m the relative uncertainty of the predicted background: it grows with t as the signal does. So a longer
exposure gains against read noise first, then as sqrt(t) against shot noise, then nothing. What reaches the
full well or the highest code carries no information. Motion v across the stripe while it is exposed makes it
wider, w^2 + (v t)^2 / 12, and lower by as much. The information on the centre, the background's slope
unknown, is summed over the lines (`cramer_rao` has the bound with all parameters unknown; amplitude, width
and level are even in x, and leave the centre alone).

A laser that is on for a share d < 1 of the exposure is never better while the exposure can be shortened.
(t, d) and (d t, 1) give the stripe the same charge t d A. The background has t B in the first and d t B in
the second: less shot noise, less uncertainty of the map, less charge towards saturation, and less blur by
motion; read noise is the same. So (d t, 1) is at least as good in each term, and a smaller duty is for the
camera's shortest exposure alone, where the stripe still saturates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.instrument.sensor import Sensor, linearise, variance_e2

NODES = np.linspace(-4.0, 4.0, 33)
"""Nodes across the stripe, in its sigmas."""

SATURATED_SIGMAS = 2.0
"""Distance of a pixel's expected value from the top, in sigmas, within which it is left out: it may be
saturated.
"""


@dataclass(frozen=True)
class ExposurePolicy:
    """Policy of changes of the exposure.

    - `step`: ratio of the ladder (chosen: where shot noise dominates, half a step is 4 % of sigma).
    - `gain`: relative decrease of the expected sigma that warrants a change (chosen: more than half a step).
    - `map_share`: 1 sigma of the predicted background, relative (the arc map's stated uncertainty is 2 to 5
      %).
    """

    step: float = 2.0**0.25
    gain: float = 0.05
    map_share: float = 0.03


POLICY = ExposurePolicy()


def expected_sigma_px(
    exposures_s: Float64,
    peak_e_per_s: Float64,
    width_px: Float64,
    background_e_per_s: Float64,
    sensor: Sensor,
    speed_px_s: float = 0.0,
    map_share: float = POLICY.map_share,
) -> Float64:
    """Return 1 sigma of a displacement common to n scan lines, times sqrt(n), px, at m exposures.

    `peak_e_per_s` (n,) is the stripe's peak over its background, `width_px` (n,) its 1 sigma,
    `background_e_per_s` (n,) the background; `speed_px_s` is the stripe's motion across itself in the image,
    `map_share` 1 sigma of the predicted background, relative. Infinite where no line determines it.
    """
    t = np.asarray(exposures_s, dtype=np.float64)[:, np.newaxis, np.newaxis]
    A, w0, B = (
        np.asarray(v)[np.newaxis, :, np.newaxis] for v in (peak_e_per_s, width_px, background_e_per_s)
    )
    w = np.sqrt(w0**2 + (speed_px_s * t) ** 2 / 12.0)
    g = np.exp(-0.5 * NODES**2)
    peak_e = A * t * w0 / w
    mean_e = peak_e * g + B * t
    variance = variance_e2(mean_e, sensor) + (map_share * B * t) ** 2
    top_e = min(sensor.full_well_e, float(linearise(sensor.max_dn, sensor)))
    held = mean_e + SATURATED_SIGMAS * np.sqrt(variance) < top_e
    weight = held * (w * (NODES[1] - NODES[0])) / variance
    centre, slope = peak_e / w * NODES * g, NODES * w
    of_slope = np.sum(weight * slope**2, axis=2)
    shared = np.sum(weight * centre * slope, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = np.where(of_slope > 0.0, shared**2 / of_slope, 0.0)
        information = np.sum(np.sum(weight * centre**2, axis=2) - lost, axis=1)
        return np.asarray(np.sqrt(A.shape[1] / np.maximum(information, 0.0)))


def ladder_s(min_s: float, max_s: float, step: float = POLICY.step) -> Float64:
    """Return exposures from the least on, each a step longer, up to the most, s."""
    count = 1 + max(0, math.floor(math.log(max_s / min_s) / math.log(step) + 1e-9))
    return np.asarray(min_s * step ** np.arange(count, dtype=np.float64), dtype=np.float64)


def better_exposure_s(
    current_s: float, rungs_s: Float64, sigma_px: Float64, policy: ExposurePolicy = POLICY
) -> float:
    """Return the exposure to take next, s: the current one unless another is better by the policy's gain.

    `rungs_s` (m,) are the candidates; `sigma_px` (m + 1,) is the expected sigma at each, then at the current
    one.
    """
    best = int(np.argmin(sigma_px[:-1]))
    # Written so that where nothing is determined, nothing changes.
    return float(rungs_s[best]) if sigma_px[best] < (1.0 - policy.gain) * sigma_px[-1] else current_s

"""Moments of a pixel's codes: what response, rounding and the ends of the scale make of a normal charge.

With P_k the probability that a charge is read as code k or a higher one,

    <code> = sum_k P_k,   <code^2> = sum_k (2k - 1) P_k,   k = 1, 2 ... ,

so that gamma, a full well, clipping and codes wider than the noise are all followed. What Poisson's light is
more lopsided than a normal distribution is Edgeworth's first term. Where many codes lie
within the noise, h neighbours are taken as one, whose rounding adds (h^2 - 1) / 12 to the variance
(Sheppard 1898, Proc. London Math. Soc. 29, 353).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from noise_model.compiled.arrays import Bool, Float64
from noise_model.instrument.sensor import Sensor, linearise, respond, saturation_dn

REACH_SIGMAS = 7.0
"""Codes further than this from a charge's mean are never read."""


class CodeMoments(NamedTuple):
    """Mean, DN, variance, DN^2, and fourth central moment, DN^4, of pixels' codes (...,)."""

    mean_dn: Float64
    variance_dn2: Float64
    fourth_dn4: Float64


def code_moments(mean_e: Float64, light_e: Float64, sensor: Sensor, is_mixed: Bool) -> CodeMoments:
    """Return the moments of the codes of pixels (...,): Poisson's light, an offset of charge, read noise.

    `mean_e` is light and offset, whose part `light_e` has shot noise. Where it `is_mixed` (...,), pixels of
    all places between two codes go into one mean: rounding then adds its twelfth, however narrow the noise.
    """
    mean = np.atleast_1d(np.asarray(mean_e, dtype=np.float64))[..., np.newaxis]
    light = np.maximum(light_e, 0.0)[..., np.newaxis]
    sigma = np.sqrt(np.maximum(light + sensor.read_noise_e**2, 1e-12))
    top = float(saturation_dn(sensor))
    reach = REACH_SIGMAS * sigma
    low, high = (np.clip(np.rint(respond(mean + sign * reach, sensor)), 0.0, top) for sign in (-1.0, 1.0))
    # Some five steps a sigma where codes are taken together.
    n_steps = 72
    span = (high - low) / n_steps
    # A step of an eighth of a code follows any noise that is measured.
    step = np.where(is_mixed[..., np.newaxis], np.maximum(0.125, span), np.maximum(1.0, np.ceil(span)))
    n = np.arange(1, n_steps + 1)
    borders = low + step * (n - 0.5)
    z = (linearise(np.minimum(borders, top), sensor) - mean) / sigma
    lopsided = light / (6.0 * sigma**3) * (z**2 - 1.0) * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    at_least = np.where(borders < high + 0.5 * step, ndtr(-z) + lopsided, 0.0)
    first, second, third, fourth = (
        np.sum((n**power - (n - 1) ** power) * at_least, axis=-1) for power in (1, 2, 3, 4)
    )
    scale = step[..., 0]
    variance = second - first**2
    central = fourth - 4.0 * first * third + 6.0 * first**2 * second - 3.0 * first**4
    shape = np.shape(mean_e)
    return CodeMoments(
        (low[..., 0] + scale * first).reshape(shape),
        (scale**2 * variance - (scale**2 - 1.0) / 12.0).reshape(shape),
        (scale**4 * central).reshape(shape),
    )

"""Codes of levels of uniform light under a sensor: means, variances and the pixels' common pattern.

A pixel's charge at level s has the mean

    lambda_s (1 + p n) + d n',    n, n' standard normal, fixed for the pixel,

p the photo response non-uniformity (PRNU) and d the dark signal non-uniformity (DSNU, e-). Mean and variance
of the codes are averaged over them by Gauss and Hermite's nodes; to first order the pattern is k_s times the
charge's, k_s the response's slope averaged over the noise.
"""

from typing import NamedTuple

import numpy as np

from calibration.sensor.code_moments import code_moments
from noise_model.compiled.arrays import Float64
from noise_model.instrument.sensor import Sensor, respond

_PLACES, _SHARES = np.polynomial.hermite_e.hermegauss(7)
LIT_NODES = (_PLACES, _SHARES / _SHARES.sum())
_PLACES = np.linspace(-5.0, 5.0, 61)
_SHARES = np.exp(-0.5 * _PLACES**2)
DARK_NODES = (_PLACES, _SHARES / _SHARES.sum())
"""Places and weights over which a pattern is averaged; in the dark it may be wider than the noise, within
which a response with gamma bends."""

MIN_SPREAD = 1e-3
"""The least spread over the nodes, in sigmas of the noise: the slope needs one."""


class Pattern(NamedTuple):
    """Variances of the pattern, DSNU in e-^2 and PRNU relative, and the light's relative shading, 1 sigma."""

    dark_e2: float
    response_rel2: float
    shading_rel: float


class ResponsePrediction(NamedTuple):
    """Means (s,), DN, variances in time (s,), DN^2, the slope (s,), DN/e-, and the pattern (s, s), DN^2.

    `variance_of_variance` (s,), DN^4, is that of one pixel's variance over two frames or more.
    """

    mean_dn: Float64
    variance_dn2: Float64
    slope_dn_per_e: Float64
    pattern_dn2: Float64
    variance_of_variance: Float64


def predict(charge_e: Float64, n_frames: Float64, pattern: Pattern, sensor: Sensor) -> ResponsePrediction:
    """Return the predicted readings of levels of mean charge (s,), each over `n_frames` (s,)."""
    dark, response = max(pattern.dark_e2, 0.0), max(pattern.response_rel2, 0.0)
    noise_e = np.sqrt(charge_e + sensor.read_noise_e**2)
    spread_e = np.sqrt(dark + (response + pattern.shading_rel**2) * charge_e**2)
    spread_e = np.maximum(spread_e, MIN_SPREAD * noise_e)
    is_dark = charge_e == 0.0
    averaged = np.empty((6, len(charge_e)))
    for which, nodes in ((is_dark, DARK_NODES), (~is_dark, LIT_NODES)):
        averaged[:, which] = _average(charge_e[which], spread_e[which], n_frames[which], sensor, nodes)
    mean, variance, slope, variance_of_variance, bent, uneven = averaged
    pattern_dn2 = pattern.dark_e2 + pattern.response_rel2 * np.outer(charge_e, charge_e)
    return ResponsePrediction(
        mean,
        variance,
        slope,
        np.outer(slope, slope) * pattern_dn2 + np.diag(np.where(is_dark, bent, 0.0)),
        variance_of_variance + np.where(is_dark, uneven, 0.0),
    )


def _average(
    charge_e: Float64, spread_e: Float64, n_frames: Float64, sensor: Sensor, nodes: tuple[Float64, Float64]
) -> tuple[Float64, ...]:
    """Return the readings of pixels spread about a charge (s,): see `ResponsePrediction`.

    The last two are the variance over the pixels of their means beyond the slope's, and of their variances.
    """
    places, weights = nodes
    nodes_e = charge_e[:, np.newaxis] + spread_e[:, np.newaxis] * places
    aside = 0.5 * (respond(charge_e + spread_e, sensor) - respond(charge_e - spread_e, sensor))
    # From 0.5 DN on pixels lie everywhere between two codes: exp(-2 pi^2 / 4) is 0.7 %.
    is_mixed = np.broadcast_to((aside > 0.5)[:, np.newaxis], nodes_e.shape)
    # A pixel's offset in the dark has no shot noise.
    light_e = np.where(charge_e[:, np.newaxis] > 0.0, nodes_e, 0.0)
    codes = code_moments(nodes_e, light_e, sensor, is_mixed)
    mean, variance = codes.mean_dn @ weights, codes.variance_dn2 @ weights
    slope = (codes.mean_dn * places) @ weights / spread_e
    frames = n_frames[:, np.newaxis]
    of_variance = (codes.fourth_dn4 - (frames - 3.0) / (frames - 1.0) * codes.variance_dn2**2) / frames
    return (
        mean,
        variance,
        slope,
        of_variance @ weights,
        (codes.mean_dn**2) @ weights - mean**2 - (slope * spread_e) ** 2,
        (codes.variance_dn2**2) @ weights - variance**2,
    )

"""The noise of a reading: a constant part and one that grows with the signal, estimated from scatter."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from noise_model.compiled.arrays import Float64

ROUNDS = 12

MIN_FREEDOM = 1e-6
"""A residual that the fit takes up whole says nothing of the noise."""

FLOOR = 1e-6
"""The least noise, in parts of the largest signal: keeps the weights of noise-free data finite."""


@dataclass(frozen=True)
class ReadingNoise:
    """Variance of a reading: additive_dn^2 + (relative x signal)^2, the signal in DN above black.

    The additive part is the sensor's read noise and rounding; the relative one is the source's flicker, which
    gamma leaves relative. Photon noise lies between both and is covered by their sum over a range of signals;
    it is not a parameter of its own because scatter hardly separates three.
    """

    additive_dn: float
    relative: float

    def __post_init__(self) -> None:
        if not (0 <= self.additive_dn < math.inf and 0 <= self.relative < math.inf):
            raise ValueError(f"a noise of {self.additive_dn} DN and {self.relative}: both must be >= 0")

    def variance(self, signal_dn: Float64) -> Float64:
        """Return the variance (m,), DN^2, of readings of a mean signal (m,)."""
        return np.asarray(self.additive_dn**2 + (self.relative * signal_dn) ** 2)


def estimate_noise(signal_dn: Float64, squares: Float64, freedom: Float64) -> ReadingNoise:
    """Estimate the noise from squares (k,), DN^2, each of a mean `variance` with its degrees of freedom (k,).

    Pooled over all signals by maximum likelihood, squares x freedom / variance being chi-squared: Fisher
    scoring, its linear steps kept non-negative. A setting's own scatter is a poor weight, with 20 repeats
    still 16 % wrong, and weights by it make intervals too narrow.
    """
    return estimate_scatter(signal_dn, squares, freedom, np.zeros_like(squares), np.zeros_like(squares))[0]


def estimate_scatter(
    signal_dn: Float64, squares: Float64, freedom: Float64, shares: Float64, known_dn2: Float64
) -> tuple[ReadingNoise, float]:
    """Estimate the noise as `estimate_noise` does, and the relative scatter between settings.

    The latter adds `shares` (k,) x (between x signal)^2 to a square's mean: 0 within a setting's repeats,
    their number where a mean's error is multiplied by it to be that of a reading. `known_dn2` (k,) is in the
    squares besides.
    """
    used = freedom > MIN_FREEDOM
    signal_dn, squares, freedom, shares, known_dn2 = (
        values[used] for values in (signal_dn, squares, freedom, shares, known_dn2)
    )
    floor = (FLOOR * max(float(np.max(np.abs(signal_dn))), np.finfo(float).tiny)) ** 2
    terms = np.column_stack([np.ones_like(signal_dn), signal_dn**2, shares * signal_dn**2])
    if not shares.any():
        terms = terms[:, :2]
    variance = np.full(len(squares), max(float(np.average(squares, weights=freedom)), floor))
    parts = np.zeros(terms.shape[1])
    for _ in range(ROUNDS):
        weight = np.sqrt(freedom) / variance
        unit = np.linalg.norm(weight[:, np.newaxis] * terms, axis=0)
        parts = nnls(weight[:, np.newaxis] * terms / unit, weight * (squares - known_dn2))[0] / unit
        variance = np.maximum(terms @ parts + known_dn2, floor)
    noise = ReadingNoise(math.sqrt(max(parts[0], floor)), math.sqrt(parts[1]))
    return noise, math.sqrt(parts[2]) if len(parts) > 2 else 0.0


def rounding_left(variance_dn2: Float64) -> Float64:
    """Return the variance (m,), DN^2, that whole grey levels leave in a mean, however many readings it is of.

    Noise of a variance s^2 smears the mean's error, a sawtooth of the level: of its Fourier terms, of mean
    squares 1 / (2 pi^2 k^2), exp(-4 pi^2 k^2 s^2) is left, of all of them 1/12 without noise. `variance_dn2`
    (m,) is that of the whole numbers: s^2 and 1/12.
    """
    # Sixty terms hold all but 1 % of rounding's sawtooth.
    k2 = np.arange(1.0, 61.0)[:, np.newaxis] ** 2
    # Rounding alone has a variance of 1/12.
    smear = np.exp(-4.0 * np.pi**2 * k2 * np.maximum(variance_dn2 - 1.0 / 12.0, 0.0))
    return np.asarray((smear / (2.0 * np.pi**2 * k2)).sum(axis=0))

"""The CCD: electrons to digital numbers and back, and the noise of both (Eq. 20, EMVA 1288).

DN = round(black_level + (full_well / gain) * sign(e) * (|e| / full_well)^gamma), clipped to the code range,
with e = Poisson signal + Gaussian read noise, capped at full well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sensor:
    """The sensor as stated; `gain_e_per_dn` is the slope at full well for gamma 1."""

    bits: int
    gain_e_per_dn: float
    black_level_dn: float
    read_noise_e: float
    full_well_e: float
    gamma: float = 1.0

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16:
            raise ValueError(f"[sensor] bits = {self.bits}: must be 8 to 16")
        for name in ("gain_e_per_dn", "full_well_e", "gamma"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[sensor] {name} = {getattr(self, name)}: must be > 0")
        if not self.read_noise_e >= 0:
            raise ValueError(f"[sensor] read_noise_e = {self.read_noise_e}: must be >= 0")

    @property
    def max_dn(self) -> int:
        """The highest code."""
        return int(2**self.bits - 1)

    @property
    def dtype(self) -> npt.DTypeLike:
        """The frame's pixel type."""
        return np.uint8 if self.bits == 8 else np.uint16


def respond(electrons: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the noise-free, unrounded, unclipped DN of a charge (Eq. 20: G_I = p E^gamma)."""
    e = np.minimum(np.asarray(electrons, dtype=np.float64), sensor.full_well_e)
    scale = sensor.full_well_e / sensor.gain_e_per_dn
    shaped = np.sign(e) * (np.abs(e) / sensor.full_well_e) ** sensor.gamma
    return np.asarray(sensor.black_level_dn + scale * shaped)


def linearise(dn: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the charge in electrons of a DN: the inverse of `respond`, gamma undone."""
    scaled = (np.asarray(dn, dtype=np.float64) - sensor.black_level_dn) * (
        sensor.gain_e_per_dn / sensor.full_well_e
    )
    return np.asarray(sensor.full_well_e * np.sign(scaled) * np.abs(scaled) ** (1.0 / sensor.gamma))


def electrons_per_dn(electrons: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return de/dDN at a charge: the gain for gamma 1.

    For gamma < 1 it vanishes at 0 e and for gamma > 1 it diverges there; the charge is held at one read
    noise (at least one electron) above zero, below which the response is unresolved anyway.
    """
    e = np.maximum(np.abs(np.asarray(electrons, dtype=np.float64)), max(sensor.read_noise_e, 1.0))
    return np.asarray(sensor.gain_e_per_dn / sensor.gamma * (e / sensor.full_well_e) ** (1.0 - sensor.gamma))


def variance_e2(mean_e: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the variance, e-^2, of a linearised pixel whose expected charge is `mean_e`.

    Shot + read + quantisation: max(mean, 0) + read_noise^2 + (de/dDN)^2 / 12 (EMVA 1288, Eq. 10 and 17).
    """
    mean = np.asarray(mean_e, dtype=np.float64)
    step = electrons_per_dn(mean, sensor)
    return np.asarray(np.maximum(mean, 0.0) + sensor.read_noise_e**2 + step**2 / 12.0)


RESPONSE_NODES = 7
"""Gauss-Hermite nodes of a pixel's charge."""


def respond_moments(
    mean_e: npt.ArrayLike, variance_e2: npt.ArrayLike, sensor: Sensor
) -> tuple[Float64, Float64]:
    """Return mean, DN, and variance, DN^2, of what a pixel of this charge reads, rounding included.

    A linear response far from full well keeps mean and variance. Elsewhere, where gamma bends the response or
    full well and the last code cut it, both are taken over a normal distribution of the charge by
    Gauss-Hermite nodes.
    """
    mean = np.asarray(mean_e, dtype=np.float64)
    variance = np.asarray(variance_e2, dtype=np.float64)
    top_e = min(sensor.full_well_e, float(linearise(sensor.max_dn, sensor)))
    bottom_e = float(linearise(0, sensor))
    spread = 4.0 * np.sqrt(variance)
    bent = (mean + spread > top_e) | (mean - spread < bottom_e)
    if sensor.gamma != 1.0:
        bent = np.ones_like(bent)
    of_mean = np.asarray(respond(mean, sensor))
    of_variance = variance / sensor.gain_e_per_dn**2
    if bent.any():
        x, w = np.polynomial.hermite_e.hermegauss(RESPONSE_NODES)
        w = w / w.sum()
        nodes_e = mean[bent] + np.sqrt(variance[bent]) * x[:, np.newaxis]
        dn = np.clip(respond(nodes_e, sensor), 0.0, sensor.max_dn)
        of_mean[bent] = w @ dn
        of_variance[bent] = w @ (dn - of_mean[bent]) ** 2
    return of_mean, of_variance + 1.0 / 12.0


def saturation_dn(sensor: Sensor) -> int:
    """Return the lowest DN that says no more than 'at least this bright'."""
    return min(round(float(respond(sensor.full_well_e, sensor))), sensor.max_dn)


def expose(mean_e: Float64, sensor: Sensor, rng: np.random.Generator) -> npt.NDArray[np.integer]:
    """Draw one frame (DN, the sensor's dtype) of an expected charge: shot noise, read noise, response."""
    e = rng.poisson(np.maximum(mean_e, 0.0)) + rng.normal(0.0, sensor.read_noise_e, np.shape(mean_e))
    dn = np.clip(np.rint(respond(e, sensor)), 0, sensor.max_dn)
    return np.asarray(dn.astype(sensor.dtype))

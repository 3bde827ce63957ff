"""The CCD: electrons to digital numbers and back, and the noise of both (Eq. 20, EMVA 1288).

DN = round(black_level + (full_well / gain) * sign(e) * (y - bend y^2)), y = (|e| / full_well)^gamma,
clipped to the code range, with e = Poisson signal + Gaussian read noise, capped at full well. A stated sensor
has no bend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from noise_model.compiled.arrays import Float64, Integers
from noise_model.compiled.kernel import kernel

BEND_LIMIT = 0.5
"""From here on the response would no longer rise up to full well."""


@dataclass(frozen=True)
class Sensor:
    """The sensor: how charge becomes grey levels.

    Parameters
    ----------
    bits : int
        Bits a pixel, 8 to 16.
    gain_e_per_dn : float
        Charge per grey level, e-/DN: the slope at full well for gamma 1 and no bend.
    black_level_dn : float
        The grey level of no charge, DN.
    read_noise_e : float
        1 sigma of the read noise, e-.
    full_well_e : float
        The charge at which a pixel saturates, e-.
    gamma : float
        The exponent of Eq. 20; 1 is linear.
    bend : float
        How far the response falls short of Eq. 20 at full well, relative. A sensor that fills softly has one.
        Below `BEND_LIMIT` the response rises all the way.

    Raises
    ------
    ValueError
        For a value out of its range; it names the key.
    """

    bits: int
    gain_e_per_dn: float
    black_level_dn: float
    read_noise_e: float
    full_well_e: float
    gamma: float = 1.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16:
            raise ValueError(f"[sensor] bits = {self.bits}: must be 8 to 16")
        for name in ("gain_e_per_dn", "full_well_e", "gamma"):
            if not getattr(self, name) > 0:
                raise ValueError(f"[sensor] {name} = {getattr(self, name)}: must be > 0")
        if not self.read_noise_e >= 0:
            raise ValueError(f"[sensor] read_noise_e = {self.read_noise_e}: must be >= 0")

        if not abs(self.bend) < BEND_LIMIT:
            raise ValueError(f"bend = {self.bend}: must lie between -{BEND_LIMIT} and {BEND_LIMIT}")

    def __str__(self) -> str:
        return (
            f"{self.bits} bit, {self.gain_e_per_dn:g} e-/DN, black {self.black_level_dn:g} DN, "
            f"read noise {self.read_noise_e:g} e-, full well {self.full_well_e:g} e-, gamma {self.gamma:g}"
        )

    @property
    def is_linear(self) -> bool:
        """True if DN over black is proportional to the charge."""
        return self.gamma == 1.0 and self.bend == 0.0

    @property
    def max_dn(self) -> int:
        """The highest code."""
        return int(2**self.bits - 1)

    @property
    def dtype(self) -> npt.DTypeLike:
        """The frame's pixel type."""
        return np.uint8 if self.bits == 8 else np.uint16


def respond(electrons: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the noise-free, unrounded, unclipped DN of a charge (Eq. 20: G_I = p E^gamma, and its bend)."""
    return _unbounded(np.minimum(np.asarray(electrons, dtype=np.float64), sensor.full_well_e), sensor)


def _unbounded(e: Float64, sensor: Sensor) -> Float64:
    """Return the DN of a charge that no full well ends; beyond it a bend goes on as it leaves there."""
    if sensor.is_linear:
        return np.asarray(sensor.black_level_dn + e / sensor.gain_e_per_dn)
    scale = sensor.full_well_e / sensor.gain_e_per_dn
    power = (np.abs(e) / sensor.full_well_e) ** sensor.gamma
    within = np.minimum(power, 1.0)
    bent = power - sensor.bend * within * (2.0 * power - within)
    return np.asarray(sensor.black_level_dn + scale * np.sign(e) * bent)


def linearise(dn: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the charge in electrons of a DN: the inverse of `respond`, bend and gamma undone.

    Up to full well the bend is undone by that root of bend y^2 - y + s = 0 that is s without it, in the form
    that loses no digits there.
    """
    scaled = (np.asarray(dn, dtype=np.float64) - sensor.black_level_dn) * (
        sensor.gain_e_per_dn / sensor.full_well_e
    )
    power = np.abs(scaled)
    if sensor.bend != 0.0:
        within = np.minimum(power, 1.0 - sensor.bend)
        root = 2.0 * within / (1.0 + np.sqrt(1.0 - 4.0 * sensor.bend * within))
        power = root + (power - within) / (1.0 - 2.0 * sensor.bend)
    return np.asarray(sensor.full_well_e * np.sign(scaled) * power ** (1.0 / sensor.gamma))


def electrons_per_dn(electrons: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return de/dDN at a charge: the gain for gamma 1.

    For gamma < 1 it vanishes at 0 e and for gamma > 1 it diverges there; the charge is held at one read
    noise (at least one electron) above zero, below which the response is unresolved anyway.
    """
    e = np.maximum(np.abs(np.asarray(electrons, dtype=np.float64)), max(sensor.read_noise_e, 1.0))
    share = e / sensor.full_well_e
    slope = 1.0 - 2.0 * sensor.bend * np.minimum(share, 1.0) ** sensor.gamma
    return np.asarray(sensor.gain_e_per_dn / (sensor.gamma * slope) * share ** (1.0 - sensor.gamma))


class SensorResponse(NamedTuple):
    """A sensor's noise and response as the kernels take them; see `Sensor`."""

    gain_e_per_dn: float
    read_noise_e: float
    full_well_e: float
    gamma: float
    bend: float

    @classmethod
    def of(cls, sensor: Sensor) -> SensorResponse:
        """Gather a sensor."""
        numbers = (sensor.gain_e_per_dn, sensor.read_noise_e, sensor.full_well_e, sensor.gamma, sensor.bend)
        return cls(*map(float, numbers))


@kernel
def dark_part_e2(mean_e: float, response: SensorResponse) -> float:
    """Return the part of `variance_e2` that is not the light's, at one charge."""
    r = response
    share = max(abs(mean_e), max(r.read_noise_e, 1.0)) / r.full_well_e
    slope = 1.0 - 2.0 * r.bend * min(share, 1.0) ** r.gamma
    step = r.gain_e_per_dn / (r.gamma * slope) * share ** (1.0 - r.gamma)
    return float(r.read_noise_e**2 + step**2 / 12.0)


def variance_e2(mean_e: npt.ArrayLike, sensor: Sensor) -> Float64:
    """Return the variance, e-^2, of a linearised pixel whose expected charge is `mean_e`.

    Shot + read + quantisation: max(mean, 0) + read_noise^2 + (de/dDN)^2 / 12 (EMVA 1288, Eq. 10 and 17).
    """
    mean = np.asarray(mean_e, dtype=np.float64)
    step = electrons_per_dn(mean, sensor)
    return np.asarray(np.maximum(mean, 0.0) + sensor.read_noise_e**2 + step**2 / 12.0)


SMOOTH_FROM = 6.0
"""Distance of a charge from zero, in its sigmas, from which a bent response is smooth over its noise."""

ENDS_WITHIN = 6.0
"""Distance from an end of the scale, in sigmas, within which a reading counts as cut by it."""

TABLE_STEPS = (0.0625, 0.05)
"""Steps of the table of moments near zero charge: in z = mean / sigma and in ln(sigma)."""

TABLE_REACH, TABLE_NODES = 7.0, 32
"""Half-width of that table's integrals, in sigmas of the charge, and the nodes between two kinks."""


def respond_moments(
    mean_e: npt.ArrayLike, variance_e2: npt.ArrayLike, sensor: Sensor
) -> tuple[Float64, Float64]:
    """Return mean, DN, and variance, DN^2, (...,) of what a pixel reads whose charge is normal.

    Rounding adds its twelfth to the variance and nothing to the mean: codes wider than the noise are not
    followed, and where an end of the scale holds a pixel to one code the variance is too large by as much.
    Within `ENDS_WITHIN` sigmas of an end a reading is a normal variable cut there (`cut_moments`). Where
    the response is not straight, three Gauss-Hermite nodes are exact enough as long as the charge lies
    `SMOOTH_FROM` sigmas from zero; nearer, where a power has no slope or an infinite one, moments come from
    a table over mean / sigma and sigma.
    """
    shape = np.shape(mean_e)
    mean = np.atleast_1d(np.asarray(mean_e, dtype=np.float64))
    sigma = np.sqrt(np.maximum(np.asarray(variance_e2, dtype=np.float64), 1e-12)).reshape(mean.shape)
    if sensor.is_linear:
        near_zero = np.zeros(mean.shape, dtype=np.bool_)
        of_mean, of_variance = _unbounded(mean, sensor), (sigma / sensor.gain_e_per_dn) ** 2
    else:
        near_zero = np.abs(mean) < SMOOTH_FROM * sigma
        aside = np.sqrt(3.0) * sigma
        low, middle, high = (_unbounded(e, sensor) for e in (mean - aside, mean, mean + aside))
        of_mean = (low + 4.0 * middle + high) / 6.0
        of_variance = ((low - of_mean) ** 2 + 4.0 * (middle - of_mean) ** 2 + (high - of_mean) ** 2) / 6.0
    top_dn = min(float(respond(sensor.full_well_e, sensor)), float(sensor.max_dn))
    reach = ENDS_WITHIN * np.sqrt(of_variance)
    cut = ~near_zero & ((of_mean + reach > top_dn) | (of_mean < reach))
    if cut.any():
        of_mean[cut], of_variance[cut] = cut_moments(of_mean[cut], of_variance[cut], 0.0, top_dn)
    if near_zero.any():
        of_mean[near_zero], of_variance[near_zero] = _read_table(mean[near_zero], sigma[near_zero], sensor)
    return of_mean.reshape(shape), of_variance.reshape(shape) + 1.0 / 12.0


def cut_moments(mean: Float64, variance: Float64, low: float, high: float) -> tuple[Float64, Float64]:
    """Return mean and variance (...,) of normal variables that are cut to lie from `low` to `high`.

    With a, b the ends in sigmas from the mean, Phi and phi the normal distribution and its density, the
    departure d from the mean has <d> = sigma (a Phi(a) + b Phi(-b) + phi(a) - phi(b)) and
    <d^2> = sigma^2 (a^2 Phi(a) + b^2 Phi(-b) + Phi(b) - Phi(a) + a phi(a) - b phi(b)).
    """
    sigma = np.sqrt(variance)
    a, b = (low - mean) / sigma, (high - mean) / sigma
    below, above = ndtr(a), ndtr(-b)
    at_a, at_b = np.exp(-0.5 * a**2) / np.sqrt(2.0 * np.pi), np.exp(-0.5 * b**2) / np.sqrt(2.0 * np.pi)
    first = a * below + b * above + at_a - at_b
    second = a**2 * below + b**2 * above + (1.0 - below - above) + a * at_a - b * at_b
    return mean + sigma * first, variance * np.maximum(second - first**2, 0.0)


def _read_table(mean: Float64, sigma: Float64, sensor: Sensor) -> tuple[Float64, Float64]:
    """Return the unrounded DN's moments (n,) of charges near zero, linear between a table's nodes."""
    ln_sigma = np.log(sigma)
    # Whole steps: frames with the same noise read the same table.
    first, last = (math.floor(float(end) / TABLE_STEPS[1]) for end in (ln_sigma.min(), ln_sigma.max()))
    place = np.stack([(mean / sigma + SMOOTH_FROM) / TABLE_STEPS[0], ln_sigma / TABLE_STEPS[1] - first])
    table = _table(first, last + 1, sensor)
    of_mean, of_variance = (map_coordinates(values, place, order=1, mode="nearest") for values in table)
    unit = sigma**sensor.gamma
    return sensor.black_level_dn + unit * of_mean, unit**2 * of_variance


@lru_cache(maxsize=32)
def _table(first: int, last: int, sensor: Sensor) -> tuple[Float64, Float64]:
    """Return the unrounded DN's mean over black and variance (n_z, n_sigma) of charges (z + n) sigma.

    n is normal; z lies within `SMOOTH_FROM`, ln(sigma) from the `first` to the `last` whole step. They are in
    units of sigma^gamma and of its square, on which they hardly depend on sigma any more. Gauss-Legendre from
    kink to kink: zero charge, full well and the ends of the scale.
    """
    z = np.arange(-SMOOTH_FROM, SMOOTH_FROM + TABLE_STEPS[0], TABLE_STEPS[0])
    sigma = np.exp(TABLE_STEPS[1] * np.arange(first, last + 1))
    kinks_e = np.array([0.0, sensor.full_well_e, *np.asarray(linearise([0, sensor.max_dn], sensor))])
    edges = np.empty((len(z), len(sigma), len(kinks_e) + 2))
    edges[..., 0], edges[..., -1] = -TABLE_REACH, TABLE_REACH
    edges[..., 1:-1] = kinks_e / sigma[:, np.newaxis] - z[:, np.newaxis, np.newaxis]
    edges = np.sort(np.clip(edges, -TABLE_REACH, TABLE_REACH), axis=-1)
    x, w = np.polynomial.legendre.leggauss(TABLE_NODES)
    half = 0.5 * np.diff(edges)[..., np.newaxis]
    n = 0.5 * (edges[..., 1:] + edges[..., :-1])[..., np.newaxis] + half * x
    weight = half * w * np.exp(-0.5 * n**2)
    weight /= weight.sum(axis=(-2, -1), keepdims=True)
    charge = (z[:, np.newaxis, np.newaxis, np.newaxis] + n) * sigma[:, np.newaxis, np.newaxis]
    over_black = np.clip(respond(charge, sensor), 0.0, sensor.max_dn) - sensor.black_level_dn
    over_black /= sigma[:, np.newaxis, np.newaxis] ** sensor.gamma
    of_mean = np.sum(weight * over_black, axis=(-2, -1))
    departure = over_black - of_mean[..., np.newaxis, np.newaxis]
    return of_mean, np.sum(weight * departure**2, axis=(-2, -1))


def saturation_dn(sensor: Sensor) -> int:
    """Return the lowest DN that says no more than 'at least this bright'."""
    return min(round(float(respond(sensor.full_well_e, sensor))), sensor.max_dn)


def expose(mean_e: Float64, sensor: Sensor, rng: np.random.Generator) -> Integers:
    """Draw one frame (DN, the sensor's dtype) of an expected charge: shot noise, read noise, response."""
    e = rng.poisson(np.maximum(mean_e, 0.0)) + rng.normal(0.0, sensor.read_noise_e, np.shape(mean_e))
    dn = np.clip(np.rint(respond(e, sensor)), 0, sensor.max_dn)
    return np.asarray(dn.astype(sensor.dtype))

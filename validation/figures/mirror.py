"""Mirrors, which the paper has beside its metals: the spike of Eq. 6."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class Mirror:
    """A surface so smooth that it only mirrors, with the reflectance `rho` in (0, 1]."""

    name: str
    rho: float

    def __post_init__(self) -> None:
        if not 0 < self.rho <= 1:
            raise ValueError(f"[material] rho = {self.rho}: a mirror's reflectance lies in (0, 1]")


SUS304 = Mirror("sus304", 1.0)
"""Stainless steel as the paper treats it: Eq. 6 has no reflectance, so rho is 1, relative like the kappas."""


def mirror_direction(omega: Float64, normal: Float64) -> Float64:
    """Return the unit vectors (..., 3) that mirror `omega` about the unit normal: 2 (n.omega) n - omega."""
    return np.asarray(2.0 * np.sum(omega * normal, axis=-1, keepdims=True) * normal - omega)


def spike_radiance(
    mirror: Mirror, omega_r: Float64, normal: Float64, incoming: Callable[[Float64], Float64]
) -> Float64:
    """Return the radiance (...,) that a mirror sends towards `omega_r` (..., 3), Eq. 6 made a BRDF.

    `incoming` gives the radiance (...,) that arrives from unit directions (..., 3). With
    f_rs = rho delta(omega_r - mirror(omega_i)) / cos(theta_i), the integral of f_rs L_i cos(theta_i) d omega
    leaves L_r(omega_r) = rho L_i(mirror(omega_r)): an extended source seen in a mirror keeps its radiance,
    times rho, at any distance. 0 below the surface.
    """
    arriving = mirror.rho * incoming(mirror_direction(omega_r, normal))
    return np.where(np.sum(omega_r * normal, axis=-1) > 0, arriving, 0.0)

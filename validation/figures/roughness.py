"""Which specular reflection a surface shows by its roughness: the mirror spike, the lobe or both."""

from __future__ import annotations

from enum import Enum

import numpy as np
import numpy.typing as npt

from noise_model.compiled.arrays import Float64


class Regime(Enum):
    """Which parts of the specular reflection a surface shows."""

    SPIKE = "spike"
    BOTH = "both"
    LOBE = "lobe"


SPIKE_ONLY_BELOW = 0.025
LOBE_ONLY_ABOVE = 1.5


def regime(R_q_um: float, wavelength_um: float) -> Regime:
    """Return the regime of a surface of RMS roughness R_q at a wavelength, both in um.

    The limits of R_q / lambda, 0.025 and 1.5, are those that go with the framework of spike, lobe and diffuse
    lobe of Nayar, Ikeuchi and Kanade (1991, IEEE TPAMI 13(7) 611-634). `coherent_share` says what they mean:
    at 0.025 the spike still holds 91 % of the light at normal incidence, at 1.5 less than 1e-4 up to 80 deg.

    Raises ValueError for a roughness < 0 or a wavelength <= 0.
    """
    if not R_q_um >= 0:
        raise ValueError(f"R_q = {R_q_um} um: a roughness is >= 0")
    if not wavelength_um > 0:
        raise ValueError(f"lambda = {wavelength_um} um: a wavelength is > 0")
    ratio = R_q_um / wavelength_um
    if ratio < SPIKE_ONLY_BELOW:
        return Regime.SPIKE
    return Regime.LOBE if ratio > LOBE_ONLY_ABOVE else Regime.BOTH


def coherent_share(
    R_q_um: npt.ArrayLike, wavelength_um: npt.ArrayLike, cos_theta_i: npt.ArrayLike
) -> Float64:
    """Return the share of the specular light that stays in the spike.

    exp(-g) with g = (4 pi R_q cos(theta_i) / lambda)^2, for heights of Gaussian distribution (Bennett and
    Porteus 1961; g as in Beckmann and Spizzichino 1963). Arguments broadcast; lengths in um.
    """
    phase = 4.0 * np.pi * np.asarray(R_q_um) * np.asarray(cos_theta_i) / np.asarray(wavelength_um)
    return np.asarray(np.exp(-(phase**2)))

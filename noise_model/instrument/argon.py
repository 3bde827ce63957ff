"""The argon lines near the sensor's filter: wavelengths, strengths, and their weights at a temperature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import constants

from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class SpectralLine:
    """A spectral line: wavelength in air, statistical weight g_k, transition probability A_ki, upper level.

    `E_k_per_cm` is the upper level's energy as a wavenumber, 1/cm.
    """

    wavelength_nm: float
    g_k: int
    A_ki_per_s: float
    E_k_per_cm: float


AR_I = (
    SpectralLine(687.1289, 3, 2.78e6, 118651.3950),
    SpectralLine(687.9582, 5, 1.8e5, 120619.0162),
    SpectralLine(688.8174, 5, 2.5e5, 120600.8905),
    SpectralLine(693.7664, 1, 3.08e6, 118512.197),
    SpectralLine(695.1478, 5, 2.2e5, 120619.0162),
    SpectralLine(696.0250, 5, 2.4e5, 120600.8905),
    SpectralLine(696.5431, 3, 6.39e6, 107496.4166),
    SpectralLine(703.0251, 5, 2.67e6, 119683.0821),
    SpectralLine(706.7218, 5, 3.80e6, 107289.7001),
    SpectralLine(706.8736, 3, 2.0e6, 119760.1725),
    SpectralLine(710.7478, 5, 4.5e5, 119683.0821),
    SpectralLine(712.5820, 3, 6.0e5, 121161.3135),
    SpectralLine(714.7042, 3, 6.25e5, 107131.7086),
    SpectralLine(715.8839, 1, 2.1e6, 121096.605),
)
"""Every Ar I line that was observed between 680 and 720 nm and has a transition probability.

NIST Atomic Spectra Database, as of April 2016 (Norlen's wavelengths, 1973); it holds an A_ki of three digits
good to 25 %, one of two digits to 40 or 50 %.
"""

REFERENCE_NM = 696.5431
"""The line that all weights refer to: the strongest one near a 690 nm filter's edge."""


def line_weights(lines: tuple[SpectralLine, ...], temperature_k: float) -> Float64:
    """Return the lines' radiances (N,) relative to that of Ar I 696.54 nm.

    An optically thin plasma in local thermal equilibrium emits g_k A_ki exp(-E_k / kT) / lambda (Griem,
    Plasma Spectroscopy, 1964). A real arc absorbs some of its strong lines again: the weak ones then weigh
    more.

    Raises ValueError for a temperature <= 0.
    """
    if not temperature_k > 0:
        raise ValueError(f"excitation temperature = {temperature_k} K: must be > 0")
    reference = next(line for line in AR_I if line.wavelength_nm == REFERENCE_NM)
    return np.array([_emission(line, reference, temperature_k) for line in lines])


def _emission(line: SpectralLine, reference: SpectralLine, temperature_k: float) -> float:
    E_per_m = 100.0 * (line.E_k_per_cm - reference.E_k_per_cm)
    boltzmann = np.exp(-constants.h * constants.c * E_per_m / (constants.k * temperature_k))
    strength = line.g_k * line.A_ki_per_s / line.wavelength_nm
    return float(strength * boltzmann / (reference.g_k * reference.A_ki_per_s / reference.wavelength_nm))

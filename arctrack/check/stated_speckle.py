"""Scatter of a stripe's brightness from scan line to scan line where the setup states speckle.

The field's logarithm is a Gaussian's (`noise_model.effects`): pixels x apart correlate by

    rho = (exp(s^2 exp(-x^2 / 4 grain^2)) - 1) / C^2,  s^2 = ln(1 + C^2).

A profile of sigma w averages 2 sqrt(pi) w pixels; their number over the sum of rho are independent, each with
scatter C.
"""

import math

import numpy as np

from noise_model.compiled.arrays import Float64
from noise_model.effects import checked
from noise_model.setup import Setup


def stated_contrast(setup: Setup, width_px: float) -> float:
    """Return the contrast of a stripe's brightness, relative, at a 1 sigma of its width; 0 for no speckle."""
    speckle = checked(setup.effects).get("laser_speckle")
    if speckle is None:
        return 0.0
    contrast, grain_px = speckle["contrast"], speckle["grain_px"]
    if contrast == 0.0 or not math.isfinite(width_px):
        return contrast
    reach = math.ceil(12.0 * grain_px)
    alike = float(likeness(np.arange(-reach, reach + 1.0), contrast, grain_px).sum())
    return contrast * min(1.0, math.sqrt(alike / (2.0 * math.sqrt(math.pi) * width_px)))


def likeness(apart_px: Float64, contrast: float, grain_px: float) -> Float64:
    """Return the correlation rho (...) of pixels that far apart."""
    rho = np.exp(-(apart_px**2) / (4.0 * grain_px**2))
    return np.asarray(np.expm1(math.log1p(contrast**2) * rho) / contrast**2)
